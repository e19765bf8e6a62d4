"""The driver of Universal Robots arms against a second controller, written from the manufacturer's guides.

What its arm does is measured against the formulas of the URScript manual for the speeds and accelerations
that its program was given: a change of speed takes |change| / a, from or to rest on a way of change^2 / 2a.
"""

import time

import numpy as np
import pytest
from real_arm import ALONG, ATTEMPTS, PATIENT, SPEED, ZERO, Cell, address
from scipy.spatial.transform import Rotation
from ur_cell import scene_file
from ur_second_controller import PROGRAM_END, STEP, UNLOCKED_AFTER
from ur_second_server import SecondController

from tactile_scene.arm import ArmMode

rtde_control = pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python or machine")

pytestmark = pytest.mark.live

TURNING = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])  # rad/s, about the sensor's axis: the TCP stays
FEW = 3 * STEP  # s, by which the step that something begins and ends in is not known
SILENCE = 0.1  # s, of the driver's watchdog
SLOW = 2.0  # Hz, a watchdog for what is no test of it: a machine that holds a process up does not set it off


@pytest.fixture(scope="module")
def controller():
    controller = SecondController(address())
    yield controller
    controller.close()


@pytest.fixture(scope="module")
def opened(controller, tmp_path_factory):
    folder = tmp_path_factory.mktemp("second")
    cell = Cell(scene_file(folder, controller.host, watchdog=SLOW, state_timeout=PATIENT))
    yield cell
    cell.close()


@pytest.fixture
def cell(opened):
    """The arm at rest and ready, whatever the test before did."""
    make_ready(opened)
    return opened


@pytest.fixture
def alone(tmp_path):
    """A controller and a driver with its own watchdog, for what neither of them survives."""
    controller = SecondController(address())
    cell = Cell(scene_file(tmp_path, controller.host, watchdog=1.0 / SILENCE, state_timeout=PATIENT))
    yield controller, cell
    cell.close()
    controller.close()


def make_ready(cell):
    def follows() -> bool:
        try:
            cell.safe.reset()
        except RuntimeError:
            return False
        return not cell.command(ZERO)

    cell.until(follows, "arm that moves again")
    cell.command(ZERO, 0.05)
    cell.rest()


def tried(run):
    """What it returns; a machine that does something else meanwhile may be late once."""
    for left in reversed(range(ATTEMPTS)):
        try:
            return run()
        except AssertionError:
            if not left:
                raise
    return None


def speeds(trace):
    """Speed (n,) and angular speed (n,) of the TCP."""
    return np.linalg.norm(trace[:, 7:10], axis=1), np.linalg.norm(trace[:, 10:13], axis=1)


def changing(speed) -> slice:
    """From the last row before a speed changes to the first in which it does not any more."""
    changes = np.flatnonzero(np.abs(np.diff(speed)) > 1e-9)
    return slice(changes[0], changes[-1] + 2)


def gone(trace) -> tuple[float, float]:
    """Way (m) and angle (rad) between the first and the last row."""
    turned = Rotation.from_rotvec(trace[-1, 4:7]) * Rotation.from_rotvec(trace[0, 4:7]).inv()
    return float(np.linalg.norm(trace[-1, 1:4] - trace[0, 1:4])), float(turned.magnitude())


def called(calls, name) -> list[list]:
    return [call for call in calls if call[1] == name]


def by_the_manual(calls, end: float, columns: slice) -> float:
    """Way, from rest until `end`, by calls of speedl: v t - |change| change / 2a of each."""
    way, before = 0.0, 0.0
    for call, following in zip(calls, [*calls[1:], [end]], strict=True):
        speed, change_per_s = float(np.linalg.norm(call[2][columns])), call[3]
        lasts = following[0] - call[0]
        change = np.clip(speed - before, -change_per_s * lasts, change_per_s * lasts)
        way += (before + change) * lasts - change * abs(change) / (2.0 * change_per_s)
        before += change
    return way


