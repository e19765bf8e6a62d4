"""The graph has what the scene names and nothing else; what is wrong in a scene or task is said plainly."""

import ast
import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from tactile_base.config_paths import config_names, config_path
from tactile_base.settings import SettingError
from tactile_bringup.graph import ArmOutline, GraphOptions, SceneOutline, build_graph
from tactile_bringup.task_graph import load_task_graph

CONTROLLER = {"pid": {"gain": 2.0}, "task": {"speed": 0.01, "reference": (0.0, 0.0, 0.003)}}

IDEAL_SCENE = """
arms:
  arm:
    start: {position: [0, 0, 0.1]}
    sensor: {}
simulation: {sensors: {arm: {fidelity: ideal}}}
"""


def graph_of(*arms: ArmOutline, options: GraphOptions | None = None):
    scene = SceneOutline("bench", Path("/scenes/bench.yaml"), arms)
    return build_graph("surface_following", scene, CONTROLLER, ["there", "back"], options)


def names(graph) -> list[str]:
    return [node.full_name for node in graph.nodes]


def test_one_arm_has_one_of_each_node():
    graph = graph_of(ArmOutline("left"))
    assert names(graph) == ["/sim", "/left/estimator", "/left/filter", "/left/controller"]
    assert graph.arms == ("left",)


def test_the_filter_gets_the_values_of_its_file():
    graph = load_task_graph("surface_following", "ramp", GraphOptions()).graph
    values = yaml.safe_load(config_path("filter.yaml").read_text())
    assert dict(graph.node("/arm/filter").parameters) == values


def test_a_second_arm_exists_only_where_the_scene_has_one():
    graph = graph_of(ArmOutline("left"), ArmOutline("right"))
    assert names(graph).count("/right/controller") == 1
    assert sum(name.endswith("/filter") for name in names(graph)) == 2
    assert "right" not in str(graph_of(ArmOutline("left")))


def test_an_arm_without_a_sensor_is_not_perceived_or_controlled():
    graph = graph_of(ArmOutline("left"), ArmOutline("holder", camera_rate=None, images=False))
    assert not any(name.startswith("/holder/") for name in names(graph))
    assert graph.arms == ("left",)
    topics = [topic.name for topic in graph.topics if topic.name.startswith("/holder/")]
    assert "/holder/arm/pose" in topics and "/holder/contact/state" not in topics


def test_a_sensor_without_images_needs_no_estimator():
    assert names(graph_of(ArmOutline("left", images=False))) == ["/sim", "/left/filter", "/left/controller"]


def test_the_marker_view_is_there_only_where_it_is_asked_for_and_has_images():
    arms = (ArmOutline("left"), ArmOutline("right", images=False))
    viewers = [n for n in names(graph_of(*arms, options=GraphOptions(marker_view=True))) if "view" in n]
    assert viewers == ["/left/marker_view"]
    assert not any("view" in name for name in names(graph_of(*arms)))


def test_the_belief_over_an_object_is_there_only_where_it_is_asked_for():
    arms = (ArmOutline("left"), ArmOutline("right", images=False), ArmOutline("blind", camera_rate=None))
    graph = graph_of(*arms, options=GraphOptions(object_belief=True, record=Path("/bags/one")))
    assert graph.node("/object").parameters == {"arms": ["left", "right"]}
    assert (
        "/object/belief geometry_msgs/msg/PoseWithCovarianceStamped reliable"
        in (graph.nodes[0].parameters["topics"])
    )
    plain = graph_of(*arms)
    assert "/object" not in names(plain) and "object" not in str(plain.topics)


def test_the_object_node_gets_the_values_of_its_file(tmp_path):
    file = tmp_path / "box.yaml"
    file.write_text("settings: {max_age: 0.1}\nplaces: {arm: {position: [0, 0.03, 0]}}\n")
    options = GraphOptions(object_belief=True, object_file=str(file))
    values = load_task_graph("surface_following", "ramp", options).graph.node("/object").parameters
    assert (values["arms"], values["max_age"]) == (["arm"], 0.1)
    assert (values["place.arm.given"], values["place.arm.pose"][1]) == (True, 0.03)


