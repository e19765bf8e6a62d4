"""Have an arm touch a flat surface, and work out of it what a scene file has to say."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console

from tactile_base.console import lasting_console, say
from tactile_base.whole_file import check_folder
from tactile_bringup import cell_touching
from tactile_bringup.commands.changes import (
    add_command,
    add_group,
    add_set_option,
    changed_settings,
    natural_int,
)
from tactile_bringup.commands.launch import add_rehearse_option, launch_graph
from tactile_bringup.graph import GraphOptions, build_graph
from tactile_bringup.run_sequence import arm_plans
from tactile_bringup.scene_values import write_into
from tactile_bringup.staged_arm import arm_of
from tactile_doubles.rehearsal import rehearsed
from tactile_records.calibrating.results import RESULTS
from tactile_records.runs.record import RunRecord
from tactile_scene.scene import SIM, Scene
from tactile_scene.scene_file import load_scene

HELP = {
    "time": "offset between the camera's stamps and the arm's, by moving back and forth in contact",
    "tip": "centre of the tip in the tool, by touching a plane upright and at tilts",
    "mounting": "rotation of the sensor in the tool, by pressing and shearing it on a plane at tilts",
}
FAILED, DISAGREES = 1, 3
EXIT_CODES = "exit codes: 0 the scene agrees or was corrected; 1 it failed; 3 the scene does not agree"
EXAMPLE = "tilt_deg=20"


def register(subparsers: Any) -> None:
    commands = add_group(subparsers, "cell", __doc__)
    for name, text in HELP.items():
        command = add_command(commands, name, run, f"The {text}.", help=text, epilog=EXIT_CODES, status=1)
        add = command.add_argument
        add("--scene", required=True, metavar="FILE", help="the cell")
        add("--arm", metavar="NAME", help="which arm (default: the only one with a sensor)")
        add("--from", dest="source", type=Path, metavar="RUN", help="a bag, or run.npz, in which it was done")
        add("--simulate", action="store_true", help="a simulated arm, in one process, without ROS")
        add_rehearse_option(command)
        add_set_option(command, f"a setting of the touches, as {EXAMPLE} (docs/tasks.md)")
        add("--seed", type=natural_int, default=0, help="of what is simulated (0)")
        add("--write", action="store_true", help="write what was found into the scene file")
        add("--out", type=Path, default=Path("out/cell"), metavar="FOLDER", help="for results (out/cell)")
        add("--headless", action="store_true", help="plain lines in place of the live display")


def run(arguments: argparse.Namespace) -> int:
    scene = load_scene(arguments.scene)
    if (arguments.source is not None) + arguments.simulate + arguments.rehearse > 1:
        raise ValueError("--from, --simulate and --rehearse: at most one of them says where a run comes from")
    if arguments.write and arguments.rehearse:
        raise ValueError("--write: what a rehearsal finds is true of its doubles, not of the cell")
    if arguments.write and not Path(arguments.scene).is_file():
        raise ValueError(f"--write needs a scene file of your own, not the packaged '{arguments.scene}'")
    scene = rehearsed(scene) if arguments.rehearse else scene
    arm = arm_of(scene, arguments.arm, lambda arm: arm.sensor is not None, "an arm with a sensor")
    assert arm.sensor is not None
    console = lasting_console()
    record = run_of(arguments, scene, arm.name, console)
    if record is None:
        return FAILED
    result = RESULTS[arguments.what](record, arm.sensor)
    paths = result.write(arguments.out, arguments.what)
    for line in (*result.lines, *map(str, paths)):
        say(console, line)
    if arguments.write:
        write_into(scene.path, arm.name, dict(result.sensor))
        say(console, f"{scene.path}: written")
        return 0
    values = yaml.safe_dump(dict(result.sensor), default_flow_style=True, width=200).strip()[1:-1]
    verdict = "the scene agrees" if result.agrees else f"the scene does not agree; --write sets {values}"
    say(console, verdict, "green" if result.agrees else "yellow")
    return 0 if result.agrees else DISAGREES


def run_of(arguments: argparse.Namespace, scene: Scene, arm: str, console: Console) -> RunRecord | None:
    """The run that is looked at: recorded, simulated, or of the arm now; None where the last has failed."""
    if arguments.source is not None:
        return cell_touching.recorded(arguments.source, arm)
    if arguments.simulate:
        if scene.arms[arm].driver != SIM:
            raise ValueError(
                f"--simulate: arm '{arm}' has the driver '{scene.arms[arm].driver}', not '{SIM}'"
            )
        changes = changed_settings(arguments.changes, EXAMPLE)
        record = cell_touching.simulated(scene, arm, arguments.what, arguments.seed, **changes)
        if record.result["succeeded"]:
            return record
        say(console, f"tactile cell: {record.result['reason']}", "red")
        return None
    return _of_the_graph(arguments, scene, arm, console)


def _of_the_graph(
    arguments: argparse.Namespace, scene: Scene, arm: str, console: Console
) -> RunRecord | None:
    from tactile_bringup.launching.launcher import Manner

    folder = arguments.out / f"{time.strftime('%Y%m%d-%H%M%S')}-{arguments.what}"
    check_folder(folder)
    options = GraphOptions(record=folder / "bag", seed=arguments.seed, rehearse=arguments.rehearse)
    task = cell_touching.task_of(scene, arm, arguments.what, **changed_settings(arguments.changes, EXAMPLE))
    graph = build_graph(task.name, scene, arm_plans(task, scene), options)
    if launch_graph(graph, folder, console, Manner(headless=arguments.headless)).exit_code:
        return None
    say(console, f"bag: {folder / 'bag'}")
    return cell_touching.recorded(folder / "bag", arm)
