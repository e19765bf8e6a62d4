"""Drivers that lie, behind the safe command stage: what comes of it, by the simulated cell's own truth."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_doubles.lying_arm import ARM_LIES, LyingDriver
from tactile_drivers import sender
from tactile_drivers.safety import SafeArm
from tactile_drivers.sender import Sender
from tactile_geometry import se3
from tactile_scene.arm import ArmMode
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.scene_file import load_scene
from tactile_sim.arm import SimArm

SECOND = 1_000_000_000
ME = "/arm/controller"
ALONG = np.array([0.0, 0.010, 0.0, 0.0, 0.0, 0.0])
DOWN = np.array([0.0, 0.0, 0.030, 0.0, 0.0, 0.0])
REST = np.zeros(6)


class Cell:
    """An arm of the scene `plane` behind the stage, with a driver that lies from now on or not at all."""

    def __init__(self, lie=LyingDriver, feels=False, **safety):
        scene = load_scene("plane").arms["arm"]
        self.arm = SimArm(scene.limits, scene.T_base_start, SECOND)
        self.lying = False
        self.driver = lie(self.arm, lambda stamp_ns: self.lying)
        self.safe = SafeArm(scene, lambda: self.arm.stamp_ns, feels=feels)
        self.safe.attach_driver(self.driver)
        self.safe.take_state(self.driver.state)
        self.statuses = []

    def step(self, seconds, twist=None, session=0):
        """Go on in steps of 8 ms, commanded all the while or not."""
        for _ in range(round(seconds / 0.008)):
            if twist is not None:
                self.refusal = self.safe.command(self.arm.stamp_ns, twist, ME, session)
            self.arm.advance(0.008)
            self.statuses.append(self.safe.take_state(self.driver.state))
        return self.safe.state

    def begin(self, seconds=1.0, twist=ALONG):
        """Be told the truth for a while, at a twist."""
        self.step(0.1, REST)
        state = self.step(seconds, twist)
        assert not self.safe.alarm and state.mode is ArmMode.MOVING
        self.lying, self.began_ns = True, self.arm.stamp_ns
        self.start = self.arm.T_base_controlled[:3, 3].copy()
        return self

    @property
    def way(self):
        return float(np.linalg.norm(self.arm.T_base_controlled[:3, 3] - self.start))


# ---- at the stage ----


def test_an_arm_that_ignores_an_emergency_stop_is_told_louder_than_anything_else_until_a_reset():
    cell = Cell(ARM_LIES["ignores_stop"]).begin()
    cell.safe.estop("hand in the cell")
    state = cell.step(0.4)
    assert state.mode is ArmMode.ESTOP
    assert state.reason.startswith("THE ARM DOES NOT STOP, press the emergency stop that is wired to it")
    assert "emergency stop: hand in the cell" in state.reason
    assert cell.safe.alarm.startswith("THE ARM DOES NOT STOP")
    with pytest.raises(RuntimeError, match="told to rest, and moves"):
        cell.safe.reset()
    cell.lying = False
    cell.driver.stop("somebody pressed the real one")
    assert cell.step(0.5).reason.startswith("THE ARM DOES NOT STOP")  # still to be seen
    cell.safe.reset()
    assert cell.step(0.1).mode is ArmMode.RESTING
    assert "waits for a twist of zero" in (cell.step(0.1, ALONG) and cell.refusal)


def test_an_arm_that_does_not_stop_is_told_to_again_and_again():
    told = []

    class Deaf(ARM_LIES["ignores_stop"]):
        def stop(self, reason):
            told.append(self.arm.stamp_ns)

    cell = Cell(Deaf).begin()
    cell.safe.estop("test")
    cell.step(1.0)
    late = [stamp for stamp in told if stamp > cell.began_ns + SECOND // 2]
    assert len(late) >= 7 and np.diff(late).max() < 0.1 * SECOND


def test_an_arm_that_nobody_commands_and_that_moves_is_stopped_within_100_ms():
    cell = Cell(ARM_LIES["moves_by_itself"])
    cell.step(1.0)
    cell.lying, cell.began_ns = True, cell.arm.stamp_ns
    cell.step(0.1)
    assert cell.safe.alarm.startswith("the arm moves by itself: in ")
    assert cell.safe.state.mode is ArmMode.FAULT
    assert "THE ARM DOES NOT STOP" in cell.step(0.5).reason


def test_the_first_reason_of_an_alarm_stays_until_a_reset():
    cell = Cell(ARM_LIES["flipped_y"]).begin()
    first = cell.step(0.3, ALONG).reason
    assert "does not do what it is told" in first and cell.refusal.startswith("the arm was stopped: ")
    cell.lying = False
    assert cell.step(2.0, ALONG).reason == first
    assert cell.arm.twist.any() == np.False_
    cell.safe.reset()
    cell.step(0.1, REST)
    assert cell.step(0.5, ALONG).mode is ArmMode.MOVING and not cell.safe.alarm


def test_a_jump_is_never_believed_however_long_one_waits_and_a_reset_begins_anew():
    cell = Cell(ARM_LIES["pose_jumps"]).begin()
    believed = cell.safe.state
    cell.step(3.0, ALONG)
    assert cell.safe.state is believed and not cell.arm.twist.any()
    assert "cannot have moved by 50" in cell.safe.alarm and "cannot have moved by 50" in cell.safe.bad_state
    cell.safe.reset()
    state = cell.step(0.1, REST)
    assert state.mode is not ArmMode.FAULT
    np.testing.assert_allclose(state.T_base_controlled[:3, 3], cell.driver.state.T_base_controlled[:3, 3])


@pytest.mark.parametrize("silent", [0.05, 0.2, 1.0, 10.0])
def test_an_arm_at_rest_may_be_no_further_after_a_silence_however_long_it_was(silent):
    cell = Cell(ARM_LIES["pose_jumps"])
    cell.step(1.0)
    cell.arm.advance(silent)
    cell.lying = True
    assert cell.safe.take_state(cell.driver.state) is None and "cannot have moved" in cell.safe.alarm


def test_after_a_silence_in_motion_an_arm_may_have_come_as_far_as_it_was_told():
    cell = Cell().begin(twist=0.05 * np.eye(6)[1])
    for _ in range(10):  # states are lost, commands are not
        cell.safe.command(cell.arm.stamp_ns, 0.05 * np.eye(6)[1], ME)
        cell.arm.advance(0.008)
    assert cell.safe.take_state(cell.driver.state) is not None and not cell.safe.alarm


def test_states_that_come_late_are_told_before_they_are_a_fault():
    cell = Cell().begin()
    late_ns = 0
    cell.safe._watch._clock = lambda: cell.arm.stamp_ns + late_ns
    late_ns = 150_000_000
    assert "states of the arm come 0.1" in cell.step(1.0, ALONG).remark and not cell.safe.alarm
    late_ns = 250_000_000
    assert cell.step(2.0, ALONG).mode is ArmMode.FAULT and "late (limit 0.2 s)" in cell.safe.alarm


def test_an_arm_at_rest_may_say_so_late():
    cell = Cell()
    cell.safe._watch._clock = lambda: cell.arm.stamp_ns + SECOND
    assert "states of the arm come 1.0" in cell.step(5.0).remark
    assert not cell.safe.alarm and cell.safe.state.mode is ArmMode.RESTING


def test_a_burst_of_states_after_a_pause_is_no_lateness():
    cell = Cell().begin()
    for _ in range(5):
        now_ns = cell.arm.stamp_ns + SECOND // 2
        cell.safe._watch._clock = lambda now_ns=now_ns: now_ns
        cell.step(0.5, ALONG)  # all of them come at the end of it
        cell.safe._watch._clock = lambda: cell.arm.stamp_ns
        cell.step(0.5, ALONG)
        assert not cell.safe.alarm


# ---- calls that take their time ----


class Slow(LyingDriver):
    """A driver whose `command` takes 2 s, and which is not said to be prompt."""

    prompt = False

    def __init__(self, arm, begun):
        super().__init__(arm, begun)
        self.stops, self.commands = [], []

    def command(self, stamp_ns, twist):
        self.commands.append(np.array(twist))
        if self.begun(0):
            time.sleep(2.0)

    def stop(self, reason):
        self.stops.append((time.monotonic(), reason))


def test_an_emergency_stop_does_not_wait_for_a_drivers_command():
    cell = Cell(Slow)
    assert isinstance(cell.safe.driver, Sender)
    cell.step(0.1, REST)
    cell.lying = True
    begun = time.monotonic()
    cell.step(0.02, ALONG)
    assert time.monotonic() - begun < 1.0
    while not any(twist.any() for twist in cell.driver.commands):
        assert time.monotonic() - begun < 30.0
        time.sleep(0.001)  # until a command is under way, for 2 s
    asked = time.monotonic()
    cell.safe.estop("button")
    assert cell.driver.stops and cell.driver.stops[0][0] - asked < 0.5
    before, count = len(cell.driver.stops), len(cell.driver.commands)
    time.sleep(2.5)
    assert len(cell.driver.stops) > before, "it stops once more when the command has returned"
    assert len(cell.driver.commands) == count, "nothing that waited is sent after a stop"
    remark = cell.step(0.02).remark
    assert "the driver's command took 2." in remark and "(at most 0.01 s)" in remark


def test_a_call_that_took_too_long_is_told_for_a_while_and_not_for_ever(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(sender, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    timer = sender.CallTimer()
    timer("command", now.__setitem__, 0, 0.25)
    assert timer.remark == "the driver's command took 0.250 s (at most 0.01 s)"
    timer("command", now.__setitem__, 0, 9.0)
    assert "took 8.750 s" in timer.remark
    timer("command", now.__setitem__, 0, 9.005)
    assert "took 8.750 s" in timer.remark
    now[0] = 19.1
    assert timer.remark == ""


def test_an_emergency_stop_passes_whoever_holds_the_stage():
    cell = Cell(Slow)
    cell.safe._lock.acquire()
    stopper = threading.Thread(target=cell.safe.estop, args=("button",), daemon=True)
    stopper.start()
    end = time.monotonic() + 60.0
    while not cell.driver.stops and time.monotonic() < end:
        time.sleep(0.01)
    assert cell.driver.stops
    cell.safe._lock.release()
    stopper.join(10.0)


def test_what_a_driver_raises_in_its_own_thread_reaches_whoever_commands_next():
    class Broken(Slow):
        def command(self, stamp_ns, twist):
            raise OSError("no route to host")

    cell = Cell(Broken)
    with pytest.raises(OSError, match="no route"):
        for _ in range(1000):
            cell.step(0.008, REST)
            time.sleep(0.005)


def test_an_emergency_stop_that_comes_during_a_reset_stays():
    cell = Cell()
    cell.arm.fault("pressed too hard")
    cell.step(0.1)
    cell.safe.estop("first")
    cell.driver.recover = lambda: cell.safe.estop("second")
    with pytest.raises(RuntimeError, match="meanwhile"):
        cell.safe.reset()
    cell.step(0.1)
    assert cell.safe.state.mode is ArmMode.ESTOP


# ---- who commands ----


def test_a_commander_with_the_owners_name_and_another_session_is_refused():
    cell = Cell()
    cell.step(0.1, REST, session=7)
    assert cell.step(0.5, ALONG, session=7).mode is ArmMode.MOVING
    refusal = cell.safe.command(cell.arm.stamp_ns, DOWN, ME, 8)
    assert "somebody else commands the arm as /arm/controller, too" in refusal
    cell.step(1.0)
    assert "twist of zero" in cell.safe.command(cell.arm.stamp_ns, DOWN, ME, 8)


def test_two_who_send_as_one_are_both_refused_and_the_arm_rests():
    cell = Cell()
    for number in range(1, 101):
        assert cell.safe.command(cell.arm.stamp_ns, REST if number < 5 else ALONG, ME, 7, number) == ""
        cell.step(0.008)
    assert "two commanders send as" in cell.safe.command(cell.arm.stamp_ns, DOWN, ME, 7, 3)
    assert "twist of zero" in cell.safe.command(cell.arm.stamp_ns, ALONG, ME, 7, 101)
    assert not cell.step(0.3).twist.any()
    assert cell.safe.command(cell.arm.stamp_ns, REST, ME, 7, 102) == ""
    assert cell.safe.command(cell.arm.stamp_ns, ALONG, ME, 7, 103) == ""


def test_a_stream_of_refused_twists_never_takes_the_arm():
    cell = Cell().begin()
    for _ in range(500):  # the owner is dead, a joystick is held down
        assert cell.safe.command(cell.arm.stamp_ns, DOWN, "/joystick", 3)
        cell.step(0.008)
    assert not cell.arm.twist.any()
    cell.safe.command(cell.arm.stamp_ns, REST, "/joystick", 3)
    assert cell.safe.command(cell.arm.stamp_ns, DOWN, "/joystick", 3) == ""
    assert cell.step(0.008).owner == "/joystick"


# ---- nothing is felt ----


def test_an_arm_of_whose_contact_nothing_is_heard_backs_off_or_crawls():
    cell = Cell(feels=True)
    cell.step(0.1, REST)
    state = cell.step(0.5, DOWN)
    assert state.limited_by == "no word of the contact: 0.002 m/s"
    np.testing.assert_allclose(cell.arm.twist, DOWN * (0.002 / 0.030), atol=1e-9)
    cell.step(0.5, ALONG)
    np.testing.assert_allclose(cell.arm.twist, 0.2 * ALONG, atol=1e-9)
    cell.step(0.5, np.array([0, 0, 0, 1.0, 0, 0]))
    assert cell.arm.twist[3] == pytest.approx(0.1)
    assert cell.step(0.5, -DOWN).limited_by == ""
    np.testing.assert_allclose(cell.arm.twist, -DOWN, atol=1e-9)


def test_an_arm_that_hears_of_no_contact_moves_freely_and_for_a_while_after():
    cell = Cell(feels=True)
    cell.step(0.1, REST)
    for _ in range(50):
        cell.safe.take_contact(cell.arm.stamp_ns, None)
        cell.step(0.008, DOWN)
    assert cell.safe.state.limited_by == "" and cell.arm.twist[2] == pytest.approx(0.03)
    assert cell.step(0.2, DOWN).limited_by == ""
    assert "no word of the contact" in cell.step(0.2, DOWN).limited_by


def test_an_arm_without_a_sensor_feels_nothing_and_is_not_limited_by():
    scene = load_scene("tracking_flat").arms["leader"]
    arm = SimArm(ArmLimits(), scene.T_base_start, SECOND)
    safe = SafeArm(scene, lambda: arm.stamp_ns)
    safe.attach_driver(arm)
    safe.take_state(arm.state)
    assert safe.command(arm.stamp_ns, REST, ME) == "" and safe.command(arm.stamp_ns, ALONG, ME) == ""
    assert safe.state is not None and se3.norm(safe._sent[:3]) == pytest.approx(0.010)
