"""`tactile run TASK`: runs a task's paths on nodes that are already up, for example by `ros2 launch`."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING, Any

from tactile_bringup.commands.launch import DEFAULT_SCENE, EXIT_CODES, TASK_HELP

if TYPE_CHECKING:
    from tactile_bringup.launching.progress import Display
    from tactile_bringup.task_graph import TaskGraph


def register(subparsers: Any) -> None:
    """Add `run`."""
    parser = subparsers.add_parser(
        "run", help="run a task on nodes that are up already", description=__doc__, epilog=EXIT_CODES
    )
    parser.add_argument("task", help=TASK_HELP)
    parser.add_argument("--scene", default=DEFAULT_SCENE, metavar="NAME", help="(default: %(default)s)")
    parser.add_argument("--headless", action="store_true", help="plain lines in place of the live display")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code."""
    from rich.console import Console

    from tactile_base.settings import SettingError
    from tactile_bringup.graph import GraphOptions
    from tactile_bringup.launching.launcher import EXIT_USAGE
    from tactile_bringup.launching.progress import Display
    from tactile_bringup.task_graph import load_task_graph

    try:
        loaded = load_task_graph(arguments.task, arguments.scene, GraphOptions())
    except (SettingError, ValueError, OSError) as error:
        print(f"tactile run: {error}", file=sys.stderr)
        return EXIT_USAGE
    console = Console()
    with Display(console, console.is_terminal and not arguments.headless) as display:
        return _run(loaded, display)


def _run(loaded: TaskGraph, display: Display) -> int:
    from tactile_bringup.launching import launcher
    from tactile_bringup.launching.task_client import TaskClient
    from tactile_bringup.launching.task_runner import (
        Interrupted,
        NotReady,
        PathFailed,
        TaskRunner,
        signals_into,
    )

    graph, signals = loaded.graph, list[int]()
    with signals_into(signals):
        client = TaskClient(int(os.environ.get("ROS_DOMAIN_ID") or 0))
        runner = TaskRunner(
            client, graph.task, [n.full_name for n in graph.nodes], graph.arms, display, signals
        )
        try:
            runner.wait_until_active()
            runner.run(loaded.paths)
        except NotReady as late:
            display.say(f"tactile run: {late}; nodes started elsewhere need the same ROS_DOMAIN_ID", "red")
            return launcher.EXIT_NOT_READY
        except PathFailed as failure:
            display.say(f"tactile run: {failure}", "red")
            return launcher.EXIT_TASK_FAILED
        except Interrupted as interrupt:
            display.say(f"{interrupt}: bringing the arm to rest (again to hurry)", "yellow")
            return launcher.EXIT_SIGNAL + interrupt.number
        finally:
            runner.bring_to_rest()
            client.close()
    return launcher.EXIT_OK
