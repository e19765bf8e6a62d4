"""`ros2 launch` and RViz get what the graph has."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest
import yaml

from tactile_base.config_paths import config_path
from tactile_bringup.graph import GraphOptions, load_graph
from tactile_bringup.launching.view import write_view

needs_launch = pytest.mark.skipif(
    importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed (it has no wheels)"
)


def topics_of(display) -> list[str]:
    return [display["Topic"]["Value"]] if "Topic" in display else []


def test_rviz_shows_image_frames_belief_and_twist_of_topics_that_exist():
    config = yaml.safe_load(config_path("rviz/default.rviz").read_text())
    displays = config["Visualization Manager"]["Displays"]
    kinds = {display["Class"].split("/")[1] for display in displays}
    assert {"Image", "TF", "PoseWithCovariance", "TwistStamped"} <= kinds
    graph = load_graph("surface_following", "ramp", GraphOptions(object_belief=True))
    published = {topic.name for topic in graph.topics} | {"/arm/tactile/image", "/arm/tactile/marker_view"}
    assert {topic for display in displays for topic in topics_of(display)} <= published


@pytest.mark.parametrize("asked", [True, False])
def test_the_view_of_a_launch_shows_each_arm_and_the_object_where_there_is_one(tmp_path, asked):
    graph = load_graph("surface_following", "two_arms", GraphOptions(object_belief=asked))
    config = yaml.safe_load(write_view(graph, tmp_path / "run").read_text())
    displays = config["Visualization Manager"]["Displays"]
    shown = {topic: display for display in displays for topic in topics_of(display)}
    for arm in ("left", "right"):
        display = shown[f"/{arm}/contact/belief"]
        assert display["Name"] == f"Believed contact ({arm})" and display["Enabled"]
    assert not any(topic.startswith("/arm/") for topic in shown)
    believed = shown["/object/belief"]
    assert (believed["Enabled"], believed["Value"]) == (asked, asked)
    assert len({display["Name"] for display in displays}) == len(displays)


def test_the_view_of_one_arm_is_the_packaged_one(tmp_path):
    graph = load_graph("surface_following", "ramp")
    packaged = yaml.safe_load(config_path("rviz/default.rviz").read_text())
    assert yaml.safe_load(write_view(graph, tmp_path).read_text()) == packaged


@needs_launch
def test_the_launch_description_starts_the_nodes_of_the_graph(tmp_path, monkeypatch):
    from launch.actions import DeclareLaunchArgument, ExecuteProcess
    from launch_ros.actions import LifecycleNode

    from launch import LaunchContext
    from tactile_bringup.launching import launch_description

    monkeypatch.setattr(type(launch_description.launch_config), "log_dir", str(tmp_path))
    description = launch_description.describe("surface_following")
    declared = [e.name for e in description.entities if isinstance(e, DeclareLaunchArgument)]
    assert {"scene", "rate", "record", "headless"} <= set(declared)
    context = LaunchContext()
    for entity in description.entities[:-1]:
        entity.execute(context)
    actions = description.entities[-1].execute(context)
    nodes = [action for action in actions if isinstance(action, LifecycleNode)]
    graph = load_graph("surface_following", "ramp")
    assert [node.node_executable for node in nodes] == [node.executable for node in graph.nodes]
    assert sum(type(action) is ExecuteProcess for action in actions) == 1  # what runs the goals
    written = {file.stem for file in Path(tmp_path).glob("*.yaml")}
    assert written == {node.file_stem for node in graph.nodes}


@needs_launch
@pytest.mark.parametrize(
    ("argument", "value", "complaint"),
    [
        ("rate", "fast", "rate:=fast: must be a number"),
        ("rate", "500", "rate:=500: must lie in [1, 240] Hz"),
        ("seed", "1.5", "seed:=1.5: must be a whole number"),
        ("headless", "yes", "headless:=yes: must be true or false"),
        ("model", "/no/such.onnx", "model:=/no/such.onnx: no such file"),
    ],
)
def test_a_wrong_argument_of_a_launch_file_is_refused_in_a_sentence(argument, value, complaint):
    from launch import LaunchContext
    from tactile_bringup.launching import launch_description

    context = LaunchContext()
    description = launch_description.describe("surface_following")
    for entity in description.entities[:-1]:
        entity.execute(context)
    context.launch_configurations[argument] = value
    with pytest.raises(ValueError, match=re.escape(complaint)):
        description.entities[-1].execute(context)


@needs_launch
@pytest.mark.parametrize(("code", "what", "ends_with"), [(-11, "node /arm/filter", 1), (0, "the task", 0)])
def test_a_launch_ends_with_1_when_a_node_dies_and_with_0_when_the_task_is_done(code, what, ends_with):
    from launch.actions import ExecuteProcess

    from launch import LaunchDescription, LaunchService
    from tactile_bringup.launching import launch_description

    service = LaunchService(noninteractive=True)
    dying = f"import os, signal; os.kill(os.getpid(), {-code}) if {code} else None"
    process = ExecuteProcess(cmd=[sys.executable, "-c", dying], on_exit=launch_description._shut_down(what))
    other = ExecuteProcess(cmd=[sys.executable, "-c", "import time; time.sleep(60)"])
    service.include_launch_description(LaunchDescription([process, other]))
    assert service.run() == ends_with


def test_each_launch_file_is_one_of_its_task():
    files = sorted((config_path("tasks/pushing.yaml").parents[2] / "launch").glob("*.launch.py"))
    tasks = [file.name.removesuffix(".launch.py") for file in files]
    assert {"surface_following", "object_tracking", "pushing", "dual_pushing"} <= set(tasks)
    for task, file in zip(tasks, files, strict=True):
        assert f'describe("{task}")' in file.read_text()
        assert load_graph(task).task == task
