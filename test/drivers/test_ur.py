"""The driver of Universal Robots arms, behind the safe command stage, against the double of their controller.

Distances and times are those of the double's own arm; faults come while it moves at 50 mm/s and goes on being
commanded.
"""

import os
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from real_arm import (
    ALONG,
    ATTEMPTS,
    PATIENT,
    SPEED,
    WITHIN,
    ZERO,
    ArmContract,
    Cell,
    address,
    check_clock_jump,
    check_stop,
    lasted,
    mend,
    prompt,
    real_time,
    refusal,
)
from ur_cell import Double, scene_file

from tactile_base.config_paths import config_path
from tactile_doubles.ur_robot import UrRobotSettings
from tactile_drivers.rotation_vectors import pose_of
from tactile_drivers.safety import SafeArm
from tactile_scene.arm import ArmMode, open_arm
from tactile_scene.kinematics.arm_file import load_arm
from tactile_scene.kinematics.joint_limits import joint_rates
from tactile_scene.scene_file import load_scene

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python or machine")

pytestmark = pytest.mark.live

AS_IT_WAS = [
    "tcp_offset 0 0 0 0 0 0", "local_control 0", "registers_in_use 0", "old_protocol 0", "scripts_ignored 0",
]  # fmt: skip


@pytest.fixture(scope="module")
def double():
    double = Double(address())
    yield double
    assert not double.close()


@pytest.fixture(scope="module", params=[PATIENT])
def opened(double, tmp_path_factory, request):
    """A machine that holds it up is no silence of the arm, but for tests of that: `prompt`."""
    double.mend()
    cell = Cell(scene_file(tmp_path_factory.mktemp("ur"), double.host, state_timeout=request.param))
    yield cell
    cell.close()


@pytest.fixture
def cell(opened, double):
    """The arm at rest and ready, whatever the test before did."""
    mend(opened, double)
    return opened


@pytest.mark.parametrize(
    "fault, words, mode",
    [
        ("protective_stop", "protective stop of the arm", ArmMode.FAULT),
        ("emergency_stop", "emergency stop of the arm", ArmMode.ESTOP),
        ("safeguard_stop", "safeguard stop of the arm", ArmMode.FAULT),
        ("stop_program", "the program on the controller has ended", ArmMode.FAULT),
        ("teach_button", "moved by hand", ArmMode.FAULT),
        ("payload 2", "its payload is 2 kg, the scene says 0 kg", ArmMode.FAULT),
        ("drop", "connection lost|lost, and is back", ArmMode.FAULT),
        ("leave", "connection", ArmMode.FAULT),
    ],
)
def test_what_goes_wrong_at_the_controller_stops_the_arm_and_is_told(cell, double, fault, words, mode):
    check_stop(cell, double, lambda: double(*fault.split()), words, mode)


@prompt
@pytest.mark.parametrize(
    "fault, words",
    [
        ("silence", "connection lost: no state of the arm for 0.1 s|by its watchdog"),
        ("slow 0.3", "connection lost|late|by its watchdog"),
        ("garbled", "in fault"),
    ],
)
def test_a_controller_that_is_not_heard_any_more_stops_the_arm_and_it_is_told(cell, double, fault, words):
    check_stop(cell, double, lambda: double(*fault.split()), words)


@prompt
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_an_arm_whose_ur_rtde_dies_or_hangs_is_stopped_by_the_controllers_watchdog(cell, double, number):
    def inject():
        os.kill(cell.driver._link._process.pid, number)
        return double("speed_slider", 1.0)

    check_stop(cell, double, inject, "connection lost|lost, and is back")


def test_an_arm_whose_program_hangs_is_stopped_by_the_controllers_watchdog_once_it_should_rest(cell, double):
    cell.move()
    double("stuck_program")
    double.trace()
    cell.safe.halt("test")
    cell.until(lambda: cell.state.mode is ArmMode.FAULT, "fault")
    time.sleep(0.2)
    trace = double.trace()
    moving = np.flatnonzero(trace[:, 7:13].any(axis=1))[-1]
    assert lasted(trace[: moving + 1, 0]) < WITHIN
    assert "the program on the controller has ended" in cell.state.reason


