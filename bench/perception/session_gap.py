"""What samples of a session would bring: how much of the error on another session training could take away.

    python bench/perception/session_gap.py DATA --model RUN [RUN ...] --out DIR \
        [--config FILE] [--start RUN] [--set SECTION.NAME=VALUE ...]

RUN was trained on DATA/train. Every second sample of DATA/val, which is of another session, is joined to
DATA/train (images are linked, not copied), one network is trained on both as the options say, and all are
evaluated on what is left of DATA/val: what this network errs there, no training on the first session could
have spared the others.
"""

from __future__ import annotations

import argparse
import csv
import shutil
from pathlib import Path

from tactile_bringup.cli import main as tactile
from tactile_perception.datasets.dataset import TactileFolder, open_folder
from tactile_perception.datasets.layout import IMAGE_PARAMS_NAMES, IMAGES_NAME, TARGETS_NAME, image_name
from tactile_perception.training.run_folder import RESULT_NAME

#: The published labels' columns, of which the second half may be zero: their sum is what counts.
COLUMNS = [f"{kind}_{axis}" for kind in ("pose", "shear") for axis in ("x", "y", "z", "Rx", "Ry", "Rz")]


def write_folder(target: Path, parts: list[tuple[TactileFolder, slice]]) -> None:
    """A data folder of some rows of others, with links to their images."""
    if target.exists():
        shutil.rmtree(target)
    (target / IMAGES_NAME).mkdir(parents=True)
    with (target / TARGETS_NAME).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["sensor_image", *COLUMNS])
        count = 0
        for source, rows in parts:
            for name, euler in zip(source.names[rows], source.euler_mm_deg[rows].tolist(), strict=True):
                count += 1
                (target / IMAGES_NAME / image_name(count)).symlink_to((source.image_folder / name).resolve())
                writer.writerow([image_name(count), *euler, *[0.0] * 6])
    source = parts[0][0].folder
    for name in IMAGE_PARAMS_NAMES:
        if (source / name).is_file():
            shutil.copy(source / name, target)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--start", type=Path)
    parser.add_argument("--set", action="append", default=[])
    args = parser.parse_args()
    first, second = open_folder(args.data / "train"), open_folder(args.data / "val")
    data, run = args.out / "data", args.out / "run"
    if not run.exists():
        write_folder(data / "train", [(first, slice(None)), (second, slice(0, None, 2))])
        write_folder(data / "val", [(second, slice(1, None, 2))])
    options = [text for change in args.set for text in ("--set", change)]
    for name, value in (("--config", args.config), ("--start", args.start)):
        options += [name, str(value)] if value else []
    if not (run / RESULT_NAME).exists() and tactile(["train", str(data), "--out", str(run), *options]):
        return 1
    for name, models in (("first_session", args.model), ("both_sessions", [run])):
        print(f"trained on {name.replace('_', ' ')}:")
        out = ["--out", str(args.out / name), "--no-figures"]
        if tactile(["evaluate", "--data", str(data / "val"), *out, "--model", *map(str, models)]):
            return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
