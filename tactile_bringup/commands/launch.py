"""`tactile launch TASK`: starts the task's graph, runs its goals, and brings all to rest."""

from __future__ import annotations

import argparse
import time
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tactile_base.console import lasting_console
from tactile_base.whole_file import check_folder
from tactile_bringup.commands.changes import add_command, add_set_option

if TYPE_CHECKING:
    from tactile_bringup.graph import Graph, GraphOptions
    from tactile_bringup.launching.launcher import Manner, Outcome

TASK_HELP = "task: the name of one of config/tasks, or a task file of your own"
FOUND = ""  # no file of the object: where it is touched is found by touch
EXIT_CODES = """exit codes: 0 the task was done; 1 it failed; 2 nothing was started: an option, scene, task
file, model, limit of the process or the middleware is wrong; 3 a node ended by itself; 4 nodes were not ready
in time; 5 the task was done, or ended by a signal, but an arm was not seen at rest or a node ended badly (a
recording may be lost); 129 the terminal was closed; 130 Ctrl-C; 143 SIGTERM"""


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "launch", run, __doc__, epilog=EXIT_CODES)
    add = parser.add_argument
    add("task", help=TASK_HELP)
    add_scene_options(parser)
    text = "run no goal: they come by `tactile goal` or `tactile run` from another terminal, until Ctrl-C"
    add("--nodes-only", action="store_true", help=text)
    add("--record", type=Path, metavar="BAG", help="write a bag (MCAP) to this new folder")
    add("--record-images", action="store_true", help="with images, compressed without loss")
    add("--marker-view", action="store_true", help="publish a picture of the markers (tactile/marker_view)")
    text = "fuse the contacts of all arms into one belief over the object that they touch (object/belief); "
    text += "NAME: one of config/objects, or a file, that says where they touch it (default: found by touch)"
    add("--object-belief", nargs="?", const=FOUND, metavar="NAME", help=text)
    add_time_options(parser)
    add_rehearse_option(parser)
    add("--headless", action="store_true", help="plain lines in place of the live display")
    add_view_option(parser)
    add("--out", type=Path, default=Path("out/runs"), metavar="FOLDER", help="where the run's folder goes")


def add_view_option(parser: argparse.ArgumentParser) -> None:
    """Option of commands beside which the page may be open."""
    parser.add_argument("--view", action="store_true", help="serve a page for the browser, and say where")


def add_time_options(parser: argparse.ArgumentParser) -> None:
    """Options of commands that start nodes which have to be in time."""
    add = parser.add_argument
    text = "SCHED_FIFO priority 1..99 of the nodes from exposure to motion (default: 0, as any process)"
    add("--priority", type=int, default=0, metavar="N", help=text)
    text = "of this machine, on which alone these nodes run; isolated ones, say (default: any)"
    add("--cores", nargs="+", type=int, default=(), metavar="N", help=text)


def time_options(arguments: argparse.Namespace) -> list[str]:
    """Options of priority and cores as words for another command line."""
    cores = ["--cores", *map(str, arguments.cores)] if arguments.cores else []
    return ["--priority", str(arguments.priority), *cores]


def add_rehearse_option(parser: argparse.ArgumentParser) -> None:
    """Option of every command that drives real arms."""
    text = "with doubles of the arms, which speak their protocols, and simulated cameras"
    parser.add_argument("--rehearse", action="store_true", help=text)


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Options that every command which runs the graph has."""
    parser.add_argument("--rate", type=float, metavar="HZ", help="exposures a second (default: the scene's)")
    add_task_options(parser)


def add_task_options(parser: argparse.ArgumentParser) -> None:
    """Options that every command which runs a task has, with ROS or without."""
    add = parser.add_argument
    add("--scene", metavar="NAME", help="scene, or a scene file (default: the first that the task names)")
    add("--seed", type=int, default=0, help="seed of the simulated cell (default: 0)")
    add("--model", type=Path, metavar="FILE", help="of all estimators (default: each sensor's in the scene)")
    add("--filter", default="", metavar="NAME", help="one of config/filters, or a file")
    text = "one of config/controllers, or a file, for the task's; ROLE=NAME: for one role"
    add("--controller", metavar="NAME", help=text)
    add_set_option(parser, "a setting on top of the files, again and again", "ROLE.GROUP.NAME=VALUE")
    add("--goals", nargs="+", default=(), help="names of the goals to run (default: all)")


def graph_options(arguments: argparse.Namespace, **more: Any) -> GraphOptions:
    """What a user has chosen by options that are called like the graph's."""
    from tactile_bringup.graph import GraphOptions

    names = {item.name for item in fields(GraphOptions)}
    given: dict[str, Any] = {name: value for name, value in vars(arguments).items() if name in names}
    for name in ("changes", "goals", "cores"):
        given[name] = tuple(given.get(name, ()))
    return GraphOptions(**given | more)


def run(arguments: argparse.Namespace) -> int:
    from tactile_bringup.launching.launcher import Manner

    if arguments.record_images and arguments.record is None:
        raise ValueError("--record-images needs --record BAG")
    place = arguments.object_belief
    options = graph_options(arguments, object_belief=place is not None, object_file=place or FOUND)
    folder = arguments.out / f"{time.strftime('%Y%m%d-%H%M%S')}-{Path(arguments.task).stem}"
    console = lasting_console()
    manner = Manner(headless=arguments.headless, waits=arguments.nodes_only, view=arguments.view)
    outcome = launch(arguments.task, arguments.scene, options, folder, console, manner)
    if options.record is not None and options.record.exists():
        console.print(f"bag: {options.record.absolute()}", highlight=False, soft_wrap=True)
    return outcome.exit_code


def launch(
    task: str, scene: str | None, options: GraphOptions, folder: Path, console: Console, manner: Manner
) -> Outcome:
    """Load, launch, and say how it ended; raises as `load_graph`, `check_options` and `check_folder`."""
    from tactile_bringup.graph import check_options, load_graph

    graph = load_graph(task, scene, options)
    check_options(options, "--{} {}")
    check_folder(folder)
    return launch_graph(graph, folder, console, manner)


def launch_graph(graph: Graph, folder: Path, console: Console, manner: Manner) -> Outcome:
    """Launch a graph that was loaded before."""
    from tactile_bringup.launching.foxglove_layout import write_layout
    from tactile_bringup.launching.launcher import Launcher
    from tactile_bringup.launching.progress import Display
    from tactile_bringup.launching.view import write_view

    write_view(graph, folder)
    write_layout(graph, folder)
    live = console.is_terminal and not manner.headless
    with Display(console, live) as display:
        return Launcher(graph, folder.absolute(), display, manner).run()
