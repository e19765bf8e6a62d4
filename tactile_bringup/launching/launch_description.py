"""What `ros2 launch` runs: the graph of a task as a launch description of `launch` and `launch_ros`.

The files in launch/ name a task; all else is here, made of the same graph that `tactile launch` starts. That
of `servoing.launch.py` is one arm's part of it, within somebody else's launch (`attached_arm`). Needs
`launch` and `launch_ros`, which a ROS 2 install has.
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

OnExit = Callable[[ProcessExited, LaunchContext], list[Any] | None]

PACKAGE = "tactile_servoing"
PUSHED = "ros_namespace"  # where launch_ros keeps what PushRosNamespace has said
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
    "controller": ("", "one of config/controllers, or a file, in place of the task's"),
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
    "rehearse": ("false", "whether to take doubles of the arms, and simulated cameras (true, false)"),
    "run": ("true", "whether to run the task's goals once all nodes are active, then end (true, false)"),
}
SERVOING_ARGUMENTS = {
    "task": ("surface_following", "one of config/tasks, or the path of a file, that gives the arm its role"),
    "scene": ARGUMENTS["scene"],
    "arm": ("", "name of the arm in the scene; empty: the only one with a role"),
    "namespace": ("", "of the nodes, below a pushed one unless it begins with /; empty: the arm's name"),
    "base_frame": ("", "where the arm stands; empty: <namespace>/base"),
    "tool_frame": ("", "its flange; empty: <namespace>/tool"),
    "sensor_frame": ("", "the tactile sensor; empty: <namespace>/tactile_sensor"),
    "contact_frame": ("", "what it touches, by the belief; empty: <namespace>/contact"),
    "image_topic": ("", "images of the sensor; empty: tactile/image"),
    "twist_topic": ("", "twists for an arm that others drive; empty: command/twist"),
    "arm_node": ("true", "whether to start the safe command stage; false: it runs already (true, false)"),
    "use_sim_time": ("false", "whether time is that of /clock (true, false)"),
    "params_file": ("", "ROS parameters on top of all others"),
    **{name: ARGUMENTS[name] for name in ("model", "filter", "controller", "set", "marker_view")},
}


def describe(task: str) -> LaunchDescription:
    """The launch description of a task, with its arguments."""
    return _described(ARGUMENTS, lambda context: _actions(task, context))


def describe_servoing() -> LaunchDescription:
    """The launch description of one arm's nodes, with its arguments."""
    return _described(SERVOING_ARGUMENTS, _servoing_actions)


def _described(
    arguments: dict[str, tuple[str, str]], actions: Callable[[LaunchContext], list[Any]]
) -> LaunchDescription:
    require_packages()
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in arguments.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])


def _given(arguments: dict[str, tuple[str, str]], context: LaunchContext) -> dict[str, str]:
    defaults = {name: default for name, (default, _) in ARGUMENTS.items()}
    return defaults | {name: LaunchConfiguration(name).perform(context) for name in arguments}


def _servoing_actions(context: LaunchContext) -> list[Any]:
    from tactile_bringup.attached_arm import Place, load_servoing_graph
    from tactile_bringup.graph import check_options
    from tactile_bringup.launching.start_check import check_start

    given = _given(SERVOING_ARGUMENTS, context)
    options = _options(given)
    check_options(options, "{}:={}")
    place = Place(
        namespace=given["namespace"],
        within=context.launch_configurations.get(PUSHED, ""),
        **{name: given[name] for name in given if name.endswith(("_frame", "_topic"))},
        arm_node=_flag(given, "arm_node"),
        use_sim_time=_flag(given, "use_sim_time"),
        params_file=Path(given["params_file"]) if given["params_file"] else None,
    )
    graph = load_servoing_graph(given["task"], given["scene"] or None, given["arm"], place, options)
    check_start(graph)
    return [_node(node, Path(launch_config.log_dir)) for node in graph.nodes]


def _actions(task: str, context: LaunchContext) -> list[Any]:
    from tactile_bringup.graph import check_options, load_graph
    from tactile_bringup.launching.start_check import check_start

    given = _given(ARGUMENTS, context)
    if pushed := context.launch_configurations.get(PUSHED, "").strip("/"):
        raise ValueError(
            f"PushRosNamespace '{pushed}' around {task}.launch.py: a whole cell has names of its own; "
            "servoing.launch.py starts one arm's nodes in any namespace"
        )
    task = given["task_file"] or task
    options = _options(given)
    check_options(options, "{}:={}")
    graph = load_graph(task, given["scene"] or None, options)
    check_start(graph)
    folder = Path(launch_config.log_dir)
    actions = [_node(node, folder, _shut_down(f"node {node.full_name}")) for node in graph.nodes]
    actions += [LogInfo(msg=remark) for remark in graph.remarks]
    if not _flag(given, "headless"):
        actions += _viewer(graph, folder)
    if _flag(given, "run"):
        actions.append(_runner(task, graph.scene_file, options))
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
        rehearse=_flag(given, "rehearse"),
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


def _node(node: NodeProcess, folder: Path, on_exit: OnExit | None = None) -> LifecycleNode:
    """A node with its parameters in a file, as `tactile launch` gives them."""
    file = folder / f"{node.file_stem}.yaml"
    file.write_text(node.parameter_text())
    return LifecycleNode(
        package=PACKAGE,
        executable=node.executable,
        name=node.name,
        namespace=node.namespace,
        parameters=[str(file), *([str(node.params_file)] if node.params_file is not None else [])],
        remappings=list(node.remappings),
        ros_arguments=["--enclave", node.full_name],
        output="both",
        on_exit=on_exit,
        **_ending(),
    )


def _runner(task: str, scene: Path, options: GraphOptions) -> ExecuteProcess:
    command = [sys.executable, "-m", "tactile_bringup.cli", "run", task, "--scene", str(scene), "--headless"]
    command += ["--goals", *options.goals] if options.goals else []
    command += ["--rehearse"] if options.rehearse else []
    return ExecuteProcess(cmd=command, output="screen", name="task", on_exit=_shut_down(TASK), **_ending())


def _ending() -> dict[str, Any]:
    """What lets a process end in order: time for it, and whom to end with where nobody asks it to."""
    patience = LaunchConfiguration("sigterm_timeout", default=SIGTERM_TIMEOUT)
    return {"sigterm_timeout": patience, "additional_env": {LAUNCHER: str(os.getpid())}}


def _shut_down(what: str) -> OnExit:
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
