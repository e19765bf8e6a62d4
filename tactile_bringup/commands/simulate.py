"""`tactile simulate`: a task on a simulated scene in one process, without ROS, with report and pictures."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactile_control.task import Command
    from tactile_records.runs.record import RunRecord


def register(subparsers: Any) -> None:
    """Add `tactile simulate` to the command line."""
    parser = subparsers.add_parser(
        "simulate",
        help="run a task on a simulated scene in one process, without ROS, as fast as it goes",
        description="Runs a task in a simulated scene in one process; writes report.json, pictures, record.",
    )
    parser.add_argument(
        "task", nargs="?", default="surface_following", help="a task of config/tasks, or a path"
    )
    parser.add_argument("--scene", default="ramp", help="a scene of config/scenes, or a path (default: ramp)")
    parser.add_argument(
        "--fidelity", choices=("image", "ideal"), help="image or ideal sensor (default: the scene's)"
    )
    parser.add_argument("--arm", metavar="NAME", help="which arm runs the task (default: the only one)")
    parser.add_argument("--model", type=Path, help="ONNX model for images (default: the shipped one)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all noise (default: 0)")
    parser.add_argument("--latency", type=float, default=10.0, help="exposure to command in ms (default: 10)")
    parser.add_argument("--paths", nargs="+", default=(), help="names of the paths to run (default: all)")
    parser.add_argument("--controller", help="a file of config/controllers in place of the task's")
    parser.add_argument(
        "--out", type=Path, help="folder for report, pictures and record (default: out/simulate)"
    )
    parser.set_defaults(run=_simulate)


def _simulate(arguments: argparse.Namespace) -> int:
    from tactile_bringup.offline import OfflineOptions, run_offline
    from tactile_control.files import load_task, task_path
    from tactile_drivers.scene import load_scene

    try:
        scene = load_scene(arguments.scene)
        task = load_task(task_path(arguments.task), scene.name, controller=arguments.controller)
        options = OfflineOptions(
            fidelity=arguments.fidelity,
            model=arguments.model,
            seed=arguments.seed,
            latency=arguments.latency * 1e-3,
            arm=arguments.arm,
            paths=tuple(arguments.paths),
        )
        record = run_offline(scene, task, options, _Ticker() if sys.stderr.isatty() else None)
    except (FileNotFoundError, ValueError) as error:  # settings, scenes, models: all say what is wrong
        print(f"tactile simulate: {error}", file=sys.stderr)
        return 2
    return _deliver(record, arguments.out or Path("out") / "simulate")


def _deliver(record: RunRecord, folder: Path) -> int:
    from tactile_records.runs import figures, metrics

    folder.mkdir(parents=True, exist_ok=True)
    values = metrics.write_report(record, folder / "report.json")
    record.save(folder / "run.npz")
    pictures = figures.write_figures(record, folder)
    for name, value, requirement in metrics.summary_rows(values):
        print(f"{name:28s} {value:>14s}   {requirement}")
    for path in (folder / "report.json", folder / "run.npz", *pictures):
        print(path)
    return 0 if values["succeeded"] else 1


class _Ticker:
    """One line on a terminal: path, phase, progress."""

    def __init__(self) -> None:
        self._shown = ""

    def __call__(self, path: str, command: Command) -> None:
        text = f"{path:12s} {command.phase:12s} {100.0 * command.progress:5.0f} %"
        if text != self._shown:
            print(f"\r{text}", end="\n" if command.done else "", file=sys.stderr, flush=True)
            self._shown = text
