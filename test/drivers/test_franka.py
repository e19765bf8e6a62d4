"""The driver of Franka's arms, behind the safe command stage, against the double of their controller.

Distances and times are those of the double's own arm; faults come while it moves at 50 mm/s and goes on being
commanded.
"""

import os
import re
import time

import numpy as np
import pytest
from franka_cell import LIMITS, Double, scene_file
from real_arm import (
    ALONG,
    ATTEMPTS,
    PATIENT,
    SPEED,
    STILL,
    WITHIN,
    ZERO,
    ArmContract,
    Cell,
    address,
    check_clock_jump,
    check_stop,
    mend,
    prompt,
    real_time,
    refusal,
)

from tactile_scene.arm import ArmMode, open_arm
from tactile_scene.scene_file import load_scene

pytest.importorskip("franky", reason="franky-control has no wheel for this Python or machine")
pytest.importorskip("franky_sim", reason="franky-sim is not installed")

pytestmark = pytest.mark.live

FILTERED = 0.02  # s by which the filter of what is commanded draws out a stop, until nothing is left of it
AS_IT_WAS = ["recover", "version 0", "mass 0", "end_effector 0 0 0 0 0 0"]


@pytest.fixture(scope="module")
def double():
    double = Double(address())
    yield double
    assert not double.close()


@pytest.fixture(scope="module", params=[PATIENT])
def opened(double, tmp_path_factory, request):
    """A machine that holds it up is no silence of the arm, but for tests of that: `prompt`."""
    double.mend()
    cell = Cell(scene_file(tmp_path_factory.mktemp("franka"), double.host, state_timeout=request.param))
    yield cell
    cell.close()


@pytest.fixture
def cell(opened, double):
    """The arm at rest and ready, whatever the test before did."""
    if not real_time():
        pytest.skip("needs real-time priorities: a thread that is late makes the motions rough")
    mend(opened, double)
    return opened


@pytest.mark.parametrize(
    "fault, words, mode",
    [
        ("joint_reflex", "joint reflex: more torque on a joint", ArmMode.FAULT),
        ("cartesian_reflex", "Cartesian reflex: more force on the tool", ArmMode.FAULT),
        ("cartesian_position_limits", "cartesian position limits violation", ArmMode.FAULT),
        ("user_stop", "the user stop is pressed", ArmMode.ESTOP),
        ("guiding", r"moved by hand \(guiding\)", ArmMode.FAULT),
        ("runs_away 0.3", r"the arm moves at 0\.3\d*, 2 times its limit of 0\.1", ArmMode.FAULT),
    ],
)
def test_what_goes_wrong_at_the_controller_stops_the_arm_and_is_told(cell, double, fault, words, mode):
    check_stop(cell, double, lambda: double(*fault.split()), words, mode)


@prompt
@pytest.mark.parametrize(
    "fault, words",
    [
        ("drop", "connection lost|lost, and is back"),
        ("leave", "connection"),
        ("silence", "connection lost: no state of the arm for 0.1 s|lost, and is back"),
        ("slow 0.3", "connection lost: no state|late|lost, and is back"),
        ("garbled", "in fault"),
    ],
)
def test_a_controller_that_is_not_heard_any_more_stops_the_arm_and_it_is_told(cell, double, fault, words):
    check_stop(cell, double, lambda: double(*fault.split()), words)


def test_commands_that_do_not_come_any_more_stop_the_arm_as_a_reflex(cell, double):
    """All that is sent to the controller is lost, as when the driver's machine stands still."""
    check_stop(cell, double, lambda: double("deaf"), "commands came too late or not at all")


def test_a_driver_whose_thread_hangs_leaves_the_arm_to_a_motion_that_ends_in_rest(cell, double):
    for _ in range(ATTEMPTS):
        cell.move()
        with cell.driver._changed:  # neither commands nor states pass
            since = double("success_rate", 1.0)
            time.sleep(0.5)
            trace = double.trace()
        moving = np.flatnonzero((np.abs(trace[:, 7:13]) > STILL).any(axis=1))[-1]
        seconds = trace[moving, 0] - since
        mend(cell, double)
        if seconds < WITHIN:
            break
    assert seconds < WITHIN


def test_a_reflex_is_left_by_a_reset_alone(cell, double):
    before = double("recoveries")
    double("cartesian_reflex")
    cell.until(lambda: cell.state.mode is ArmMode.FAULT, "fault")
    time.sleep(0.2)
    assert double("recoveries") == before
    cell.safe.reset()
    cell.until(lambda: cell.state.mode is ArmMode.RESTING, "rest")
    assert double("recoveries") == before + 1
    assert not cell.command(ZERO)
    cell.move()


def test_a_reflex_that_has_to_be_left_by_hand_says_so(cell, double):
    double("reflex_stays")
    double("joint_reflex")
    cell.until(lambda: cell.state.mode is ArmMode.FAULT, "fault")
    with pytest.raises(RuntimeError, match="recovered by hand, in Desk"):
        cell.safe.reset()