def test_a_protective_stop_is_left_by_a_reset_which_starts_the_program_again(cell, double):
    double("protective_stop")
    cell.until(lambda: cell.state.mode is ArmMode.FAULT, "fault")
    with pytest.raises(RuntimeError, match="can be left 5 s after it at the earliest: look for its cause"):
        cell.safe.reset()
    time.sleep(5.0)
    cell.safe.reset()
    cell.until(lambda: cell.state.mode is ArmMode.RESTING, "rest")
    assert not cell.command(ZERO)
    cell.move()


def test_a_tcp_that_is_changed_at_the_pendant_in_an_emergency_stop_keeps_the_arm_from_going_on(cell, double):
    double("emergency_stop")
    cell.until(lambda: cell.state.mode is ArmMode.ESTOP, "emergency stop")
    double("tcp_offset", 0, 0, 0.05, 0, 0, 0)
    double("restore")

    def refused() -> str:
        try:
            cell.safe.reset()
        except RuntimeError as error:
            return str(error)
        return ""

    cell.until(lambda: "its TCP offset is [0.0, 0.0, 0.05" in refused(), "that refusal")
    assert cell.command(ALONG, 0.2)
    double("tcp_offset", 0, 0, 0, 0, 0, 0)
    cell.until(lambda: not refused(), "a reset")
    cell.until(lambda: not cell.command(ZERO), "an arm that follows")


@pytest.mark.parametrize("fault", ["torn", "loss 0.5", "slow 0.1"])
def test_packages_in_pieces_lost_or_a_little_late_do_not_stop_the_arm(cell, double, fault):
    double(*fault.split())
    for _ in range(ATTEMPTS):
        cell.move()
        double.trace()
        if not cell.command(ALONG, 0.5):
            break
        mend(cell, double)
        double(*fault.split())
    speeds = double.trace()[:, 7:10]
    assert np.abs(speeds - ALONG[:3]).max() < 1e-3


def test_the_speed_slider_is_told_and_makes_the_arm_no_faster_than_it_says(cell, double):
    cell.move()
    double("speed_slider", 0.5)
    cell.command(ALONG, 0.2)
    assert "speed scaling 50 %" in cell.state.reason
    assert cell.state.mode is ArmMode.MOVING
    assert np.linalg.norm(cell.state.twist[:3]) == pytest.approx(0.5 * SPEED, rel=1e-3)


@pytest.mark.parametrize("seconds", [30.0, -30.0])
def test_a_controllers_clock_that_jumps_makes_no_stamp_go_back_or_ahead(cell, double, seconds):
    check_clock_jump(cell, double, seconds)


def test_an_emergency_stop_of_the_stage_brings_the_arm_to_rest_with_speed_stop(cell, double):
    cell.move()
    double.trace()
    cell.safe.estop("test")
    assert "emergency stop: test" in cell.command(ALONG, 0.3)
    speed = np.linalg.norm(double.trace()[:, 7:10], axis=1)
    slowing = np.flatnonzero(speed[1:] < speed[:-1])
    assert speed[-1] == 0.0
    assert (slowing[-1] - slowing[0]) / 500.0 <= SPEED / cell.driver.settings.deceleration + 0.004


def test_rotation_stops_as_fast_as_translation_does(cell, double):
    """URScript takes the number of stopl's linear deceleration for rotation, too, in rad/s^2."""
    turning = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.8])
    cell.until(lambda: not cell.command(turning) and cell.state.twist[5] > 0.79, "that speed")
    double.trace()
    cell.safe.estop("test")
    assert "emergency stop: test" in cell.command(turning, 0.5)
    speed = np.linalg.norm(double.trace()[:, 10:13], axis=1)
    slowing = np.flatnonzero(speed[1:] < speed[:-1] - 1e-9)
    assert speed[-1] == 0.0
    assert (
        cell.driver.settings.deceleration >= 10.0
    )  # 1 rad/s within 0.1 s, of which the double knows nothing
    assert (slowing[-1] - slowing[0]) / 500.0 <= 0.8 / cell.driver.settings.deceleration + 0.004


