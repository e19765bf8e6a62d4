"""What nodes really say and hear lies within the permissions that `tactile security` writes for them."""

import pytest
from rclpy.node import NodeNameNonExistentError

from tactile_bringup.graph import GraphOptions, load_graph
from tactile_bringup.launching.operator import Operator
from tactile_bringup.permissions import enclaves
from tactile_scene.scene_file import load_scene
from tactile_view.cell_state import CellState, shown_topics
from tactile_view.live import LiveGraph


def dds_names(graph, namespace: str, node: str) -> tuple[set[str], set[str]]:
    """What a node writes and reads, by the names that DDS has for topics and services (design.ros2.org)."""
    ask = graph.node

    def names(query) -> list[str]:
        try:
            return [name for name, _ in query(node, namespace)]
        except NodeNameNonExistentError:  # not yet
            return []

    served = names(ask.get_service_names_and_types_by_node)
    asked = names(ask.get_client_names_and_types_by_node)
    written = {f"rt{name}" for name in names(ask.get_publisher_names_and_types_by_node)}
    read = {f"rt{name}" for name in names(ask.get_subscriber_names_and_types_by_node)}
    written |= {f"rr{name}Reply" for name in served} | {f"rq{name}Request" for name in asked}
    read |= {f"rq{name}Request" for name in served} | {f"rr{name}Reply" for name in asked}
    return written, read


def whole(names: tuple[set[str], set[str]]) -> bool:
    """Whether what every node has is known: its log, and the services of its parameters and its life."""
    written, read = names
    return "rt/rosout" in written and len(read) > 10


@pytest.mark.parametrize("task", ["surface_following", "object_tracking"])
def test_no_node_says_or_hears_what_its_permissions_do_not_allow(graph, task, tmp_path):
    options = GraphOptions(record=tmp_path / "bag", record_images=True, marker_view=True, object_belief=True)
    described = load_graph(task, None, options)
    allowed = enclaves(described, load_scene(str(described.scene_file)))
    for process in described.nodes:
        file = tmp_path / f"{process.file_stem}.yaml"
        file.write_text(process.parameter_text())
        log = graph.log(process.file_stem)
        graph.processes.start(process.file_stem, process.command(file), graph.variables, log)
    for process in described.nodes:
        graph.wait_until_active(process.file_stem)
    compared = 0
    for process in described.nodes:
        for profile in allowed[process.full_name]:
            full = profile.namespace, profile.node
            node = profile.node, profile.namespace
            assert graph.wait(lambda node=node: node in graph.node.get_node_names_and_namespaces()), node
            assert graph.wait(lambda full=full: whole(dds_names(graph, *full))), f"{full} is not seen"
            graph.spin(0.2)  # the rest of what it has, which comes one by one
            written, read = dds_names(graph, *full)
            assert written <= profile.published(), (full, written - profile.published())
            assert read <= profile.heard(), (full, read - profile.heard())
            compared += 1
    assert compared == len(graph.nodes())


def test_who_looks_and_who_acts_by_hand_stay_within_theirs(graph):
    described = load_graph("surface_following", None, GraphOptions())
    allowed = enclaves(described, load_scene(str(described.scene_file)))
    graph.start("tactile_ros.nodes.filter_node")
    graph.start("tactile_ros.nodes.controller_node")
    domain = graph.context.get_domain_id()
    with LiveGraph(domain, CellState()) as page, Operator(domain) as operator:
        operator.find(1.0)
        operator.set_parameter("/arm/filter", "gate_probability", 0.9999)
        operator.cancel("arm")
        operator.stop()
        shown = {f"rt{topic.name}" for topic in shown_topics("arm")}
        for name in ("tactile_view", "operator"):
            (profile,) = allowed[f"/{name}"]
            wanted = shown if name == "tactile_view" else set()

            def seen(name=name, wanted=wanted) -> bool:
                page.poll(0.05, True)
                names = dds_names(graph, "/", name)
                return len(names[1]) > 8 and wanted <= names[1]

            assert graph.wait(seen), dds_names(graph, "/", name)
            written, read = dds_names(graph, "/", name)
            assert written <= profile.published(), written - profile.published()
            assert read <= profile.heard(), read - profile.heard()


VELOCITIES = """\
arms:
  arm:
    driver: external
    driver_settings: {joint_velocities: /velocity/commands, publish_tool: true, publish_mount: true}
    kinematics: {description: ur5e}
    start: {position: [0.4, 0.0, 0.3]}
    sensor: {camera: external}
"""


def test_an_arm_that_moves_by_joint_velocities_and_who_stops_it_have_what_the_scene_names(graph, tmp_path):
    scene = tmp_path / "cell.yaml"
    scene.write_text(VELOCITIES)
    described = load_graph("surface_following", str(scene))
    arm, last = enclaves(described, load_scene(scene))["/arm/arm"]
    graph.start("tactile_ros.nodes.arm_node", {"scene": str(scene)})
    for profile in (arm, last):
        full = profile.namespace, profile.node
        assert graph.wait(lambda full=full: "rt/velocity/commands" in dds_names(graph, *full)[0]), full
        graph.spin(0.2)
        written, read = dds_names(graph, *full)
        assert written <= profile.published(), (full, written - profile.published())
        assert read <= profile.heard(), (full, read - profile.heard())
    assert "rt/joint_states" in read | dds_names(graph, "/arm", "arm")[1]