@pytest.mark.parametrize("fault", ["loss 0.05", "slow 0.01"])
def test_packages_lost_or_a_little_late_do_not_stop_the_arm(cell, double, fault):
    double(*fault.split())
    for _ in range(ATTEMPTS):
        cell.move()
        double.trace()
        refusal = cell.command(ALONG, 0.5)
        off = np.abs(double.trace()[:, 7:10] - ALONG[:3]).max()
        if not refusal and off < 0.2 * SPEED:
            break
        mend(cell, double)
        double(*fault.split())
    assert not refusal
    assert off < 0.2 * SPEED


def test_commands_that_do_not_all_come_in_time_are_told(cell, double):
    cell.move()
    double("success_rate", 0.9)
    cell.command(ALONG, 0.2)
    assert "control command success rate 90%" in cell.state.reason
    assert cell.state.mode is ArmMode.MOVING


def test_the_thresholds_of_collisions_are_those_of_the_scene(cell, double):
    torque, force = cell.driver.settings.collision_torque, cell.driver.settings.collision_force
    assert tuple(double("collision")) == (*torque, *torque, *force, *force)


def test_a_controllers_clock_that_jumps_ahead_makes_no_stamp_go_back_or_ahead(cell, double):
    check_clock_jump(cell, double, 30.0)


def test_an_emergency_stop_of_the_stage_brings_the_arm_to_rest_within_the_limits(cell, double):
    """By what is commanded in answer to which cycle of the arm's, however late it comes there."""
    cell.move()
    double("commands")
    cell.safe.estop("test")
    assert "emergency stop: test" in cell.command(ALONG, 0.3)
    rows = np.array(double("commands"))
    cycles, speed = rows[:, 0], np.linalg.norm(rows[:, 1:4], axis=1)
    full, still = np.flatnonzero(speed > SPEED - 1e-4)[-1], np.flatnonzero(speed > STILL)[-1]
    assert full < still < len(rows) - 1, "it does not come to rest"
    limits = cell.arm.limits
    braking = SPEED / limits.linear_acceleration + limits.linear_acceleration / limits.linear_jerk
    assert 1e-3 * (cycles[still] - cycles[full]) <= braking + FILTERED
    assert not double.trace()[-1, 7:13].any()


# ---- what every arm does; it turns the sensor, so that it comes last ----


class TestFranka(ArmContract):
    button, pressed = "user_stop", "user stop"
    missing = "is missing: pip install franky-control"
    scene_file = staticmethod(scene_file)


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


def test_an_arm_that_is_opened_in_a_reflex_is_in_fault_until_a_reset(tmp_path, other):
    other("joint_reflex")
    states = []
    driver = open_arm(load_scene(scene_file(tmp_path, other.host)).arms["arm"], states.append)
    try:
        assert states[-1].mode is ArmMode.FAULT and "joint reflex" in states[-1].reason
        driver.recover()
        end = time.monotonic() + 5.0
        while states[-1].mode is not ArmMode.RESTING and time.monotonic() < end:
            time.sleep(0.01)
        assert states[-1].mode is ArmMode.RESTING
    finally:
        driver.close()


@pytest.mark.parametrize(
    "fault, settings, words",
    [
        (
            "end_effector 0 0 0.1 0 0 0",
            {},
            r"its end effector stands at \[0.0, 0.0, 0.1.* the scene says \[0",
        ),
        ("mass 1.5", {}, "its end effector and load weigh 1.5 kg, the scene says 0 kg"),
        ("", {"model": "panda"}, "the arm is an FR3, the scene says panda"),
        ("user_stop", {}, "the user stop is pressed"),
        ("guiding", {}, "moved by hand"),
        ("version 5", {}, "it speaks version 5 of the control interface, and this franky 10"),
        ("silence", {"connect_timeout": 1.0}, "did not answer within 1 s"),
        ("leave", {}, "it does not answer on port 1337; is FCI activated in Desk"),
        (
            "",
            {"limits": LIMITS.replace("4.0", "10.0")},
            "angular_acceleration = 10: with a fr3 it has to be at",
        ),
        ("", {"limits": "{linear_velocity: 4.0}"}, "linear_velocity = 4: with a fr3 it has to be at most"),
    ],
)
def test_an_arm_that_is_not_what_the_scene_says_is_refused_with_what_would_be_right(
    tmp_path, other, fault, settings, words
):
    assert re.search(words, refusal(tmp_path, other, scene_file, fault, **settings))


@pytest.mark.skipif("rt" in os.uname().release or os.path.exists("/sys/kernel/realtime"), reason="real-time")
def test_a_kernel_without_real_time_is_refused_unless_the_scene_allows_it(tmp_path, other):
    arm = load_scene(scene_file(tmp_path, other.host, realtime=True)).arms["arm"]
    with pytest.raises(RuntimeError, match=r"without them: driver_settings\.realtime: false"):
        open_arm(arm, lambda state: None)
