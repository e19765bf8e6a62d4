"""Run a task in a simulated scene in one process, as fast as it goes; write report, pictures and record."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.progress import Progress
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import TASK_HELP, add_task_options, add_view_option
from tactile_bringup.launching.page_process import served_page
from tactile_bringup.offline import Log, OfflineOptions, run_arms_offline
from tactile_bringup.offline_bag import OfflineBag
from tactile_bringup.run_sequence import ArmPlan, arm_plans
from tactile_bringup.scene_check import check_bodies
from tactile_control.phases import Command
from tactile_control.task_file import Task, default_scene, load_task, task_path
from tactile_doubles.rehearsal import simulated
from tactile_filter.filter_settings import load_filter_settings
from tactile_records.runs.log import RunLog
from tactile_records.runs.page import write_report_page
from tactile_records.runs.report import FILES, Run, places, summary, write_reports
from tactile_scene.scene import Scene
from tactile_scene.scene_file import load_scene
from tactile_scene.simulation import FIDELITIES

ERRORS = "errors.log"  # tracebacks, beside the results
BAG = "bag"


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "simulate", _simulate, __doc__)
    add = parser.add_argument
    add("task", nargs="?", default="surface_following", help=TASK_HELP)
    add_task_options(parser)
    add("--fidelity", choices=FIDELITIES, help="of the sensors, slowest first (default: the scene's)")
    add("--arm", metavar="NAME", help="run this arm only (default: all with a role)")
    add("--latency", type=float, default=10.0, help="exposure to command in ms (default: 10)")
    add("--out", type=Path, help="folder for report, pictures and record (default: out/simulate)")
    add_view_option(parser)


def _simulate(arguments: argparse.Namespace) -> int:
    folder = arguments.out or Path("out") / "simulate"
    room_for_results(folder, *FILES, f"{BAG}/*")
    scene, task, options = prepared(arguments)
    options = replace(options, latency=arguments.latency * 1e-3, arm=arguments.arm)
    remarks = check_bodies(scene)
    for remark in remarks:
        say(Console(stderr=True), remark, "yellow")
    plans = arm_plans(task, scene, options.arm, options.goals)

    def delivered(log: Log) -> int:
        run = _run(scene, task, options, plans, log, arguments.view)
        for record in run.values():
            record.result |= {"complaints": remarks} if remarks else {}
        return deliver(run, folder)

    if not arguments.view:
        return delivered(RunLog)
    return _viewed(OfflineBag(folder / BAG, scene, task.name, plans, options.seed), folder, delivered)


def _run(
    scene: Scene, task: Task, options: OfflineOptions, plans: list[ArmPlan], log: Log, told: bool
) -> Run:
    """The run, with its progress: on a terminal, or where it is to be `told` anyway."""
    ends = {(plan.arm, goal.name): goal.goal.ends for plan in plans for goal in plan.goals}
    with Progress() as progress:

        def show(arm: str, goal: str, command: Command) -> None:
            done, total = (command.progress, 1.0) if ends[arm, goal] else (0.0, None)
            progress.update(f"{arm} {goal}", done, total, state=command.phase)

        told = told or progress.console.is_terminal
        return run_arms_offline(scene, task, options, show if told else None, log)


def _viewed(bag: OfflineBag, folder: Path, delivered: Callable[[Log], int]) -> int:
    """Have a run be on a page, which shows its recording while it grows, and stays until Ctrl-C."""
    console, log = Console(stderr=True), folder / "view.log"
    with served_page(os.environ, log, bag.folder) as page:
        say(console, f"page: {page.address}, in a few seconds")
        with bag:
            code = delivered(bag.log)
        sys.stdout.flush()  # what came of it is told while the page is open
        say(console, f"the run stays on {page.address}; Ctrl-C ends the page")
        with contextlib.suppress(KeyboardInterrupt):
            page.process.wait()
            say(console, f"the page has ended by itself: see {log}", "yellow")
    return code


def prepared(arguments: argparse.Namespace) -> tuple[Scene, Task, OfflineOptions]:
    """What the options of a command that runs a task in one process say."""
    path = task_path(arguments.task)
    scene = load_scene(arguments.scene or default_scene(path))
    chosen = {"controller": arguments.controller, "changes": arguments.changes}
    task = load_task(path, scene.name, goals_of=scene.goals_of, **chosen)
    options = OfflineOptions(
        fidelity=arguments.fidelity,
        model=arguments.model,
        seed=arguments.seed,
        goals=tuple(arguments.goals),
        filter=load_filter_settings(arguments.filter),
    )
    return simulated(scene), task, options


def deliver(run: Run, folder: Path) -> int:
    """Write report, pictures and record of each arm, and say what a person wants to see first."""
    values = write_reports(run, folder)
    page = write_report_page(run, values, folder)
    for arm, place in places(run, folder).items():
        run[arm].save(place / "run.npz")
    for name, value, requirement in summary(run, values):
        print(f"{name:28s} {value:>14s}   {requirement}")
    traces = {run[arm].result["traceback"] for arm in run if "traceback" in run[arm].result}
    if traces:
        (folder / ERRORS).write_text("\n".join(sorted(traces)))
        print(f"where the error comes from: {folder / ERRORS}")
    print(page)
    for place in places(run, folder).values():
        for path in sorted(place.glob("*.*")):
            if path != page:
                print(path)
    return 0 if all(numbers["succeeded"] for numbers in values.values()) else 1
