"""`tactile run TASK`: runs a task on nodes that are already up, for example by `ros2 launch`."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING, Any

from tactile_base.console import lasting_console
from tactile_base.end_signals import end_with_launcher
from tactile_bringup.attached_arm import Place, load_servoing_graph
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import EXIT_CODES, TASK_HELP
from tactile_bringup.graph import Graph, GraphOptions, load_graph

if TYPE_CHECKING:
    from tactile_bringup.launching.progress import Display


def register(subparsers: Any) -> None:
    add = add_command(subparsers, "run", run, __doc__, epilog=EXIT_CODES).add_argument
    add("task", help=TASK_HELP)
    add("--scene", metavar="NAME", help="(default: the first that the task names)")
    add("--goals", nargs="+", default=(), help="names of the goals to run (default: all)")
    text = "of one arm's nodes, as servoing.launch.py has started them (default: the arm's name)"
    add("--namespace", default="", metavar="NAME", help=text)
    add("--arm", default="", metavar="NAME", help="that arm (default: the only one with a role)")
    add("--rehearse", action="store_true", help="the nodes were started for a rehearsal")
    add("--headless", action="store_true", help="plain lines in place of the live display")


def run(arguments: argparse.Namespace) -> int:
    from tactile_bringup.launching.progress import Display
    from tactile_bringup.launching.start_check import check_process

    end_with_launcher()
    task, scene = arguments.task, arguments.scene
    options = GraphOptions(goals=tuple(arguments.goals), rehearse=arguments.rehearse)
    check_process()
    if arguments.namespace or arguments.arm:
        graph = load_servoing_graph(task, scene, arguments.arm, Place(arguments.namespace), options)
    else:
        graph = load_graph(task, scene, options)
    console = lasting_console()
    with Display(console, console.is_terminal and not arguments.headless) as display:
        return _run(graph, display)


def _run(graph: Graph, display: Display) -> int:
    from tactile_bringup.launching.task_client import TaskClient
    from tactile_bringup.launching.task_runner import (
        RESTS,
        Interrupted,
        NotReady,
        TaskRunner,
        Unfinished,
        collecting_signals,
        in_disorder,
    )

    signals, code = list[int](), 0
    with collecting_signals(signals):
        client = TaskClient(int(os.environ.get("ROS_DOMAIN_ID") or 0))
        runner = TaskRunner(client, [n.full_name for n in graph.nodes], graph.plans, display, signals)
        try:
            runner.wait_until_active()
            runner.run()
        except Unfinished as end:
            code = end.exit_code
            if isinstance(end, Interrupted):
                display.say(f"{end}: bringing the arm to rest (again to hurry)", "yellow")
            else:
                hint = "; nodes started elsewhere need the same ROS_DOMAIN_ID"
                display.say(f"tactile run: {end}{hint if isinstance(end, NotReady) else ''}", "red")
        finally:
            at_rest = runner.bring_to_rest()
            client.close()
        display.say(f"ended: {RESTS[at_rest]}")
    return in_disorder(code) if at_rest is False and len(signals) < 2 else code
