"""The graph has what the scene names and nothing else; what is wrong in a scene or task is said plainly."""

import ast
import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from tactile_base.config_paths import config_names, config_path
from tactile_base.settings import SettingError
from tactile_bringup.graph import Graph, GraphOptions, load_graph
from tactile_control.task_file import OTHER

TASK = """\
roles:
  follower:
    task: surface_following
    controller: surface_following
    settings: {task: {speed: 0.012}}
scenes:
  bench:
    follower:
      goals: [{name: there, direction_deg: 0}, {name: back, direction_deg: 180}]
"""

# each packaged task on each of its scenes
PACKAGED = [
    (task, scene)
    for task in config_names("tasks")
    for scene in yaml.safe_load(config_path(f"tasks/{task}.yaml").read_text())["scenes"]
    if scene != OTHER
]

IDEAL_SCENE = """
arms:
  arm:
    start: {position: [0, 0, 0.1]}
    sensor: {}
simulation: {sensors: {arm: {fidelity: ideal}}}
"""


@pytest.fixture
def bench(tmp_path):
    """The scene and a task on it; an arm is said by the fidelity of its sensor, None for an arm without."""

    def make(options: GraphOptions | None = None, rate: int = 60, **arms: str | None) -> Graph:
        arms = arms or {"left": "image"}
        described = {
            name: {"start": {"position": [0, 0, 0.1]}}
            | ({"sensor": {"camera_rate": rate}} if fidelity else {})
            for name, fidelity in arms.items()
        }
        sensors = {name: {"fidelity": fidelity} for name, fidelity in arms.items() if fidelity}
        scene, task = tmp_path / "bench.yaml", tmp_path / "wipe.yaml"
        scene.write_text(yaml.safe_dump({"arms": described, "simulation": {"sensors": sensors}}))
        task.write_text(TASK)
        return load_graph(str(task), str(scene), options)

    return make


def names(graph) -> list[str]:
    return [node.full_name for node in graph.nodes]


def test_one_arm_has_one_of_each_node(bench):
    graph = bench()
    assert names(graph) == ["/sim", "/left/estimator", "/left/filter", "/left/controller"]
    assert graph.arms == ("left",)


def test_the_filter_gets_the_values_of_its_file():
    graph = load_graph("surface_following", "ramp")
    values = yaml.safe_load(config_path("filter.yaml").read_text())
    assert dict(graph.node("/arm/filter").parameters) == values


def test_a_second_arm_exists_only_where_the_scene_has_one(bench):
    graph = bench(left="image", right="image")
    assert names(graph).count("/right/controller") == 1
    assert sum(name.endswith("/filter") for name in names(graph)) == 2
    assert "right" not in str(bench().nodes) + str(bench().topics)


def test_an_arm_without_a_sensor_has_no_part_in_a_task_that_feels(bench):
    graph = bench(left="image", holder=None)
    assert not any(name.startswith("/holder/") for name in names(graph))
    assert graph.arms == ("left",)
    topics = [topic.name for topic in graph.topics if topic.name.startswith("/holder/")]
    assert "/holder/arm/pose" in topics and "/holder/contact/state" not in topics


def test_a_sensor_without_images_needs_no_estimator(bench):
    assert names(bench(left="ideal")) == ["/sim", "/left/filter", "/left/controller"]


def test_the_marker_view_is_there_only_where_it_is_asked_for_and_has_images(bench):
    arms = {"left": "image", "right": "ideal"}
    viewers = [n for n in names(bench(GraphOptions(marker_view=True), **arms)) if "view" in n]
    assert viewers == ["/left/marker_view"]
    assert not any("view" in name for name in names(bench(**arms)))


def test_the_belief_over_an_object_is_there_only_where_it_is_asked_for(bench):
    arms = {"left": "image", "right": "ideal", "blind": None}
    graph = bench(GraphOptions(object_belief=True, record=Path("/bags/one")), **arms)
    assert graph.node("/object").parameters == {"arms": ["left", "right"]}
    assert (
        "/object/belief geometry_msgs/msg/PoseWithCovarianceStamped reliable"
        in (graph.nodes[0].parameters["topics"])
    )
    plain = bench(**arms)
    assert "/object" not in names(plain) and not any("object" in topic.name for topic in plain.topics)


def test_the_object_node_gets_the_values_of_its_file(tmp_path):
    file = tmp_path / "box.yaml"
    file.write_text("settings: {max_age: 0.1}\nplaces: {arm: {position: [0, 0.03, 0]}}\n")
    options = GraphOptions(object_belief=True, object_file=str(file))
    values = load_graph("surface_following", "ramp", options).node("/object").parameters
    assert (values["arms"], values["max_age"]) == (["arm"], 0.1)
    assert (values["place.arm.given"], values["place.arm.pose"][1]) == (True, 0.03)


