"""Does the arm do what it was told? Honest arms of many kinds, and those that are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_drivers.tracking_monitor import TrackingMonitor, in_base
from tactile_geometry import se3
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.arm_settings import ArmLimits, TrackingSettings
from tactile_scene.twist_profile import TwistProfile

SECOND = 1_000_000_000
ALONG = np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
REST = np.zeros(6)
SIDEWAYS, TURN = 0.05 * np.eye(6)[0], 0.3 * np.eye(6)[5]


class Arm:
    """An arm that goes after what it was told a while ago, within limits or with a first-order lag."""

    def __init__(self, delay=0.0, constant=0.0, limits=None, rate=125.0, noise=0.0, seed=0):
        self.limits = limits or ArmLimits()
        self.monitor = TrackingMonitor(self.limits, TrackingSettings())
        self.delay_ns, self.constant = round(delay * SECOND), constant
        self.profile, self.twist = TwistProfile(self.limits), np.zeros(6)
        self.T, self.stamp_ns = se3.pose_from_euler([0.4, 0.1, 0.3, 0.3, np.pi, 0.5]), SECOND
        self.told = [(0, REST)]
        self.period, self.noise, self.random = 1.0 / rate, noise, np.random.default_rng(seed)
        self.scaling, self.found, self.late_ns = 1.0, [], 0

    def tell(self, twist):
        twist = np.asarray(twist, dtype=float)
        self.told.append((self.stamp_ns, twist))
        self.monitor.told(self.stamp_ns, in_base(self.T, twist))

    def does(self, told):
        """What it makes of what it was told `delay` ago, in a period."""
        if self.constant:
            self.twist = self.twist + (told - self.twist) * (1.0 - np.exp(-self.period / self.constant))
            return self.twist * self.period
        way = self.profile.advance(self.period, told)
        self.twist = self.profile.twist
        return way

    def step(self, seconds, twist=None, every=0.016):
        """Go on, told a twist again and again; what the monitor finds first."""
        due_ns = self.stamp_ns
        for _ in range(round(seconds / self.period)):
            if twist is not None and self.stamp_ns >= due_ns:
                self.tell(twist)
                due_ns += round(every * SECOND)
            since = [told for stamp, told in self.told if stamp <= self.stamp_ns - self.delay_ns]
            self.T = self.T @ se3.exp(self.does(self.scaling * since[-1]))
            self.stamp_ns += round(self.period * SECOND)
            said = self.T @ se3.exp(self.noise * self.random.normal(size=6))
            state = ArmState(self.stamp_ns, said, self.twist, ArmMode.MOVING, speed_scaling=self.scaling)
            self.monitor.told(self.stamp_ns, in_base(self.T, self.told[-1][1]))
            if self.monitor.due(self.stamp_ns) and (deviation := self.monitor.see(state, self.late_ns)):
                self.found.append((self.stamp_ns, deviation))
        return self.found[0][1] if self.found else None


twists = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(
    lambda parts: np.array(parts) * np.repeat([0.058, 0.58], 3)
)


@pytest.mark.parametrize("late, accused", [(0.0, True), (0.08, False)])
def test_an_arm_is_as_much_later_than_its_lag_as_its_states_are(late, accused):
    """Where a machine is held up, what the arm is told comes as late as what it says."""
    arm = Arm(delay=0.16)
    arm.late_ns = round(late * SECOND)
    arm.step(1.0, ALONG)
    arm.step(0.5, REST)
    assert bool(arm.found) is accused


@pytest.mark.parametrize("rate", [30.0, 125.0, 500.0])
@pytest.mark.parametrize("delay, constant", [(0.0, 0.0), (0.06, 0.0), (0.0, 0.02), (0.02, 0.015)])
@given(told=st.lists(twists, min_size=1, max_size=4), seconds=st.floats(0.05, 0.8))
@settings(max_examples=8, deadline=None)
def test_an_arm_that_does_what_it_is_told_within_its_lag_is_never_accused(
    rate, delay, constant, told, seconds
):
    arm = Arm(delay, constant, rate=rate, noise=1e-5)
    for twist in [*told, REST]:
        assert arm.step(seconds, twist) is None, arm.found
    assert arm.monitor.shortfall == ""


def test_an_arm_that_is_slowed_down_by_a_slider_is_not_accused_as_long_as_it_says_so():
    arm = Arm()
    arm.scaling = 0.3
    assert arm.step(2.0, ALONG) is None


class Flipped(Arm):
    def does(self, told):
        return super().does(told * [1, -1, 1, 1, 1, 1])


class Double(Arm):
    def does(self, told):
        return super().does(2.0 * told)


class Sideways(Arm):
    def does(self, told):
        return super().does(told + SIDEWAYS)


class Turning(Arm):
    def does(self, told):
        return super().does(told + TURN)


@pytest.mark.parametrize("kind", [Flipped, Double, Sideways, Turning])
def test_an_arm_that_does_something_else_is_known_within_120_ms_of_its_beginning_to_move(kind):
    arm = kind()
    found = arm.step(1.0, ALONG)
    assert not found.by_itself and "it was told to go" in found.text and "and went" in found.text
    assert (arm.found[0][0] - SECOND) / SECOND <= 0.12


@pytest.mark.parametrize("twist", [0.02 * np.eye(6)[0], 0.02 * np.eye(6)[2], 0.2 * np.eye(6)[4]])
def test_an_arm_that_moves_by_itself_is_known_within_a_tenth_of_a_second(twist):
    class ByItself(Arm):
        def does(self, told):
            return twist * self.period

    arm = ByItself()
    found = arm.step(1.0)
    assert found.by_itself and (arm.found[0][0] - SECOND) / SECOND <= 0.1


def test_an_arm_that_does_nothing_of_what_it_is_told_is_known_soon():
    class Off(Arm):
        def does(self, told):
            return np.zeros(6)

    arm = Off()
    assert "and went nowhere" in arm.step(1.0, ALONG).text or "(0.0, 0.0, 0.0) mm" in arm.found[0][1].text
    assert (arm.found[0][0] - SECOND) / SECOND < 0.4


def test_an_arm_that_does_too_little_is_told_first_and_accused_if_it_goes_on():
    class Slow(Arm):
        part = 0.3

        def does(self, told):
            return super().does(self.part * told)

    arm = Slow()
    assert arm.step(0.3, ALONG) is None
    assert arm.monitor.shortfall == "the arm does 30% of what it is told"
    assert "it was told to go" in arm.step(1.0, ALONG).text
    better = Slow()
    better.part = 0.6
    assert better.step(3.0, ALONG) is None and "60%" in better.monitor.shortfall


def test_an_arm_whose_poses_and_speeds_disagree_is_known():
    class Frozen(Arm):
        def does(self, told):
            super().does(told)  # its speeds
            return np.zeros(6)

    arm = Frozen()
    found = arm.step(1.0, ALONG)
    assert found is not None and (arm.found[0][0] - SECOND) / SECOND < 0.4


def test_states_that_pause_for_long_begin_a_new_window():
    arm = Arm()
    arm.step(0.5, ALONG)
    arm.stamp_ns += SECOND  # nobody looked, and it went on
    arm.T = arm.T @ se3.exp(ALONG)
    assert arm.step(0.5, ALONG) is None
