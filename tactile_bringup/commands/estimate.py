"""Estimate a data folder, a video or a camera (by index), without ROS; write a table and a picture."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tactile_base.console import number_table, say
from tactile_base.input_file import parse_json, read_text
from tactile_base.progress import Progress
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command, natural_int, positive_int
from tactile_filter.bayes_filter import ContactFilter
from tactile_filter.filter_settings import load_filter_settings
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.layout import PARAMETERS_NAME
from tactile_perception.estimating.estimator import Estimator, shipped_model
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.estimating.model_metadata import SIMULATED_ONLY
from tactile_perception.estimating.plots import draw_estimates, draw_series
from tactile_perception.estimating.run import run_estimates
from tactile_perception.estimating.sources import (
    SourceError,
    folder_frames,
    read_poses,
    usable_order,
    video_frames,
)
from tactile_perception.evaluation.filtering import motion_filter, with_motion_noise

TABLE = "estimates.csv"


def register(subparsers: Any) -> None:
    add = add_command(subparsers, "estimate", run_estimate, __doc__, status=1).add_argument
    add("source", help="data folder, video file, or index of a camera")
    add("--model", type=Path, default=None, help="ONNX model (default: the shipped one)")
    add("--out", type=Path, default=Path("out/estimate"), help="folder for table and picture")
    add("--poses", type=Path, help="table with the sensor's pose in the base for each video frame")
    add("--limit", type=positive_int, metavar="N", help="stop after N images")
    add("--no-filter", action="store_true", help="estimator only")
    add("--smooth", action="store_true", help="let what is filtered know what came later, too")
    text = "noise of the motion between a folder's images, in mm and degrees, added and assumed"
    add("--motion-sigma", type=float, default=1.0, metavar="S", help=text)
    add("--seed", type=natural_int, default=0, help="order of a folder's images, and the motion's noise")
    add("--threads", type=positive_int, default=1, help="CPU threads of the estimator")


def run_estimate(arguments: argparse.Namespace) -> int:
    console = Console(stderr=True)
    if not arguments.motion_sigma >= 0.0:
        raise ValueError(f"--motion-sigma {arguments.motion_sigma:g}: must not be negative")
    estimator = Estimator(arguments.model or "", arguments.threads)
    room_for_results(arguments.out, TABLE, source=Path(arguments.source))
    if Path(arguments.source).is_dir():
        frames, contact_filter, total = _from_folder(arguments, estimator, console)
    else:
        frames, contact_filter, total = _from_video(arguments, estimator.metadata.preprocessing.color)
    if estimator.path == shipped_model() and not _simulated(Path(arguments.source)):
        say(console, f"note: {SIMULATED_ONLY}", "yellow")
    with Progress(console) as progress:
        update = partial(progress.update, "estimating", total=total, unit="images")
        table = run_estimates(estimator, frames, contact_filter, update, arguments.smooth)
    _write_estimates(arguments, table)
    return 0


def _simulated(source: Path) -> bool:
    """Whether a data folder says of itself that its images are simulated."""
    path = source / PARAMETERS_NAME
    return path.is_file() and parse_json(read_text(path)).get("robot") == "sim"


def _from_folder(
    arguments: argparse.Namespace, estimator: Any, console: Console
) -> tuple[Any, Any, int | None]:
    """Images, filter (or None) and number of images of a data folder."""
    folder = open_folder(arguments.source, estimator.metadata.preprocessing)
    model = estimator.metadata.contact_model
    if model.tangent:
        folder.check_labelled()
    if model.unknown:
        say(console, f"{estimator.path}: {model.says_unknown()}", "yellow")
    if folder.preprocessing.difference:
        estimator.preprocessor.reference = folder.preprocessor().reference
    order = usable_order(folder, arguments.seed, arguments.limit)
    say(console, "\n".join(folder.report.lines()))
    frames = folder_frames(folder, order)
    contact_filter = None
    if not arguments.no_filter and set(EULER_COMPONENTS) <= set(folder.labelled):
        frames = with_motion_noise(frames, arguments.motion_sigma, arguments.seed)
        contact_filter = motion_filter(arguments.motion_sigma)
    return frames, contact_filter, len(order)


def _from_video(arguments: argparse.Namespace, color: bool) -> tuple[Any, Any, int | None]:
    """Frames of a video or a camera, and their filter; how many there are, only a limit says."""
    source: str | int = arguments.source
    if arguments.source.isdecimal():
        source = int(arguments.source)
    elif not Path(arguments.source).is_file():
        raise SourceError(f"{source}: is neither a data folder, nor a video file, nor the index of a camera")
    poses = read_poses(arguments.poses) if arguments.poses else None
    contact_filter = ContactFilter(load_filter_settings()) if poses and not arguments.no_filter else None
    frames = _until_interrupted(video_frames(source, poses, arguments.limit, color))
    return frames, contact_filter, arguments.limit


def _until_interrupted(frames: Any) -> Any:
    """Frames until the source ends or Ctrl-C, which is how one stops a camera."""
    try:
        yield from frames
    except KeyboardInterrupt:
        return


def _write_estimates(arguments: argparse.Namespace, table: Any) -> None:

    arguments.out.mkdir(parents=True, exist_ok=True)
    table_path = arguments.out / TABLE
    table.write_csv(table_path)
    title = f"{Path(arguments.source).name}, {len(table)} images"
    if table.has_labels:
        picture = arguments.out / "predicted_against_actual.png"
        draw_estimates(table, picture, title)
    else:
        picture = arguments.out / "estimates.png"
        draw_series(table, picture, title)
    _print_estimate_summary(Console(), table)
    print(f"table: {table_path}\npicture: {picture}")


def _print_estimate_summary(console: Console, table: Any) -> None:
    if table.failures:
        say(console, f"no Gaussian from {len(table.failures)} images: {table.failures[0]}", "red")
    if len(table.stage_seconds):
        times = np.array(table.stage_seconds) * 1e3
        names = ("pre-processing", "network", "conversion", "total")
        stages = zip(names, [*times.T, times.sum(axis=1)], strict=True)
        text = "; ".join(f"{name} {np.median(t):.2f} / {np.percentile(t, 99):.2f}" for name, t in stages)
        say(console, f"ms per image, p50 / p99: {text}")
    if not table.has_labels:
        return
    errors = {name: table.mean_absolute_error(series) for name, series in table.series.items()}
    summary = number_table(f"mean absolute error over {len(table)} images", ["component", *errors])
    for component, name in enumerate(table.model.titles):
        if np.isnan(errors["network"][component]):
            continue
        summary.add_row(name, *(f"{column[component]:.4f}" for column in errors.values()))
    console.print(summary)
