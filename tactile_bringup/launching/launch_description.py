"""What `ros2 launch` runs: the graph of a task as a launch description of `launch` and `launch_ros`.

The files in launch/ name a task; all else is here, made of the same graph that `tactile launch` starts.
Needs `launch` and `launch_ros`, which a ROS 2 install has.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.logging import launch_config
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

from launch import LaunchContext, LaunchDescription
from tactile_base.end_signals import LAUNCHER
from tactile_base.requirements import require_packages
from tactile_bringup.launching.processes import describe_exit

if TYPE_CHECKING:  # loads packages that may be missing
    from tactile_bringup.graph import Graph, GraphOptions, NodeProcess

Number = TypeVar("Number", int, float)

PACKAGE = "tactile_servoing"
TASK = "the task"
SIGTERM_TIMEOUT = "8"  # s after SIGINT; longer than nodes take to end in order (`ManagedNode.patience`)
FLAGS = ("true", "false")
ARGUMENTS = {
    "scene": ("", "scene of config/scenes, or the path of a file; empty: the first that the task names"),
    "task_file": ("", "a task file of your own in place of the packaged one"),
    "rate": ("0", "exposures a second; 0: as the scene says"),
    "seed": ("0", "seed of the simulated cell"),
    "model": ("", "model of all estimators; empty: each sensor's in the scene"),
    "filter": ("", "one of config/filters, or the path of a file; empty: config/filter.yaml"),
    "controller": ("", "one of config/controllers in place of the task's"),
    "set": ("", "settings on top of the files, ROLE.GROUP.NAME=VALUE, several divided by blanks"),
    "goals": ("", "names of the goals to run, divided by blanks; empty: all"),
    "record": ("", "folder of a new bag to record; empty: none"),
    "record_images": ("false", "whether images are recorded as well (true, false)"),
    "marker_view": ("false", "whether to publish a picture of the markers for RViz (true, false)"),
    "object_belief": (
        "false",
        "whether to fuse the contacts of all arms into one belief over their object (true, false), "
        "or what says where they touch it: one of config/objects, or the path of a file",
    ),
    "headless": ("false", "whether to do without RViz (true, false)"),
    "run": ("true", "whether to run the task's goals once all nodes are active, then end (true, false)"),
}


def describe(task: str) -> LaunchDescription:
    """The launch description of a task, with its arguments."""
    require_packages()
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=lambda context: _actions(task, context))])


def _actions(task: str, context: LaunchContext) -> list[Any]:
    from tactile_bringup.graph import check_options, load_graph

    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    task = given["task_file"] or task
    options = _options(given)
    check_options(options, "{}:={}")
    graph = load_graph(task, given["scene"] or None, options)
    actions = [_node(node, Path(launch_config.log_dir)) for node in graph.nodes]
    if not _flag(given, "headless"):
        actions += _viewer(graph, Path(launch_config.log_dir))
    if _flag(given, "run"):
        actions.append(_runner(task, graph.scene_file, given["goals"].split()))
    return actions


def _options(given: dict[str, str]) -> GraphOptions:
    from tactile_bringup.graph import GraphOptions

    places = "" if given["object_belief"].lower() in FLAGS else given["object_belief"]
    return GraphOptions(
        rate=_number(given, "rate", float) or None,
        seed=_number(given, "seed", int),
        model=Path(given["model"]) if given["model"] else None,
        filter=given["filter"],
        controller=given["controller"] or None,
        changes=tuple(given["set"].split()),
        goals=tuple(given["goals"].split()),
        record=Path(given["record"]) if given["record"] else None,
        record_images=_flag(given, "record_images"),
        marker_view=_flag(given, "marker_view"),
        object_belief=bool(places) or _flag(given, "object_belief"),
        object_file=places,
    )


def _number(given: dict[str, str], name: str, kind: type[Number]) -> Number:
    try:
        return kind(given[name])
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise ValueError(f"{name}:={given[name]}: must be {what}") from None


def _flag(given: dict[str, str], name: str) -> bool:
    text = given[name].lower()
    if text not in FLAGS:
        raise ValueError(f"{name}:={given[name]}: must be true or false")
    return text == "true"


def _node(node: NodeProcess, folder: Path) -> LifecycleNode:
    """A node with its parameters in a file, as `tactile launch` gives them; its end is the end of all."""
    file = folder / f"{node.file_stem}.yaml"
    file.write_text(node.parameter_text())
    return LifecycleNode(
        package=PACKAGE,
        executable=node.executable,
        name=node.name,
        namespace=node.namespace,
        parameters=[str(file)],
        output="both",
        on_exit=_shut_down(f"node {node.full_name}"),
        **_ending(),
    )


def _runner(task: str, scene: Path, goals: list[str]) -> ExecuteProcess:
    command = [sys.executable, "-m", "tactile_bringup.cli", "run", task, "--scene", str(scene), "--headless"]
    command += ["--goals", *goals] if goals else []
    return ExecuteProcess(cmd=command, output="screen", name="task", on_exit=_shut_down(TASK), **_ending())


def _ending() -> dict[str, Any]:
    """What lets a process end in order: time for it, and whom to end with where nobody asks it to."""
    patience = LaunchConfiguration("sigterm_timeout", default=SIGTERM_TIMEOUT)
    return {"sigterm_timeout": patience, "additional_env": {LAUNCHER: str(os.getpid())}}


def _shut_down(what: str) -> Callable[[ProcessExited, LaunchContext], list[Any] | None]:
    """What to do when a node or the task ends: shut down, with exit code 1 where that is a failure."""

    def on_exit(event: ProcessExited, context: LaunchContext) -> list[Any] | None:
        asked, code = context.is_shutdown, event.returncode
        reason = f"{what} {describe_exit(code)}"
        failed = code != 0 and not asked if what == TASK else code != 0 or not asked
        if failed:  # nothing else makes `ros2 launch` end with 1
            context.asyncio_loop.call_exception_handler({"message": reason})
        return None if asked else [LogInfo(msg=f"{reason}: stopping everything"), Shutdown(reason=reason)]

    return on_exit


def _viewer(graph: Graph, folder: Path) -> list[Any]:
    """RViz where it is installed; closing it ends nothing."""
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return [LogInfo(msg="rviz2 is not installed: going without (headless:=true says so beforehand)")]
    from tactile_bringup.launching.view import write_view

    arguments = ["-d", str(write_view(graph, folder))]
    return [Node(package="rviz2", executable="rviz2", arguments=arguments, output="log")]