def test_a_step_of_rotation_is_followed_as_its_limits_allow(cell, double):
    limits, step = cell.arm.limits, 0.5
    double.trace()
    cell.until(lambda: not cell.command([0, 0, 0, 0, 0, step]) and cell.state.twist[5] > 0.49, "that speed")
    speed = np.linalg.norm(double.trace()[:, 10:13], axis=1)
    rising = np.flatnonzero(speed[1:] > speed[:-1] + 1e-9)
    ramp = limits.angular_acceleration / limits.angular_jerk
    assert (rising[-1] - rising[0]) / 500.0 < step / limits.angular_acceleration + ramp + 0.05
    cell.command(ZERO, 0.3)


def test_what_arrives_at_the_controller_keeps_the_limits_whatever_is_commanded(cell, double):
    rng, limits = np.random.default_rng(3), cell.arm.limits
    double.trace()
    for _ in range(60):
        twist = rng.uniform(-1.0, 1.0, 6) * np.repeat([0.3, 0.0], 3)
        if rng.random() < 0.8:
            assert not cell.command(twist)
        else:
            cell.safe.stop("missing")
        time.sleep(rng.uniform(0.0, 0.03))
    cell.command(ZERO, 0.3)
    trace = double.trace()
    speeds = np.abs(trace[:, 7:10])
    acceleration = np.abs(np.diff(trace[:, 7:10], axis=0)).max() * 500.0
    assert 0.5 * limits.linear_velocity < speeds.max() <= limits.linear_velocity * (1 + 1e-6)
    assert acceleration <= cell.driver.settings.acceleration * (1 + 1e-6)


# ---- what every arm does; it turns the sensor, so that it comes last ----


class TestUr(ArmContract):
    button, pressed = "emergency_stop", "emergency stop"
    missing = "ur_rtde is missing: pip install ur-rtde"
    scene_file = staticmethod(scene_file)


# ---- joints ----


@pytest.fixture
def jointed():
    """A double with the joints of a UR5e, and where they are."""
    robot = UrRobotSettings()
    chain = load_arm("ur5e")
    joints = chain.reach(pose_of(robot.start), chain.ready)
    double = Double(address(), kinematics="ur5e", joints=joints.tolist())
    yield double, joints
    assert not double.close()