def test_a_place_of_an_arm_that_the_scene_does_not_have_is_refused(tmp_path):
    file = tmp_path / "box.yaml"
    file.write_text("places: {left: {}}\n")
    with pytest.raises(SettingError, match=r"box\.yaml:1: places: unknown name 'left'; valid: arm"):
        load_task_graph("surface_following", "ramp", GraphOptions(object_belief=True, object_file=str(file)))


def test_nothing_is_recorded_unless_asked_for():
    assert "/recorder" not in names(graph_of(ArmOutline("left")))


def test_a_recorder_starts_first_and_leaves_raw_images_out():
    graph = graph_of(ArmOutline("left"), options=GraphOptions(record=Path("/bags/one")))
    recorder = graph.nodes[0]
    assert recorder.full_name == "/recorder" and recorder.parameters["bag"] == "/bags/one"
    recorded = [text.split()[0] for text in recorder.parameters["topics"]]
    assert {"/left/contact/state", "/left/latency", "/tf", "/tf_static", "/diagnostics"} <= set(recorded)
    assert "/left/tactile/image" not in recorded and recorder.parameters["images"] == []


def test_images_are_recorded_on_request():
    options = GraphOptions(record=Path("/bags/one"), record_images=True)
    graph = graph_of(ArmOutline("left"), ArmOutline("right", images=False), options=options)
    assert graph.nodes[0].parameters["images"] == ["/left/tactile/image"]


def test_the_bag_knows_how_its_nodes_were_set():
    graph = graph_of(ArmOutline("left"), options=GraphOptions(record=Path("/bags/one"), seed=3))
    note = dict(text.split("=", 1) for text in graph.nodes[0].parameters["note"])
    assert yaml.safe_load(note["parameters"])["/left/controller"]["pid.gain"] == 2.0
    assert yaml.safe_load(note["paths"]) == ["there", "back"]
    assert (note["seed"], note["scene"], note["scene_file"]) == ("3", "bench", "/scenes/bench.yaml")


def test_options_reach_the_nodes_that_they_are_for():
    options = GraphOptions(rate=120.0, seed=5, model=Path("/models/other.onnx"))
    graph = graph_of(ArmOutline("left"), options=options)
    assert graph.node("/sim").parameters["camera_rate"] == 120.0
    assert graph.node("/sim").parameters["seed"] == 5
    assert graph.node("/left/estimator").parameters == {"images.rate": 120.0, "model": "/models/other.onnx"}


def test_without_options_the_scene_and_the_nodes_decide():
    graph = graph_of(ArmOutline("left", camera_rate=30.0))
    assert "camera_rate" not in graph.node("/sim").parameters
    assert graph.node("/left/estimator").parameters == {"images.rate": 30.0}


def test_a_parameter_file_is_for_one_node_and_leaves_out_empty_lists():
    node = graph_of(ArmOutline("left"), options=GraphOptions(record=Path("/b"))).nodes[0]
    values = yaml.safe_load(node.parameter_text())["/recorder"]["ros__parameters"]
    assert "images" not in values and values["bag"] == "/b" and values["autostart"] is True
    controller = graph_of(ArmOutline("left")).node("/left/controller")
    given = yaml.safe_load(controller.parameter_text())["/left/controller"]["ros__parameters"]
    assert given["task.reference"] == [0.0, 0.0, 0.003]


def test_a_node_is_run_under_its_name_and_namespace():
    command = graph_of(ArmOutline("left")).node("/left/filter").command(Path("p.yaml"), python="python3")
    assert command[:4] == ["python3", "-m", "tactile_ros.nodes.filter_node", "--ros-args"]
    assert "__node:=filter" in command and "__ns:=/left" in command and command[-1] == "p.yaml"


