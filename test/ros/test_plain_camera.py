"""Images of somebody else's node, without a profile of ours, over real shared memory."""

import re
import sys
from pathlib import Path

from tactile_ros.discovery import PROFILE_VARIABLES

ESTIMATOR = "tactile_ros.nodes.estimator_node"
CAMERA = [sys.executable, str(Path(__file__).parent / "plain_camera.py")]
RATE = 20.0  # Hz; slow enough for any machine, so that what is lost is lost for another reason
LOST, ARRIVED = "tactile/image messages lost", "tactile/image messages"


def start_camera(graph, encoding: str, **profile: str) -> None:
    given = {name: value for name, value in graph.variables.items() if name not in PROFILE_VARIABLES}
    command = [*CAMERA, encoding, str(RATE), "60", "best_effort"]
    graph.processes.start("camera", command, {**given, **profile}, graph.log("camera"))


def test_images_that_their_publishers_shared_memory_cannot_hold_are_told_with_a_remedy_that_helps(graph):
    graph.start(ESTIMATOR)
    start_camera(graph, "bgr8")

    def most_are_lost(report) -> bool:
        values = report.values
        return "shared memory" in report.message and int(values[LOST]) > int(values.get(ARRIVED, "0"))

    told = graph.wait_for_report("estimator", most_are_lost)
    remedy = re.search(r"start the camera's node with (\w+)=(\S+), or have it publish mono8", told.message)
    assert remedy, told.message

    graph.processes.stop(["camera"])
    graph.restart("estimator")
    start_camera(graph, "bgr8", **{remedy[1]: remedy[2]})
    report = graph.wait_for_count("estimator", ARRIVED, 60)
    assert int(report.values.get(LOST, "0")) < 20 and "shared memory" not in report.message


def test_gray_images_of_a_plain_node_arrive(graph):
    graph.start(ESTIMATOR)
    start_camera(graph, "mono8")
    report = graph.wait_for_count("estimator", ARRIVED, 60)
    assert int(report.values.get(LOST, "0")) < 20 and "shared memory" not in report.message
