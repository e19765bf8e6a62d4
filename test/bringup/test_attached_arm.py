"""One arm's part of a task stands where its user says; what cannot be is refused in a sentence."""

import re
from pathlib import Path

import pytest

from tactile_base.config_paths import config_path
from tactile_base.topics import ARM_STATUS, BELIEF, DIAGNOSTICS
from tactile_bringup.attached_arm import Place, load_servoing_graph
from tactile_bringup.cli import main
from tactile_bringup.commands import run
from tactile_bringup.graph import Graph, load_graph


def test_without_names_of_its_own_an_arm_stands_where_it_does_in_the_whole_cell():
    whole = load_graph("surface_following", "ur_example")
    part = load_servoing_graph("surface_following", "ur_example", "", Place())
    assert [node.full_name for node in part.nodes] == [node.full_name for node in whole.nodes]
    assert (part.arms, part.topics) == (whole.arms, whole.topics)
    assert part.nodes[0].parameters["frames.sensor"] == "arm/tactile_sensor"
    assert not any(node.remappings for node in part.nodes)


def test_names_of_ones_own_reach_every_node_of_the_arm_and_no_other():
    place = Place(
        "left", "/lab", tool_frame="tool0", image_topic="/image", twist_topic="/servo", use_sim_time=True
    )
    graph = load_servoing_graph("object_tracking", "tracking_cube", "follower", place)
    assert {node.full_name for node in graph.nodes} == {
        f"/lab/left/{name}" for name in ("estimator", "filter", "controller")
    }  # what simulates the arm is not started, nor is the leader
    for node in graph.nodes:
        assert node.parameters["arm"] == "follower" and node.parameters["use_sim_time"]
        assert node.parameters["frames.base"] == "lab/left/base" and node.parameters["frames.tool"] == "tool0"
        words = node.command(Path("given.yaml"))
        assert {"__ns:=/lab/left", "tactile/image:=/image", "command/twist:=/servo"} <= set(words)
        assert "tactile/image/compressed:=/image/compressed" in words
    names = {topic.name for topic in graph.topics}
    assert {f"/lab/left/{BELIEF.name}", f"/leader/{ARM_STATUS.name}", DIAGNOSTICS.name} <= names
    assert [plan.arm for plan in graph.plans] == ["lab/left"]


def test_an_arm_node_that_runs_already_is_not_started_again():
    graph = load_servoing_graph("surface_following", "ur_example", "arm", Place(arm_node=False))
    assert "arm" not in {node.name for node in graph.nodes}


@pytest.mark.parametrize(
    ("place", "complaint"),
    [
        ({"namespace": "my arm"}, "namespace 'my arm': must be letters, digits and _"),
        ({"namespace": "left/"}, "namespace 'left/': must be"),
        ({"image_topic": "2/image"}, "image_topic '2/image': must be"),
        ({"tool_frame": "/tool0"}, "tool_frame '/tool0': must be as on /tf"),
        ({"base_frame": "base link"}, "base_frame 'base link': must be as on /tf"),
        ({"params_file": Path("/no/such.yaml")}, "params_file '/no/such.yaml': no such file"),
    ],
)
def test_a_place_that_cannot_be_is_refused(place, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)):
        Place(**place)


@pytest.mark.parametrize(
    ("arm", "complaint"), [("", "must be one of leader, follower"), ("folower", "did you mean 'follower'")]
)
def test_which_arm_is_meant_has_to_be_clear(arm, complaint):
    with pytest.raises(ValueError, match=complaint):
        load_servoing_graph("object_tracking", "tracking_cube", arm, Place())


@pytest.fixture
def runs(monkeypatch) -> list[Graph]:
    """The graphs that `tactile run` would run goals on."""
    graphs: list[Graph] = []
    monkeypatch.setattr(run, "_run", lambda graph, display: graphs.append(graph) or 0)
    return graphs


def test_a_task_is_run_on_the_nodes_that_the_same_names_have_started(runs):
    assert main(["run", "surface_following", "--scene", "ur_example", "--namespace", "/lab/left"]) == 0
    wanted = [f"/lab/left/{name}" for name in ("arm", "estimator", "filter", "controller")]
    assert [node.full_name for node in runs[0].nodes] == wanted


def test_a_rehearsal_is_run_on_the_nodes_that_it_has(runs, tmp_path):
    scene = tmp_path / "ur_example.yaml"
    text = config_path("scenes/ur_example.yaml").read_text()
    scene.write_text(text + "simulation: {sensors: {arm: {fidelity: ideal}}}\n")
    for words in ([], ["--rehearse"]):
        assert main(["run", "surface_following", "--scene", str(scene), *words]) == 0
    real, rehearsed = ({node.name for node in graph.nodes} for graph in runs)
    assert real - rehearsed == {"estimator"} and rehearsed - real == {"sim"}


def test_an_arm_that_is_not_there_ends_a_run_with_a_sentence(runs, capsys):
    assert main(["run", "surface_following", "--scene", "ur_example", "--arm", "left"]) == 2
    assert "tactile run: arm: unknown name 'left'" in capsys.readouterr().err and not runs
