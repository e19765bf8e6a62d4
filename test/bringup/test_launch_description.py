"""`ros2 launch` and RViz get what the graph has."""

import dataclasses
import importlib.util
import re
import sys
from pathlib import Path

import pytest
import yaml

from tactile_base.config_paths import config_path
from tactile_base.topics import ROBOT_DESCRIPTION
from tactile_bringup.graph import GraphOptions, load_graph
from tactile_bringup.launching.view import write_view
from tactile_perception.estimating.estimator import shipped_model

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


def test_the_view_shows_an_arm_that_a_urdf_describes(tmp_path):
    graph = load_graph("surface_following", "two_arms")
    described = dataclasses.replace(graph, topics=(*graph.topics, ROBOT_DESCRIPTION.of("left")))
    displays = yaml.safe_load(write_view(described, tmp_path).read_text())["Visualization Manager"][
        "Displays"
    ]
    (model,) = (display for display in displays if display["Class"].endswith("/RobotModel"))
    assert model["Description Topic"]["Value"] == "/left/robot_description"
    assert model["TF Prefix"] == "left/urdf"


@pytest.fixture
def performed(tmp_path, monkeypatch):
    """The actions of a launch file of ours, with arguments, within a pushed namespace."""
    from launch.actions import DeclareLaunchArgument
    from launch_ros.actions import PushRosNamespace

    from launch import LaunchContext
    from tactile_bringup.launching import launch_description

    monkeypatch.setattr(type(launch_description.launch_config), "log_dir", str(tmp_path))

    def actions(task: str, pushed: str = "", **given: str) -> list:
        made = launch_description
        description = made.describe(task) if task != "servoing" else made.describe_servoing()
        declared = [e.name for e in description.entities if isinstance(e, DeclareLaunchArgument)]
        assert set(given) <= set(declared)
        context = LaunchContext()
        if pushed:
            PushRosNamespace(pushed).execute(context)
        for entity in description.entities[:-1]:
            entity.execute(context)
        context.launch_configurations.update(given)
        return description.entities[-1].execute(context)

    return actions


@needs_launch
@pytest.mark.parametrize("rehearse", [False, True])
def test_the_launch_description_starts_the_nodes_of_the_graph(tmp_path, performed, rehearse):
    from launch.actions import ExecuteProcess
    from launch_ros.actions import LifecycleNode

    scene = "ur_example" if rehearse else "ramp"
    actions = performed("surface_following", scene=scene, rehearse=str(rehearse).lower())
    nodes = [action for action in actions if isinstance(action, LifecycleNode)]
    graph = load_graph("surface_following", scene, GraphOptions(rehearse=rehearse))
    assert [node.node_executable for node in nodes] == [node.executable for node in graph.nodes]
    assert rehearse == ("rehearse: true" in (tmp_path / "sim.yaml").read_text())
    (runner,) = (action for action in actions if type(action) is ExecuteProcess)
    words = [part.text for word in runner.cmd for part in word]
    assert "run" in words and rehearse == ("--rehearse" in words)
    written = {file.stem for file in Path(tmp_path).glob("*.yaml")}
    assert written == {node.file_stem for node in graph.nodes}


@needs_launch
@pytest.mark.parametrize(
    ("pushed", "given", "names"),
    [
        ("", {}, "/arm/"),
        ("lab", {}, "/lab/arm/"),
        ("lab", {"namespace": "left"}, "/lab/left/"),
        ("lab", {"namespace": "/left"}, "/left/"),
    ],
)
def test_a_launch_within_others_starts_nodes_where_they_say(tmp_path, performed, pushed, given, names):
    mine = tmp_path / "mine.txt"
    mine.write_text("{}")
    actions = performed(
        "servoing", pushed, scene="ur_example", image_topic="/camera", params_file=str(mine), **given
    )
    started = {(node.node_executable, node._Node__node_namespace) for node in actions}
    assert started == {(name, names[:-1]) for name in ("arm", "estimator", "filter", "controller")}
    text = (tmp_path / f"{names[1:].replace('/', '.')}filter.yaml").read_text()
    assert text.startswith(f"{names}filter:") and f"frames.base: {names[1:]}base" in text


@needs_launch
def test_a_namespace_pushed_around_the_launch_of_a_whole_cell_is_refused_with_what_would_be_right(performed):
    with pytest.raises(ValueError, match=r"PushRosNamespace 'lab' around .*servoing\.launch\.py starts"):
        performed("surface_following", pushed="lab")


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
def test_a_wrong_argument_of_a_launch_file_is_refused_in_a_sentence(performed, argument, value, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)):
        performed("surface_following", **{argument: value})


@needs_launch
def test_a_damaged_model_is_refused_before_a_node_is_started(performed, tmp_path):
    (tmp_path / "cut.onnx").write_bytes(shipped_model().read_bytes()[:60_000])
    with pytest.raises(ValueError, match=r"model of /arm/estimator: .*cut\.onnx: "):
        performed("surface_following", model=str(tmp_path / "cut.onnx"))


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
    folder = config_path("tasks/pushing.yaml").parents[2] / "launch"
    files = sorted(set(folder.glob("*.launch.py")) - {folder / "servoing.launch.py"})
    tasks = [file.name.removesuffix(".launch.py") for file in files]
    assert {"surface_following", "object_tracking", "pushing", "dual_pushing"} <= set(tasks)
    for task, file in zip(tasks, files, strict=True):
        assert f'describe("{task}")' in file.read_text()
        assert load_graph(task).task == task
