"""Write a copy of a model whose stated uncertainty fits its errors on labelled data.

On samples of today's session (100 at least, better 500), as a session should begin; or on what was held back
of its training data, with the margin and floor of its training for other sessions.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tactile_base.whole_file import check_file, room_for_files
from tactile_bringup.commands.changes import add_command, add_set_option, changed_settings
from tactile_perception.estimating.model_metadata import trained_model


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "calibrate", run_calibrate, __doc__, status=1)
    add = parser.add_argument
    add("model", type=Path, metavar="RUN", help="run folder of `tactile train`, or ONNX file")
    add("--data", type=Path, required=True, help="labelled folder of the public layout")
    add("--out", type=Path, required=True, metavar="FILE", help="where the copy goes (.onnx)")
    add_set_option(parser, "change a setting of the calibration, as margin=[1.1,1.1,1.1,1,1,1]")


def run_calibrate(arguments: argparse.Namespace) -> int:
    from tactile_perception.training.recalibration import recalibrate

    check_file(arguments.out)
    model, changes = trained_model(arguments.model), changed_settings(arguments.changes, "sigma_knots=3")
    if arguments.out.resolve() == model.resolve():
        raise ValueError(f"{arguments.out}: is the model itself; --out must name another file")
    room_for_files(arguments.out)
    calibration, own_session = recalibrate(model, arguments.data, arguments.out, changes)
    source = "held back in training, for other sessions" if own_session else "of this session, for it"
    print(
        f"{arguments.out}: calibrated on {calibration.samples} samples {source}; "
        f"standard error of the joint NEES / 6: {calibration.nees_error:.3f}"
    )
    return 0
