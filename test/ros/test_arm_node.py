"""The arm node and the camera node with drivers of another package, found by its entry points."""

import numpy as np
import pytest
from arm_bench import ALONG, ARM_NODE, SENSOR, SENSOR_TEXT, TOOL, keep_commanding, position, scene_text
from geometry_msgs.msg import PoseStamped, TwistStamped
from messages import arm_command, matrix_from_transform, vector_from_twist
from other_package import installed
from sensor_msgs.msg import Image
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from tactile_geometry import se3
from tactile_msgs.msg import ArmCommand, ArmStatus, StageLatency
from tactile_ros import qos
from tactile_ros.conversions import array_from_image, matrix_from_pose, ns_from_time

CAMERA_NODE = "tactile_ros.nodes.camera_node"


@pytest.fixture
def bench(graph, tmp_path):
    """Writes a scene with the other package's arm; starts one of the nodes on it."""
    graph.import_from(installed(tmp_path))
    path = tmp_path / "bench.yaml"

    def start(module=ARM_NODE, parameters=None, wait=True, **scene: str):
        path.write_text(scene_text(**scene))
        moves = {"feels": False} if module == ARM_NODE else {}  # nobody tells what the sensor feels
        return graph.start(module, {"scene": path, **moves, **(parameters or {})}, wait=wait)

    return start


def told(graph) -> str:
    """What the driver has printed."""
    return graph.log(ARM_NODE).read_text()


def test_states_of_a_driver_become_transforms_pose_and_status_that_fit_together(graph, bench):
    poses = graph.collect(PoseStamped, "arm/pose")
    statuses = graph.collect(ArmStatus, "arm/status")
    transforms = graph.collect(TFMessage, "/tf", qos.TF)
    static = graph.collect(TFMessage, "/tf_static", qos.TF_STATIC)
    bench(parameters={"status_rate": 20.0})
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


@pytest.mark.parametrize("by_topic", [True, False], ids=["topic", "service"])
def test_after_an_emergency_stop_nothing_moves_until_a_reset_and_a_twist_of_zero(graph, bench, by_topic):
    bench(safety="{owner_timeout: 10.0}")  # or silence, which a machine that holds us up may make
    statuses = graph.collect(ArmStatus, "arm/status")
    poses = graph.collect(PoseStamped, "arm/pose")
    twists = graph.publisher(ArmCommand, "command/request", qos.COMMAND)
    stop = graph.publisher(Bool, "/estop")

    def keep_asking(until, twist=ALONG):
        for _ in graph.ticks(0.02):
            twists.publish(arm_command(graph.now_ns(), SENSOR, twist))
            if until():
                return
        raise AssertionError(f"it never held: {statuses[-1:]}")

    keep_asking(lambda: bool(statuses) and statuses[-1].owner == "/test", np.zeros(6))
    keep_asking(lambda: statuses[-1].mode == ArmStatus.MOVING)
    if by_topic:
        stop.publish(Bool(data=True))
    else:
        assert graph.call(Trigger, "arm/estop", Trigger.Request()).success
    keep_asking(lambda: statuses[-1].mode == ArmStatus.ESTOP and not any(statuses[-1].twist))
    assert "emergency stop: asked for" in statuses[-1].reason
    rested_ns = ns_from_time(statuses[-1].header.stamp)
    keep_asking(lambda: ns_from_time(poses[-1].header.stamp) >= rested_ns)
    where = position(poses)
    stop.publish(Bool(data=False))  # takes nothing back
    graph.restart("arm")  # nor does this
    statuses.clear()
    keep_asking(lambda: len(statuses) > 10)
    assert all(status.mode == ArmStatus.ESTOP for status in statuses)
    assert graph.call(Trigger, "arm/reset", Trigger.Request()).success
    statuses.clear()
    keep_asking(lambda: len(statuses) > 10)
    assert all(status.mode == ArmStatus.RESTING for status in statuses[3:])
    assert np.linalg.norm(position(poses) - where) < 1e-4
    statuses.clear()
    keep_asking(lambda: len(statuses) > 3 and statuses[-1].command_age >= 0.0, np.zeros(6))
    keep_asking(lambda: statuses[-1].mode == ArmStatus.MOVING)


def test_an_arm_that_ignores_an_emergency_stop_is_told_louder_than_anything_else(graph, bench):
    bench(settings="{deaf: true}")
    statuses = graph.collect(ArmStatus, "arm/status")
    keep_commanding(graph, SENSOR, lambda: bool(statuses) and statuses[-1].twist[1] > 0.019)
    assert graph.call(Trigger, "arm/estop", Trigger.Request()).success
    assert graph.wait(lambda: statuses[-1].reason.startswith("THE ARM DOES NOT STOP"))
    assert statuses[-1].mode == ArmStatus.ESTOP and "asked for by the service" in statuses[-1].reason
    graph.wait_for_report("arm", lambda report: "THE ARM DOES NOT STOP" in report.message)
    answer = graph.call(Trigger, "arm/reset", Trigger.Request())
    assert not answer.success and "told to rest, and moves" in answer.message