def test_a_place_of_an_arm_that_the_scene_does_not_have_is_refused(tmp_path):
    file = tmp_path / "box.yaml"
    file.write_text("places: {left: {}}\n")
    with pytest.raises(SettingError, match=r"box\.yaml:1: places: unknown name 'left'; valid: arm"):
        load_graph("surface_following", "ramp", GraphOptions(object_belief=True, object_file=str(file)))


def test_nothing_is_recorded_unless_asked_for(bench):
    assert "/recorder" not in names(bench())


def test_a_recorder_starts_first_and_leaves_raw_images_out(bench):
    graph = bench(GraphOptions(record=Path("/bags/one")))
    recorder = graph.nodes[0]
    assert recorder.full_name == "/recorder" and recorder.parameters["bag"] == "/bags/one"
    recorded = [text.split()[0] for text in recorder.parameters["topics"]]
    assert {"/left/contact/state", "/left/latency", "/tf", "/tf_static", "/diagnostics"} <= set(recorded)
    assert "/left/tactile/image" not in recorded and recorder.parameters["images"] == []


def test_images_are_recorded_on_request(bench):
    options = GraphOptions(record=Path("/bags/one"), record_images=True)
    graph = bench(options, left="image", right="ideal")
    assert graph.nodes[0].parameters["images"] == ["/left/tactile/image"]


def test_the_bag_knows_how_its_nodes_were_set(bench):
    graph = bench(GraphOptions(record=Path("/bags/one"), seed=3))
    note = dict(text.split("=", 1) for text in graph.nodes[0].parameters["note"])
    assert json.loads(note["parameters"])["/left/controller"]["task.speed"] == 0.012
    role = json.loads(note["roles"])["left"]
    assert (role["role"], role["task"], role["goals"]) == ("follower", "surface_following", ["there", "back"])
    assert (note["task"], note["seed"], note["scene"]) == ("wipe", "3", "bench")
    assert note["scene_file"] == str(graph.scene_file)


def test_options_reach_the_nodes_that_they_are_for(bench):
    options = GraphOptions(rate=120.0, seed=5, model=Path("/models/other.onnx"))
    graph = bench(options)
    assert graph.node("/sim").parameters["camera_rate"] == 120.0
    assert graph.node("/sim").parameters["seed"] == 5
    assert graph.node("/left/estimator").parameters == {"images.rate": 120.0, "model": "/models/other.onnx"}


def test_without_options_the_scene_and_the_nodes_decide(bench):
    graph = bench(rate=30)
    assert "camera_rate" not in graph.node("/sim").parameters
    assert graph.node("/left/estimator").parameters == {"images.rate": 30.0}


def test_a_parameter_file_is_for_one_node_and_leaves_out_empty_lists(bench):
    node = bench(GraphOptions(record=Path("/b"))).nodes[0]
    values = yaml.safe_load(node.parameter_text())["/recorder"]["ros__parameters"]
    assert "images" not in values and values["bag"] == "/b" and values["autostart"] is True
    controller = bench().node("/left/controller")
    given = yaml.safe_load(controller.parameter_text())["/left/controller"]["ros__parameters"]
    assert given["servoing.reference"] == [0.0, 0.0, 0.003, 0.0, 0.0, 0.0]


def test_a_node_is_run_under_its_name_and_namespace(bench):
    command = bench().node("/left/filter").command(Path("p.yaml"), python="python3")
    assert command[:4] == ["python3", "-m", "tactile_ros.nodes.filter_node", "--ros-args"]
    assert "__node:=filter" in command and "__ns:=/left" in command and command[-1] == "p.yaml"


def test_an_unknown_node_is_an_error_that_lists_those_there_are(bench):
    with pytest.raises(KeyError, match=r"/left/camera; nodes: /sim, /left/estimator"):
        bench().node("/left/camera")


def test_the_packaged_object_has_places_for_all_arms_of_its_scene():
    options = GraphOptions(object_belief=True, object_file="two_arms")
    values = load_graph("surface_following", "two_arms", options).node("/object").parameters
    assert values["place.left.given"] and values["place.right.given"]
    with pytest.raises(FileNotFoundError, match=r"object: unknown name 'two_arm' .did you mean 'two_arms'"):
        load_graph("surface_following", "two_arms", replace(options, object_file="two_arm"))


@pytest.mark.parametrize("task, scene", PACKAGED)
def test_every_node_of_the_packaged_scenes_exists_as_module(task, scene):
    graph = load_graph(task, scene, GraphOptions(record=Path("/bags/one")))
    assert graph.scene == scene and all(plan.goals for plan in graph.plans)
    for node in graph.nodes:
        assert importlib.util.find_spec(node.module) is not None, node.module


def test_every_packaged_scene_has_a_task():
    assert {scene for _, scene in PACKAGED} == set(config_names("scenes"))


