"""The arm node and the camera node with drivers of another package, found by its entry points."""

import os

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped
from messages import twist_stamped
from other_package import installed
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage

from tactile_filter import se3
from tactile_msgs.msg import ArmStatus, StageLatency
from tactile_ros import qos
from tactile_ros.conversions import array_from_image, matrix_from_pose, matrix_from_transform, ns_from_time

ARM_NODE, CAMERA_NODE = "tactile_ros.nodes.arm_node", "tactile_ros.nodes.camera_node"
TOOL, SENSOR = "arm/tool", "arm/tactile_sensor"
ALONG = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
SENSOR_TEXT = "sensor: {in_tool: {position: [0, 0, 0.065]}, camera: bench_camera, camera_rate: 30}"


@pytest.fixture
def bench(graph, tmp_path):
    """Writes a scene with the other package's arm; starts one of the nodes on it."""
    folders = [*installed(tmp_path), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    graph.variables["PYTHONPATH"] = os.pathsep.join(filter(None, folders))
    path = tmp_path / "bench.yaml"

    def start(
        module=ARM_NODE, driver="bench_arm", settings="{}", sensor=SENSOR_TEXT, wait=True, **parameters
    ):
        path.write_text(
            f"arms:\n  arm:\n    driver: {driver}\n    driver_settings: {settings}\n"
            f"    start: {{position: [0.1, 0.2, 0.3], rotation_deg: [0, 180, 0]}}\n    {sensor}\n"
        )
        return graph.start(module, {"scene": str(path), **parameters}, wait=wait)

    return start


def told(graph) -> str:
    """What the driver has printed."""
    return graph.log(ARM_NODE).read_text()


def keep_commanding(graph, frame, until, twist=ALONG):
    """Send a twist every 20 ms until something holds."""
    out = graph.publisher(TwistStamped, "command/twist", qos.COMMAND)
    for _ in graph.ticks(0.02):
        out.publish(twist_stamped(graph.now_ns(), frame, twist))
        if until():
            return
    raise AssertionError("it never held")


def test_states_of_a_driver_become_transforms_pose_and_status_that_fit_together(graph, bench):
    poses = graph.collect(PoseStamped, "arm/pose")
    statuses = graph.collect(ArmStatus, "arm/status")
    transforms = graph.collect(TFMessage, "/tf", qos.TF)
    static = graph.collect(TFMessage, "/tf_static", qos.TF_STATIC)
    bench(status_rate=20.0)
    assert graph.wait(lambda: len(poses) > 20 and bool(statuses) and bool(static))
    base, mount = static[0].transforms
    assert (base.header.frame_id, base.child_frame_id) == ("world", "arm/base")
    assert (mount.header.frame_id, mount.child_frame_id) == (TOOL, SENSOR)
    start = se3.pose_from_euler([0.1, 0.2, 0.3, 0, np.pi, 0])
    np.testing.assert_allclose(matrix_from_pose(poses[-1].pose), start, atol=1e-12)
    moving = transforms[-1].transforms[0]
    T = matrix_from_transform(moving.transform) @ matrix_from_transform(mount.transform)
    assert (moving.header.frame_id, moving.child_frame_id) == ("arm/base", TOOL)
    np.testing.assert_allclose(T, start, atol=1e-12)
    assert statuses[-1].header.frame_id == "arm/base" and statuses[-1].mode == ArmStatus.RESTING
    stamps = [ns_from_time(message.header.stamp) for message in poses]
    assert len(stamps) < 2 + (stamps[-1] - stamps[0]) * 20e-9  # of the states, as many as status_rate says


def test_an_arm_whose_driver_does_not_watch_its_commands_is_stopped_when_they_stop_coming(graph, bench):
    poses = graph.collect(PoseStamped, "arm/pose")
    statuses = graph.collect(ArmStatus, "arm/status")
    bench()
    assert graph.wait(lambda: bool(poses))
    start = matrix_from_pose(poses[-1].pose)

    def moved() -> np.ndarray:
        return se3.inverse(start) @ matrix_from_pose(poses[-1].pose)

    keep_commanding(graph, SENSOR, lambda: moved()[1, 3] > 0.003)
    assert abs(moved()[0, 3]) < 1e-9
    assert graph.wait(lambda: statuses[-1].mode == ArmStatus.RESTING)
    assert "no command for" in statuses[-1].reason and "(limit 0.1 s)" in statuses[-1].reason


def test_an_arm_whose_driver_falls_silent_is_stopped_and_commands_are_refused(graph, bench):
    bench(settings="{states: 100}")
    keep_commanding(graph, SENSOR, lambda: "stop: no state from the driver for" in told(graph))
    report = graph.wait_for_count("arm", "commands refused")
    assert "no state from the driver" in report.message


@pytest.mark.parametrize("sensor, right, wrong", [(SENSOR_TEXT, SENSOR, TOOL), ("", TOOL, SENSOR)])
def test_commands_are_in_the_controlled_frame_the_tool_of_an_arm_without_a_sensor(
    graph, bench, sensor, right, wrong
):
    bench(sensor=sensor)
    statuses = graph.collect(ArmStatus, "arm/status")
    twists = graph.publisher(TwistStamped, "command/twist", qos.COMMAND)
    twists.publish(twist_stamped(graph.now_ns(), wrong, ALONG))
    assert f"must be '{right}'" in graph.wait_for_count("arm", "commands refused").message
    for _ in graph.ticks(0.02):
        twists.publish(twist_stamped(graph.now_ns(), right, ALONG))
        if statuses and statuses[-1].mode == ArmStatus.MOVING:
            return


def test_a_node_that_ends_stops_its_arm_and_lets_go_of_it(graph, bench):
    bench()
    keep_commanding(graph, SENSOR, lambda: True)
    assert graph.stop(ARM_NODE) == 0
    assert "stop: the arm's node was deactivated" in told(graph)
    assert told(graph).rstrip().splitlines().count("close") == 1


@pytest.mark.parametrize(
    "given, complaint",
    [
        ({"settings": "{host: nowhere}"}, "arm driver 'bench_arm': no answer from nowhere"),
        ({"settings": "{hots: here}"}, "bench.yaml:4: arms.arm.driver_settings: unknown name 'hots'"),
        ({"driver": "sim"}, "arm 'arm' is moved by the simulated cell"),
        ({"driver": "external"}, "arm 'arm' has a driver that runs already"),
        ({"driver": "bench_amr"}, "unknown name 'bench_amr' (did you mean 'bench_arm'?)"),
    ],
)
def test_an_arm_that_cannot_be_had_ends_the_process_with_the_reason(graph, bench, given, complaint):
    sensor = SENSOR_TEXT.replace("bench_camera", "external")
    process = bench(wait=False, sensor=sensor, **given)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1 and complaint in told(graph)


def test_frames_of_a_camera_driver_become_images_and_the_latency_of_the_stage_camera(graph, bench):
    images = graph.collect(Image, "tactile/image", qos.IMAGE)
    latencies = graph.collect(StageLatency, "latency", qos.LATENCY)
    sensor = SENSOR_TEXT.replace("camera_rate", "camera_settings: {gray: 80}, camera_rate")
    bench(CAMERA_NODE, sensor=sensor)
    assert graph.wait(lambda: len(images) > 5 and len(latencies) > 3)
    assert images[-1].header.frame_id == SENSOR
    assert (array_from_image(images[-1]) == 80).all()
    assert abs(graph.now_ns() - ns_from_time(images[-1].header.stamp)) < 10 * 10**9
    assert latencies[-1].stage == "camera" and latencies[-1].dropped[-1] >= 1


def test_frames_that_are_no_gray_images_are_refused_and_told(graph, bench):
    sensor = SENSOR_TEXT.replace("camera_rate", "camera_settings: {channels: 3}, camera_rate")
    bench(CAMERA_NODE, sensor=sensor)
    assert "must be uint8 (height, width)" in graph.wait_for_count("camera", "frames refused").message