def test_an_emergency_stop_does_not_wait_for_a_command_that_hangs_in_the_driver(graph, bench):
    bench(settings="{slow: 2.0}")
    ask, stop = graph.commands(SENSOR), graph.publisher(Bool, "/estop")
    log = graph.log(ARM_NODE)
    for _ in graph.ticks(0.02):
        ask(ALONG)
        if ask.moved:
            break
    for _ in range(5):
        graph.spin(0.02)
        ask(ALONG)
    asked_ns = graph.now_ns()
    stop.publish(Bool(data=True))
    stopped = "stop: emergency stop: asked for on /estop\nstopped at "
    assert graph.wait(lambda: stopped in log.read_text())
    assert (int(log.read_text().partition(stopped)[2].split()[0]) - asked_ns) * 1e-9 < 1.0
    graph.wait_for_report("arm", lambda report: "the driver's command took 2." in report.message)


def test_an_arm_with_a_sensor_of_which_nothing_is_heard_crawls(graph, bench):
    bench(parameters={"feels": True})
    statuses = graph.collect(ArmStatus, "arm/status")
    keep_commanding(graph, SENSOR, lambda: bool(statuses) and bool(statuses[-1].limited_by))
    assert statuses[-1].limited_by == "no word of the contact: 0.002 m/s"
    graph.spin(0.3)
    assert max(abs(status.twist[1]) for status in statuses) < 0.0021


def test_those_who_wait_for_a_first_state_are_told_why_none_is_believed(graph, bench):
    statuses, transforms = graph.collect(ArmStatus, "arm/status"), graph.collect(TFMessage, "/tf", qos.TF)
    bench(settings="{nowhere: true}", parameters={"status_rate": 20.0})
    assert graph.wait(lambda: len(statuses) > 5)
    assert {status.mode for status in statuses} == {ArmStatus.FAULT}
    assert "is not believed: pose" in statuses[-1].reason and not transforms
    stamps = [ns_from_time(status.header.stamp) for status in statuses]
    assert len(stamps) < 2 + (stamps[-1] - stamps[0]) * 20e-9


def test_commands_to_somebody_elses_driver_pass_the_same_stage(graph, bench):
    bench(driver="external", sensor="sensor: {camera: external}")
    arm = graph.arm()
    given = graph.collect(TwistStamped, "command/twist", qos.COMMAND)
    statuses = graph.collect(ArmStatus, "arm/status")
    ask = graph.commands(SENSOR)
    T, last_ns = se3.pose_from_euler([0.1, 0.2, 0.3, 0, np.pi, 0]), graph.now_ns()

    def move() -> None:
        """Go on as the last twist says, and tell where that is."""
        nonlocal T, last_ns
        now_ns = graph.now_ns()
        twist = vector_from_twist(given[-1].twist) if given else np.zeros(6)
        T, last_ns = T @ se3.exp(twist * (now_ns - last_ns) * 1e-9), now_ns
        arm.at(now_ns, T)

    for _ in graph.ticks(0.01):
        move()
        ask([0.0, 3.0, 0, 0, 0, 0])
        if statuses and statuses[-1].twist[1] > 0.09:
            break
    assert statuses[-1].mode == ArmStatus.MOVING and statuses[-1].limited_by == "speed"
    for _ in graph.ticks(0.01):  # no command any more
        move()
        if not any(vector_from_twist(given[-1].twist)):
            break
    speeds = np.array([vector_from_twist(message.twist)[1] for message in given])
    assert speeds.min() >= 0.0 and speeds.max() <= 0.1 + 1e-9
    assert len(np.unique(speeds)) > 6  # it speeds up and slows down within the limits of acceleration


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
        ({"driver": "bench_amr"}, "unknown name 'bench_amr' (did you mean 'bench_arm'?)"),
    ],
)
def test_an_arm_that_cannot_be_had_ends_the_process_with_the_reason(graph, bench, given, complaint):
    sensor = SENSOR_TEXT.replace("bench_camera", "external")
    process = bench(wait=False, sensor=sensor, **given)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1 and complaint in told(graph)


def test_a_second_node_of_an_arm_is_refused_and_names_the_first(graph, bench):
    first = bench()
    code = "from tactile_ros.nodes.arm_node import main; raise SystemExit(main())"
    parameters = {"scene": graph.folder / "bench.yaml", "feels": False}
    second = graph.start_code("second", code, parameters, wait=False)
    assert graph.wait(lambda: second.poll() is not None) and second.returncode == 1
    said = graph.log("second").read_text()
    assert f"process {first.pid} is a node of /arm in ROS domain" in said and "already: end it first" in said
    assert first.poll() is None


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


def test_frames_that_are_no_images_are_refused_and_told(graph, bench):
    sensor = SENSOR_TEXT.replace("camera_rate", "camera_settings: {channels: 2}, camera_rate")
    bench(CAMERA_NODE, sensor=sensor)
    assert "must be uint8 (height, width)" in graph.wait_for_count("camera", "frames refused").message