def test_an_unknown_node_is_an_error_that_lists_those_there_are():
    with pytest.raises(KeyError, match=r"/left/camera; nodes: /sim, /left/estimator"):
        graph_of(ArmOutline("left")).node("/left/camera")


def test_the_packaged_object_has_places_for_all_arms_of_its_scene():
    options = GraphOptions(object_belief=True, object_file="two_arms")
    values = load_task_graph("surface_following", "two_arms", options).graph.node("/object").parameters
    assert values["place.left.given"] and values["place.right.given"]
    with pytest.raises(FileNotFoundError, match=r"object: unknown name 'two_arm' .did you mean 'two_arms'"):
        load_task_graph("surface_following", "two_arms", replace(options, object_file="two_arm"))


@pytest.mark.parametrize("scene", config_names("scenes"))
def test_every_node_of_the_packaged_scenes_exists_as_module(scene):
    loaded = load_task_graph("surface_following", scene, GraphOptions(record=Path("/bags/one")))
    assert loaded.graph.scene == scene and loaded.paths
    for node in loaded.graph.nodes:
        assert importlib.util.find_spec(node.module) is not None, node.module


def test_every_node_of_a_graph_is_an_executable_of_the_package():
    setup = Path(__file__).resolve().parents[2] / "setup.py"
    if not setup.is_file():
        pytest.skip("the tests run without the source tree")
    assignments = [n for n in ast.parse(setup.read_text()).body if isinstance(n, ast.Assign)]
    executables = next(ast.literal_eval(a.value) for a in assignments if a.targets[0].id == "NODES")
    options = GraphOptions(record=Path("/b"), marker_view=True, object_belief=True)
    for node in graph_of(ArmOutline("left"), options=options).nodes:
        assert executables[node.executable] == node.module


def test_the_dome_has_eight_paths():
    assert len(load_task_graph("surface_following", "dome", GraphOptions()).paths) == 8


def test_an_unknown_scene_lists_the_scenes():
    with pytest.raises(SettingError, match=r"'ram' .did you mean 'ramp'.*dome, .*ramp"):
        load_task_graph("surface_following", "ram", GraphOptions())
    assert {"dome", "ramp"} <= set(config_names("scenes"))


def test_a_scene_file_with_a_typo_names_file_line_and_choices(tmp_path):
    file = tmp_path / "ramp.yaml"
    file.write_text("arms:\n  arm:\n    drivr: sim\n    start: {position: [0, 0, 0.1]}\n")
    with pytest.raises(SettingError, match=r"ramp\.yaml:3: .*'drivr' .did you mean 'driver'"):
        load_task_graph("surface_following", str(file), GraphOptions())


def test_a_scene_that_the_task_has_no_paths_for_is_refused(tmp_path):
    file = tmp_path / "kitchen.yaml"
    file.write_text(IDEAL_SCENE)
    with pytest.raises(SettingError, match=r"no paths for this scene: unknown name 'kitchen'.*ramp"):
        load_task_graph("surface_following", str(file), GraphOptions())


def test_a_scene_and_a_task_of_ones_own_run_with_the_packaged_controllers(tmp_path):
    scene, task = tmp_path / "kitchen.yaml", tmp_path / "wipe.yaml"
    scene.write_text(IDEAL_SCENE)
    task.write_text(
        "task: surface_following\ncontroller: surface_following_tuned\n"
        "scenes:\n  kitchen:\n    paths:\n      - {name: table, direction_deg: 0, length: 0.3}\n"
    )
    loaded = load_task_graph(str(task), str(scene), GraphOptions())
    assert loaded.graph.task == "surface_following" and loaded.graph.scene == "kitchen"
    assert [path.name for path in loaded.paths] == ["table"]


def test_an_unknown_task_lists_the_tasks():
    with pytest.raises(SettingError, match=r"'surface_folowing' .did you mean 'surface_following'"):
        load_task_graph("surface_folowing", "ramp", GraphOptions())