@pytest.mark.parametrize(
    "twist, acceleration",
    [([0, 0, 0, 0, 0, 0.5], 2.0), ([SPEED, 0, 0, 0, 0, 0], 0.5), ([SPEED, 0, 0, 0.5, 0, 0], 2.0)],
    ids=["turning", "going", "both"],
)
def test_the_program_of_ur_rtde_gives_speedl_and_stopl_one_acceleration_for_both(
    controller, twist, acceleration
):
    control = rtde_control.RTDEControlInterface(controller.host)
    controller.log()
    assert control.speedL(twist, acceleration, 0.0)
    controller.work(0.4)
    assert control.speedStop(2.0 * acceleration)
    assert list(control.getTCPOffset()) == [0.0] * 6
    control.stopScript()
    control.disconnect()
    trace, calls = controller.log()
    assert called(calls, "speedl")[0][2:] == [twist, acceleration, 0.0, None]
    assert called(calls, "stopl")[0][2:] == [2.0 * acceleration, None]
    size = max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:]))
    speed = np.hypot(*speeds(trace))
    top = int(speed.argmax())
    for part, rate in ((slice(0, top + 2), acceleration), (slice(top, None), 2.0 * acceleration)):
        rows = changing(speed[part])
        assert (rows.stop - 1 - rows.start) * STEP == pytest.approx(size / rate, abs=FEW)
        assert max(gone(trace[part][rows])) == pytest.approx(size**2 / (2.0 * rate), rel=0.02)


def test_a_client_of_ur_rtde_that_falls_silent_is_stopped_by_the_watchdog(controller):
    def fall_silent():
        control = rtde_control.RTDEControlInterface(controller.host)
        controller.log()
        assert control.setWatchdog(10.0)
        for _ in range(20):
            assert control.speedL(ALONG.tolist(), 1.0, 0.0)
            time.sleep(0.01)
        controller.work(0.4)
        control.disconnect()
        return controller.log()

    trace, calls = tried(fall_silent)
    (ended,) = called(calls, "ended")
    assert ended[2] == "watchdog"
    speed = speeds(trace)[0]
    assert speed[-1] == 0.0
    braking = changing(speed[trace[:, 0] >= ended[0] - STEP])
    assert (braking.stop - 1 - braking.start) * STEP == pytest.approx(SPEED / PROGRAM_END[0], abs=FEW)


