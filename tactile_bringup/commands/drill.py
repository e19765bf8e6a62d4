"""`tactile drill`: a task in which one thing at a time goes wrong, and what came of it.

Without more, arms, cameras or estimates lie in one process, as fast as it goes, against the truth of the
simulated cell: an arm that goes the wrong way, a camera that shows yesterday, a depth that drifts. With
--live real nodes are launched, and processes die, hang or are switched off. Passed is what brings all arms
to rest in time and presses no tip deeper than --deepest, or what does no harm.

The cell is simulated, whatever drivers the scene names; with --live --rehearse they drive doubles of the
arms.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console

from tactile_base.console import say
from tactile_base.settings import unknown_name
from tactile_base.whole_file import room_for_results
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import (
    TASK_HELP,
    add_rehearse_option,
    add_task_options,
    add_time_options,
    graph_options,
    time_options,
)
from tactile_bringup.commands.simulate import prepared
from tactile_bringup.drill import Drill, Outcome, faults
from tactile_bringup.graph import load_graph
from tactile_scene.scene import SIM
from tactile_scene.scene_file import load_scene

if TYPE_CHECKING:
    from tactile_bringup.launching.live_drill import LiveOutcome

LONGEST = 60.0  # s on the cell's clock, of a goal that ends by itself and does not


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "drill", run, __doc__, wrong=(RuntimeError,))
    add = parser.add_argument
    add("task", nargs="?", default="surface_following", help=TASK_HELP)
    add_task_options(parser)
    add("--fault", nargs="+", default=[], metavar="TEXT", help="those with TEXT in their name (default: all)")
    add("--list", action="store_true", help="name the faults, and do nothing")
    add("--arm", metavar="NAME", help="whose fault it is (default: one after the other)")
    add("--at", default="work", choices=("work", "start"), help="when it begins (default: at work)")
    add("--after", type=float, default=3.0, metavar="S", help="so long at work (default: 3 s)")
    add("--deepest", type=float, default=6.0, metavar="MM", help="that the tip may go (default: 6)")
    add("--fidelity", help="of simulated sensors, not live (default: the scene's)")
    add("--live", action="store_true", help="launch real nodes; processes are killed")
    add_time_options(parser)
    add_rehearse_option(parser)
    text = "with --live: the arms themselves, a hand on their emergency stop, and nothing in reach of them"
    add("--real-arms", action="store_true", help=text)
    add("--out", type=Path, metavar="FOLDER", help="for rows, live runs and reports (default: out/drill)")


def run(arguments: argparse.Namespace) -> int:
    folder = arguments.out or Path("out") / "drill"
    drills = (_live if arguments.live else _offline)(arguments)
    if arguments.list:
        print("\n".join(drills.faults))
        return 0
    rows = drills.run(folder)
    room_for_results(folder, "drill.json")
    outcomes, failed, console = [], 0, Console()
    for outcome in rows:
        objection = outcome.objection(arguments.deepest * 1e-3)
        failed += bool(objection)
        _show(console, outcome, objection)
        outcomes.append({**_finite(asdict(outcome)), "objection": objection})
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "drill.json").write_text(json.dumps(outcomes, indent=1))
    if outcomes:
        console.print(f"{len(outcomes) - failed} of {len(outcomes)} passed; {folder / 'drill.json'}")
    return 1 if failed else 0


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """Numbers that JSON knows: null where something never happened."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


class _Drills(NamedTuple):
    """What is to be drilled, and how, which nothing has begun with yet."""

    faults: tuple[str, ...]
    run: Callable[[Path], Iterable[Outcome | LiveOutcome]]


def _chosen(arguments: argparse.Namespace, faults: dict[str, Any]) -> dict[str, Any]:
    texts = [text.lower() for text in arguments.fault]
    found = {n: f for n, f in faults.items() if not texts or any(text in n.lower() for text in texts)}
    if not found:
        raise ValueError(f"--fault {' '.join(arguments.fault)}: there are {', '.join(faults)}")
    return found


def _offline(arguments: argparse.Namespace) -> _Drills:

    scene, task, options = prepared(arguments)
    sensing = [name for name in scene.arms if scene.arms[name].sensor is not None]
    images = arguments.fidelity in (None, "image") and any(map(scene.gives_images, sensing))
    options = replace(options, time_limit=LONGEST)
    drill = Drill(scene, task, options, None if arguments.at == "start" else arguments.after)
    chosen, names = _chosen(arguments, faults(images)), _arms(arguments, sensing)
    return _Drills(tuple(chosen), lambda folder: drill.run(chosen, names))


def _arms(arguments: argparse.Namespace, arms: list[str]) -> tuple[str, ...]:

    if arguments.arm and arguments.arm not in arms:
        raise ValueError(f"--arm: {unknown_name(arguments.arm, arms)}")
    return (arguments.arm,) if arguments.arm else tuple(arms)


def _live(arguments: argparse.Namespace) -> _Drills:
    from tactile_bringup.launching.live_drill import drill_live, live_faults

    graph = load_graph(arguments.task, arguments.scene, graph_options(arguments))
    scene = load_scene(graph.scene_file)
    real = [name for name, arm in scene.arms.items() if arm.driver != SIM]
    if arguments.rehearse and arguments.real_arms:
        raise ValueError("--rehearse or --real-arms, not both")
    if real and not (arguments.rehearse or arguments.real_arms or arguments.list):
        raise ValueError(f"{', '.join(real)}: of a real driver: --rehearse with doubles, or --real-arms")
    chosen = {
        arm: _chosen(arguments, live_faults(graph, arm, arguments.rehearse and arm in real))
        for arm in _arms(arguments, list(graph.arms))
    }
    launch = _launch_words(arguments, graph.scene_file)

    def run(folder: Path) -> Iterable[LiveOutcome]:
        runs = folder / time.strftime("%Y%m%d-%H%M%S")
        for arm, found in chosen.items():
            for number, (fault, harm) in enumerate(found.items()):
                place = runs / f"{arm}-{number:02d}"
                yield drill_live(f"{arm}: {fault}", harm, arm, launch, place, arguments.after)

    return _Drills(tuple(dict.fromkeys(name for found in chosen.values() for name in found)), run)


def _launch_words(arguments: argparse.Namespace, scene_file: Path) -> list[str]:
    launch = [arguments.task, "--scene", str(scene_file), "--seed", str(arguments.seed)]
    for name in ("model", "filter", "controller"):
        if value := getattr(arguments, name):
            launch += [f"--{name}", str(value)]
    launch += [word for change in arguments.changes for word in ("--set", change)]
    launch += ["--goals", *arguments.goals] if arguments.goals else []
    launch += time_options(arguments)
    return [*launch, "--rehearse"] if arguments.rehearse else launch


def _show(console: Console, outcome: Outcome | LiveOutcome, objection: str) -> None:
    numbers = f"at rest after {outcome.rest:.2f} s" if math.isfinite(outcome.rest) else "never at rest"
    if math.isfinite(outcome.deepest):
        numbers += f", {1e3 * outcome.deepest:.1f} mm deep"
    if fastest := getattr(outcome, "fastest", 0.0):
        numbers += f", {1e3 * fastest:.0f} mm/s"
    arm = getattr(outcome, "arm", "")
    what = f"{outcome.fault}{f' ({arm})' if arm else ''}: {numbers}: {outcome.reason or 'done'}"
    say(
        console,
        f"FAILED  {what}: {objection}" if objection else f"passed  {what}",
        "red" if objection else None,
    )