def test_an_arm_with_kinematics_tells_its_joints_and_minds_their_ranges(tmp_path, jointed):
    """The elbow of this one ends 3 degrees ahead."""
    double, start = jointed
    chain = load_arm("ur5e")
    rate = joint_rates(chain, start, np.array([SPEED, 0.0, 0.0, 0.0, 0.0, 0.0]))[2]
    end = float(start[2] + np.copysign(np.radians(3.0), rate))
    text = Path(config_path("arms/ur5e.yaml")).read_text()
    ranges = [-3.1416, round(end, 4)] if rate > 0.0 else [round(end, 4), 3.1416]
    ready = np.degrees(start[2])
    elbow = r"(elbow_joint: {a: .*range: )\[.*?\](.*ready_deg: )[-\d.]+"
    text, changed = re.subn(elbow, rf"\g<1>{ranges}\g<2>{ready:.3f}", text)
    assert changed == 1
    (tmp_path / "short.yaml").write_text(text)
    cell = Cell(scene_file(tmp_path, double.host, kinematics="{description: short.yaml}"))
    try:
        cell.move()
        cell.until(lambda: not cell.command(ALONG) and "joint 3" in cell.state.limited_by, "end of the elbow")
        cell.command(ALONG, 1.0)
        joints = np.array([state.joints for state in cell.states])
        assert abs(joints[-1, 2] - start[2]) > np.radians(2.0)
        assert (np.abs(joints[:, 2] - start[2]) < np.radians(3.1)).all()
        for state in cell.states[:: len(cell.states) // 20]:
            apart = np.abs(cell.arm.kinematics.pose(state.joints) - state.T_base_controlled)
            assert apart.max() < 2e-3
    finally:
        cell.close()


@pytest.mark.parametrize(
    "kinematics, words",
    [
        ("{description: panda}", "tells 6 joints, its kinematics have 7"),
        (
            "{description: ur5e, tool: {position: [0, 0, 0.04]}}",
            "put it 40 mm and 0 degrees from where",
        ),
    ],
)
def test_an_arm_whose_kinematics_are_not_those_of_the_scene_is_not_driven(
    tmp_path, jointed, kinematics, words
):
    double, _ = jointed
    arm = load_scene(scene_file(tmp_path, double.host, kinematics=kinematics)).arms["arm"]
    safe = SafeArm(arm, time.time_ns)
    driver = open_arm(arm, safe.take_state)
    try:
        safe.attach_driver(driver)
        end = time.monotonic() + 5.0
        while not safe.bad_state and time.monotonic() < end:
            time.sleep(0.01)
        assert words in safe.bad_state
        assert safe.command(time.time_ns(), ALONG, "test") == "the arm has no state yet"
        assert not double.trace()[:, 7:13].any()
    finally:
        safe.close()


# ---- what is refused at the start ----


@pytest.fixture(scope="module")
def second():
    """A double that nobody drives yet."""
    double = Double(address())
    yield double
    assert not double.close()


@pytest.fixture
def other(second):
    for line in [*Double.mended, *AS_IT_WAS]:
        second(*line.split())
    return second


@pytest.mark.parametrize(
    "fault, settings, words",
    [
        ("tcp_offset 0 0 0.1 0 0 0", {}, r"its TCP offset is \[0.0, 0.0, 0.1.*the scene says \[0.0"),
        ("payload 1.5", {}, "its payload is 1.5 kg, the scene says 0 kg"),
        ("", {"generation": "cb3"}, r"the arm is a e-series \(PolyScope 5.15.*the scene says cb3"),
        ("", {"model": "UR10"}, "the arm is a UR5, the scene says UR10"),
        ("local_control", {}, "switch it to remote control at the pendant"),
        ("protective_stop", {}, "protective stop of the arm"),
        ("emergency_stop", {}, "emergency stop of the arm"),
        ("teach_button", {}, "moved by hand"),
        ("registers_in_use", {}, "its registers are in use by a fieldbus; set driver_settings.upper_reg"),
        ("old_protocol", {"connect_timeout": 1.0}, "did not answer within 1 s"),
        ("silence", {"connect_timeout": 1.0}, "did not answer within 1 s"),
        ("leave", {}, "does not answer"),
        ("scripts_ignored", {"connect_timeout": 1.0}, "did not answer within 1 s"),
        ("", {"deceleration": 2.0}, "does not stop the arm from 0.1 m/s and 1 rad/s before the watchdog"),
        ("", {"acceleration": 3.0}, "is below the limits of the commands, 1 m/s.2 and 10 rad/s.2"),
        ("", {"generation": "cb3", "rate": 500.0}, "a cb3 has at most 125 Hz"),
    ],
)
def test_an_arm_that_is_not_what_the_scene_says_is_refused_with_what_would_be_right(
    tmp_path, other, fault, settings, words
):
    assert re.search(words, refusal(tmp_path, other, scene_file, fault, **settings))


def test_a_cb3_is_driven_at_125_hz_and_in_the_upper_registers(tmp_path):
    double = Double(address(), version=[3, 15, 0, 0], model="UR3")
    cell = Cell(scene_file(tmp_path, double.host, rate=0.0, generation="cb3", upper_registers=True))
    try:
        cell.move()
        stamps = np.array([state.stamp_ns for state in cell.states])
        assert 7e6 < np.median(np.diff(stamps)) < 50e6
    finally:
        cell.close()
        double.close()


def test_a_driver_with_a_real_time_priority_has_room_on_a_core_of_its_own(tmp_path, other):
    """ur_rtde spins while it waits for its own threads, which must not wait for it on the only core."""
    cores = os.sched_getaffinity(0)
    if not real_time() or len(cores) < 2:
        pytest.skip("no real-time priorities here, or one core only")
    own = min(cores)
    os.sched_setaffinity(other._process.pid, cores - {own})
    try:
        os.sched_setaffinity(0, {own})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(5))
        cell = Cell(scene_file(tmp_path, other.host))
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, cores)
    try:
        cell.move()
    finally:
        cell.close()