@pytest.mark.parametrize("twist", [0.5 * TURNING, ALONG], ids=["turning", "going"])
def test_a_step_is_followed_as_the_limits_allow_and_ends_where_the_manual_says(cell, controller, twist):
    columns = slice(3, 6) if twist[5] else slice(0, 3)
    size, limits = np.linalg.norm(twist), cell.arm.limits
    most, ramp = limits.linear_acceleration, limits.linear_acceleration / limits.linear_jerk
    if twist[5]:
        most, ramp = limits.angular_acceleration, limits.angular_acceleration / limits.angular_jerk

    def step():
        make_ready(cell)
        controller.log()
        assert not cell.command(twist, 0.5)
        trace, calls = controller.log()
        speed = speeds(trace)[columns.start // 3]
        rows = changing(speed)
        told = called(calls, "speedl")
        (given,), turning = {call[3] for call in told}, {call[5] for call in told}
        assert turning == {None}  # so that `given` is for both
        assert given >= most
        assert speed.max() == pytest.approx(size, rel=1e-6)
        assert size / given - FEW <= (rows.stop - 1 - rows.start) * STEP <= size / most + ramp + 0.05
        way = by_the_manual(told, trace[-1, 0] + STEP, columns)
        assert gone(trace)[columns.start // 3] == pytest.approx(way, rel=0.02)

    tried(step)


@pytest.mark.parametrize("twist", [TURNING, ALONG], ids=["turning", "going"])
def test_an_emergency_stop_of_the_stage_takes_the_time_and_the_way_of_stopl(cell, controller, twist):
    size, which = np.linalg.norm(twist), int(twist[5] > 0.0)

    def stop():
        make_ready(cell)
        cell.until(lambda: not cell.command(twist) and np.abs(cell.state.twist - twist).max() < 1e-4, "speed")
        controller.log()
        cell.safe.estop("test")
        controller.work(0.3)
        trace, calls = controller.log()
        _, _, deceleration, turning = called(calls, "stopl")[0]
        assert turning is None
        speed = speeds(trace)[which]
        rows = changing(speed)
        assert speed[0] == pytest.approx(size, rel=1e-3)
        assert speed[-1] == 0.0
        assert size / deceleration <= 0.1 + FEW  # as the driver's settings promise of both
        assert (rows.stop - 1 - rows.start) * STEP == pytest.approx(size / deceleration, abs=FEW)
        assert gone(trace[rows])[which] == pytest.approx(size**2 / (2 * deceleration), abs=size * STEP)

    tried(stop)


def test_commands_that_end_bring_the_arm_to_rest_and_the_program_goes_on(cell, controller):
    limits = cell.arm.limits
    braking = SPEED / limits.linear_acceleration + limits.linear_acceleration / limits.linear_jerk

    def fall_silent():
        make_ready(cell)
        cell.move()
        controller.log()
        controller.work(0.6)
        trace, calls = controller.log()
        speed = speeds(trace)[0]
        rows = changing(speed)
        assert speed[-1] == 0.0
        assert not called(calls, "ended")
        assert (rows.stop - 1) * STEP <= limits.command_timeout + braking + 0.1

    tried(fall_silent)


@pytest.mark.parametrize("cut", ["deaf", "hang_up"])
def test_a_connection_that_is_cut_leaves_the_arm_at_rest_by_the_watchdog(alone, cut):
    controller, cell = alone
    tried(lambda: (make_ready(cell), cell.move()))
    controller.log()
    controller.ask(*(["deaf", True] if cut == "deaf" else ["hang_up"]))
    controller.work(0.6)
    trace, calls = controller.log()
    _, _, why = called(calls, "ended")[0]
    speed = speeds(trace)[0]
    rows = changing(speed)
    # A client that is hung up on connects anew, is heard once more by that, and may end the program itself.
    latest = SILENCE + 0.05 + (cut == "hang_up") * SILENCE
    assert why == "watchdog" or cut == "hang_up"
    assert speed[-1] == 0.0
    assert (rows.stop - 1) * STEP <= latest + SPEED / PROGRAM_END[0]
    assert gone(trace)[0] <= SPEED * latest + SPEED**2 / (2.0 * PROGRAM_END[0])
    if cut == "deaf":
        controller.ask("deaf", False)  # for those who hang up now


def test_an_arm_that_is_not_ready_or_another_is_refused_in_a_sentence(tmp_path):
    controller = SecondController(address())

    def refused(words: str):
        with pytest.raises(RuntimeError, match=words):
            Cell(scene_file(tmp_path, controller.host))

    for method, value, usual, words in [
        ("set_tcp", [0.0, 0.0, 0.1, 0.0, 0.0, 0.0], [0.0] * 6, "its TCP offset is"),
        ("script_set_payload", 1.5, 0.0, "its payload is 1.5 kg"),
    ]:
        controller.ask("controller", method, value)
        refused(words)
        controller.ask("controller", method, usual)
    for method, words in [
        ("emergency_stop", "emergency stop"),
        ("release", "power it on and release its brakes"),
        ("switch_on", ""),
        ("protective_stop", "protective stop"),
    ]:
        controller.ask("controller", method)
        if words:
            refused(words)
    controller.close()


def test_a_tcp_that_is_changed_in_an_emergency_stop_is_noticed(cell, controller):
    def refusal() -> str:
        try:
            cell.safe.reset()
        except RuntimeError as error:
            return str(error)
        return ""

    tried(lambda: (make_ready(cell), cell.move()))
    controller.ask("controller", "emergency_stop")
    cell.until(lambda: cell.state.mode is ArmMode.ESTOP, "emergency stop")
    assert "emergency stop" in refusal()
    controller.ask("controller", "set_tcp", [0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    controller.ask("controller", "release")
    assert refusal()  # there is no power yet
    controller.ask("controller", "switch_on")
    cell.until(lambda: "its TCP offset is [0.0, 0.0, 0.05" in refusal(), "that refusal")
    controller.log()
    assert cell.command(ALONG, 0.2)
    assert not np.hypot(*speeds(controller.log()[0])).any()
    controller.ask("controller", "set_tcp", [0.0] * 6)
    cell.until(lambda: not refusal(), "reset")
    cell.until(lambda: not cell.command(ZERO), "arm that follows")


def test_a_protective_stop_is_left_by_a_reset_and_not_before_the_controller_allows_it(cell, controller):
    tried(lambda: (make_ready(cell), cell.move()))
    controller.log()
    controller.ask("controller", "protective_stop")
    cell.until(lambda: cell.state.mode is ArmMode.FAULT, "fault")
    with pytest.raises(RuntimeError, match="5 s"):
        cell.safe.reset()
    make_ready(cell)
    trace, calls = controller.log()
    (stopped,), (unlocked,) = called(calls, "protective_stop"), called(calls, "unlocked")
    assert unlocked[0] - stopped[0] >= UNLOCKED_AFTER
    resting = trace[(trace[:, 0] > stopped[0] + 0.1) & (trace[:, 0] < unlocked[0])]
    assert not np.hypot(*speeds(resting)).any()
    cell.move()
