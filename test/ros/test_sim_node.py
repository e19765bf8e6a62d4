"""The sim node: real time, stamps that fit together, commands with limits and a watchdog, scenes."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TwistStamped
from messages import arm_command, matrix_from_transform, vector_from_twist
from other_package import installed
from sensor_msgs.msg import Image
from std_msgs.msg import Bool
from tf2_msgs.msg import TFMessage

from tactile_base.config_paths import config_path
from tactile_geometry import se3
from tactile_msgs.msg import ArmCommand, ArmStatus, ContactPresence, ContactTruth
from tactile_ros import qos
from tactile_ros.conversions import array_from_image, matrix_from_pose, ns_from_time, transform_stamped
from tactile_scene.scene_file import load_scene

SIM = "tactile_ros.nodes.sim_node"
SENSOR = "arm/tactile_sensor"
SECOND = 1_000_000_000
IDEAL = "simulation:\n  sensors: {arm: {fidelity: ideal}}\n"
FORWARD = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])


def scene_file(folder, *changes: tuple[str, str]) -> str:
    """The ramp's scene with some text replaced, as a file."""
    text = config_path("scenes/ramp.yaml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "scene.yaml").write_text(text)
    return str(folder / "scene.yaml")


@pytest.fixture
def ideal_scene(tmp_path):
    """The ramp with an ideal sensor, which costs no time to simulate."""
    return scene_file(tmp_path, ("bodies:", f"{IDEAL}bodies:"))


@pytest.fixture(scope="module")
def running(shared_graph, tmp_path_factory):
    """A cell with an ideal sensor, of which nobody tells what it feels."""
    scene = scene_file(tmp_path_factory.mktemp("cell"), ("bodies:", f"{IDEAL}bodies:"))
    shared_graph.start(SIM, {"scene": scene, "feels": False}, namespace="")
    return shared_graph


@pytest.fixture
def cell(running):
    """Its arm at rest, with nothing told of it yet."""
    running.restart("arm")
    return running


def stamps(messages: list) -> list[int]:
    return [ns_from_time(m.header.stamp) for m in messages]


def moving(messages: list[TFMessage]) -> list:
    return [transform for message in messages for transform in message.transforms]


def test_image_transform_and_truth_carry_the_exposures_stamp_and_agree(graph):
    images = graph.collect(Image, "tactile/image", qos.IMAGE)
    truths = graph.collect(ContactTruth, "sim/truth")
    transforms = graph.collect(TFMessage, "/tf", qos.TF)
    static = graph.collect(TFMessage, "/tf_static", qos.TF_STATIC)
    graph.start(SIM, {"scene": "ramp"}, namespace="")

    def common() -> list[int]:
        return sorted(set(stamps(images)) & set(stamps(truths)) & set(stamps(moving(transforms))))

    assert graph.wait(lambda: len(common()) >= 15 and bool(static))
    image = array_from_image(images[-1])
    assert image.shape == (480, 640) and image.min() < 100 < image.max()
    assert images[-1].header.frame_id == SENSOR
    tool = {ns_from_time(t.header.stamp): t for t in moving(transforms)}
    T_tool_sensor = next(
        matrix_from_transform(t.transform) for t in static[0].transforms if t.child_frame_id == SENSOR
    )
    by_stamp = dict(zip(stamps(truths), truths, strict=True))
    for stamp in common():
        T_base_sensor = matrix_from_transform(tool[stamp].transform) @ T_tool_sensor
        np.testing.assert_allclose(T_base_sensor, matrix_from_pose(by_stamp[stamp].pose), atol=1e-12)


def test_stamps_advance_at_the_rate_of_the_scene_and_are_those_of_now(graph, ideal_scene):
    poses = graph.collect(PoseStamped, "arm/pose")
    truths = graph.collect(ContactTruth, "sim/truth")
    graph.start(SIM, {"scene": ideal_scene, "camera_rate": 30.0}, namespace="")
    assert graph.wait(lambda: len(poses) > 60)
    assert graph.wait(lambda: abs(graph.now_ns() - ns_from_time(poses[-1].header.stamp)) < 0.2 * SECOND)
    for messages, rate in ((poses, 30.0), (truths, 30.0)):
        steps = np.diff(stamps(messages)) / SECOND * rate
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
        assert np.median(steps) == pytest.approx(1.0, abs=1e-3)


def test_a_twist_moves_the_sensor_in_its_own_frame_and_silence_stops_it_with_the_reason(cell):
    poses = cell.collect(PoseStamped, "arm/pose")
    statuses = cell.collect(ArmStatus, "arm/status")
    limited = cell.collect(TwistStamped, "command/twist_limited")
    ask = cell.commands(SENSOR)
    assert cell.wait(lambda: bool(poses) and bool(statuses))
    start = matrix_from_pose(poses[-1].pose)

    def moved() -> np.ndarray:
        return se3.inverse(start) @ matrix_from_pose(poses[-1].pose)

    for _ in cell.ticks(0.02):
        ask(FORWARD)
        if moved()[1, 3] > 0.003:
            break
    assert moved()[1, 3] > 0.003 and abs(moved()[0, 3]) < 1e-9
    assert max(vector_from_twist(m.twist)[1] for m in limited) == pytest.approx(0.02)
    assert cell.wait(lambda: np.all(np.array(statuses[-1].twist) == 0.0))
    assert "no command for" in statuses[-1].reason and "limit 0.1 s" in statuses[-1].reason


@pytest.mark.parametrize(
    ("frame", "twist", "complaint"),
    [("arm/base", FORWARD, "must be 'arm/tactile_sensor'"), (SENSOR, np.full(6, np.nan), "not finite")],
    ids=["frame", "nan"],
)
def test_a_twist_that_cannot_be_followed_is_refused_counted_and_told(cell, frame, twist, complaint):
    twists = cell.publisher(ArmCommand, "command/request", qos.COMMAND)
    twists.publish(arm_command(cell.now_ns(), frame, twist))
    assert complaint in cell.wait_for_count("arm", "commands refused").message


def test_an_ideal_sensor_gives_presence_in_place_of_images(cell):
    images = cell.collect(Image, "tactile/image", qos.IMAGE)
    presences = cell.collect(ContactPresence, "contact/presence")
    estimates = cell.collect(PoseWithCovarianceStamped, "contact/estimate")
    assert cell.wait(lambda: len(presences) > 10)
    assert not images and not estimates and not presences[-1].in_contact


def test_each_arm_of_a_scene_has_its_own_topics_and_frames(graph, tmp_path):
    head, rest = config_path("scenes/ramp.yaml").read_text().split("  arm:\n")
    block, bodies = rest.split("bodies:\n")
    path = tmp_path / "two.yaml"
    ideal = "simulation:\n  sensors: {left: {fidelity: ideal}, right: {fidelity: ideal}}\n"
    path.write_text(f"{head}  left:\n{block}  right:\n{block}bodies:\n{bodies}{ideal}")
    assert set(load_scene(path).arms) == {"left", "right"}
    poses = {arm: graph.collect(PoseStamped, f"/{arm}/arm/pose") for arm in ("left", "right")}
    transforms = graph.collect(TFMessage, "/tf", qos.TF)
    graph.start(SIM, {"scene": str(path)}, namespace="")
    assert graph.wait(lambda: all(poses.values()) and bool(transforms))
    assert {t.child_frame_id for t in transforms[-1].transforms} == {"left/tool", "right/tool"}
    assert not graph.node.get_publishers_info_by_topic("/arm/arm/pose")


def test_an_arm_with_known_kinematics_stops_before_it_is_too_near_to_another(graph, tmp_path):
    arm = (
        "  {name}:\n    base: {{position: [{base}, 0, 0], rotation_deg: [0, 0, {turned}]}}\n"
        "    start: {{position: [{start}, 0, 0.4], rotation_deg: [180, 0, {turned}]}}\n"
        "    safety: {{min_arm_distance: 0.06}}\n"
        "    kinematics: {{description: panda, tool: {{position: [0, 0, 0.1]}}}}\n"
    )
    (tmp_path / "near.yaml").write_text(
        "arms:\n"
        + arm.format(name="arm", base=-0.5, turned=0, start=-0.1)
        + arm.format(name="other", base=0.5, turned=180, start=0.1)
    )
    statuses = graph.collect(ArmStatus, "arm/status")
    graph.start(SIM, {"scene": str(tmp_path / "near.yaml")}, namespace="")
    ask = graph.commands("arm/tool")
    for _ in graph.ticks(0.02):
        ask([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
        if statuses and statuses[-1].limited_by:
            break
    assert statuses[-1].limited_by == "0.06 m from other"


def test_an_arm_of_ones_own_driver_that_is_told_too_deep_in_a_surface_is_stopped(graph, tmp_path):
    graph.import_from(installed(tmp_path))
    (tmp_path / "mine.yaml").write_text(
        "arms:\n  arm: {driver: bench_arm, start: {position: [0, 0, 0.03], rotation_deg: [0, 180, 0]}, "
        f"sensor: {{}}}}\nbodies: {{table: {{shape: plane}}}}\n{IDEAL}"
    )
    stops = graph.collect(Bool, "/estop")
    truths = graph.collect(ContactTruth, "sim/truth")
    graph.start(SIM, {"scene": str(tmp_path / "mine.yaml"), "rehearse": True}, namespace="")
    tell = graph.publisher(TFMessage, "/tf", qos.TF)
    down, height = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0])), 0.03
    for _ in graph.ticks(0.01):
        height -= 0.0005  # 50 mm/s
        down[2, 3] = height
        tell.publish(TFMessage(transforms=[transform_stamped(graph.now_ns(), "arm/base", "arm/tool", down)]))
        if stops:
            break
    assert stops[0].data and 0.004 < max(truth.depth for truth in truths) < 0.02


def test_a_scene_with_a_typo_ends_the_process_with_file_line_and_choices(graph, tmp_path):
    path = scene_file(tmp_path, ("shape: ramp", "shape: rmap"))
    process = graph.start(SIM, {"scene": path}, wait=False, namespace="")
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    log = graph.log(SIM).read_text()
    line = 1 + (tmp_path / "scene.yaml").read_text().splitlines().index("    shape: rmap")
    assert f"{path}:{line}" in log and "did you mean 'ramp'" in log and "plane" in log


def test_sigterm_ends_it_with_exit_code_0(graph, ideal_scene):
    process = graph.start(SIM, {"scene": ideal_scene}, namespace="")
    process.terminate()
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 0