def test_every_node_of_a_graph_is_an_executable_of_the_package(bench):
    setup = Path(__file__).resolve().parents[2] / "setup.py"
    if not setup.is_file():
        pytest.skip("the tests run without the source tree")
    assignments = [n for n in ast.parse(setup.read_text()).body if isinstance(n, ast.Assign)]
    executables = next(ast.literal_eval(a.value) for a in assignments if a.targets[0].id == "NODES")
    options = GraphOptions(record=Path("/b"), marker_view=True, object_belief=True)
    for node in bench(options).nodes:
        assert executables[node.executable] == node.module


def test_the_dome_has_eight_goals():
    assert len(load_graph("surface_following", "dome").plans[0].goals) == 8


def test_an_unknown_scene_lists_the_scenes():
    with pytest.raises(SettingError, match=r"'ram' .did you mean 'ramp'.*dome, .*ramp"):
        load_graph("surface_following", "ram")
    assert {"dome", "ramp"} <= set(config_names("scenes"))


def test_a_scene_file_with_a_typo_names_file_line_and_choices(tmp_path):
    file = tmp_path / "ramp.yaml"
    file.write_text("arms:\n  arm:\n    drivr: sim\n    start: {position: [0, 0, 0.1]}\n")
    with pytest.raises(SettingError, match=r"ramp\.yaml:3: .*'drivr' .did you mean 'driver'"):
        load_graph("surface_following", str(file))


def test_a_scene_that_the_task_has_no_goals_for_is_refused(tmp_path):
    file = tmp_path / "kitchen.yaml"
    file.write_text(IDEAL_SCENE)
    with pytest.raises(SettingError, match=r"no goals for this scene: unknown name 'kitchen'.*pushing"):
        load_graph("pushing", str(file))


def test_a_scene_of_ones_own_is_followed_for_a_short_way(tmp_path):
    file = tmp_path / "kitchen.yaml"
    file.write_text(IDEAL_SCENE)
    (goal,) = load_graph("surface_following", str(file)).plans[0].goals
    assert (goal.name, goal.goal.length) == ("across", 0.05)


def test_a_scene_and_a_task_of_ones_own_run_with_the_packaged_controllers(tmp_path):
    scene, task = tmp_path / "kitchen.yaml", tmp_path / "wipe.yaml"
    scene.write_text(IDEAL_SCENE)
    task.write_text(
        "roles:\n  wiper: {task: surface_following, controller: surface_following_tuned}\n"
        "scenes:\n  kitchen:\n    wiper: {goals: [{name: table, direction_deg: 0, length: 0.3}]}\n"
    )
    graph = load_graph(str(task), str(scene))
    assert (graph.task, graph.scene) == ("wipe", "kitchen")
    assert [goal.name for goal in graph.plans[0].goals] == ["table"]
    assert graph.node("/arm/controller").parameters["pid.ki"][3] == 4.0


def test_an_unknown_task_lists_the_tasks():
    with pytest.raises(SettingError, match=r"'surface_folowing' .did you mean 'surface_following'"):
        load_graph("surface_folowing", "ramp")


@pytest.mark.parametrize("task, scene", PACKAGED)
def test_a_graph_has_the_topics_that_its_recorder_records(task, scene):
    graph = load_graph(task, scene, GraphOptions(record=Path("/bags/one")))
    recorded = [text.split()[0] for text in graph.nodes[0].parameters["topics"]]
    assert recorded == [topic.name for topic in graph.topics]


def test_without_a_scene_it_is_the_first_that_the_task_names():
    assert load_graph("surface_following").scene == "ramp"


def test_chosen_goals_controller_and_changes_reach_plans_and_nodes():
    options = GraphOptions(
        goals=("theta_2",), controller="surface_following", changes=("task.speed=0.02", "pid.ewma_decay=0.7")
    )
    graph = load_graph("surface_following", "dome", options)
    assert [goal.name for goal in graph.plans[0].goals] == ["theta_2"]
    given = graph.node("/arm/controller").parameters
    assert (given["task_name"], given["controlled_frame"]) == ("surface_following", "tactile_sensor")
    assert (given["task.speed"], given["pid.ewma_decay"], given["pid.ki"][3]) == (0.02, 0.7, 0.1)


def test_an_arm_that_only_moves_has_a_controller_of_its_tool_and_nothing_that_feels(tmp_path):
    scene, task = tmp_path / "shelf.yaml", tmp_path / "lead.yaml"
    scene.write_text("arms:\n  mover:\n    start: {position: [0, 0, 0.1]}\n")
    task.write_text(
        "roles:\n  leader: {task: trajectory}\n"
        "scenes:\n  shelf:\n    leader: {goals: [{displacement: [0.02, 0, 0, 0, 0, 0]}]}\n"
    )
    graph = load_graph(str(task), str(scene))
    assert names(graph) == ["/sim", "/mover/controller"]
    given = graph.node("/mover/controller").parameters
    assert (given["task_name"], given["controlled_frame"]) == ("trajectory", "tool")
