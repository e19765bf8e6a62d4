"""What a task does that itself is wrong, or that nobody asks for a while."""

import re

import numpy as np
import pytest

from tactile_control.phases import FAILED, RETREAT, StampedPose, StampedPresence, TaskInputs
from tactile_control.tasks.surface_following import (
    FollowingGoal,
    SurfaceFollowing,
    SurfaceFollowingSettings,
)
from tactile_geometry import se3

MS = 1_000_000
STEP = 10 * MS


class Plant:
    """A task in contact with a plane that is where the tip needs it to be, 3 mm deep."""

    feels = staticmethod(lambda depth, phase: depth > 0.0)

    def __init__(self, kind=SurfaceFollowing, goal=None, start=None, **contact):
        settings = SurfaceFollowingSettings()
        settings = settings.replaced(**{f"contact__{name}": value for name, value in contact.items()})
        self.task = kind(settings, goal or FollowingGoal(length=0.1), start)
        self.deepest = 0.0
        self.now_ns, self.T = 10**9, se3.pose_from_euler([0, 0, 0.023, 0, np.pi, 0])
        self.commands = []

    def run(self, steps, until=lambda command: False):
        for _ in range(steps):
            depth = 0.020 - self.T[2, 3]
            belief = StampedPose(
                self.now_ns, se3.inverse(se3.pose_from_euler([0, 0, max(depth, 0), 0, 0, 0]))
            )
            self.deepest = max(self.deepest, depth)
            felt = self.feels(depth, self.task.phase)
            inputs = TaskInputs(belief, StampedPresence(self.now_ns, felt), StampedPose(self.now_ns, self.T))
            command = self.task.step(self.now_ns, inputs)
            self.commands.append(command)
            self.T = self.T @ se3.exp(command.twist * STEP * 1e-9)
            self.now_ns += STEP
            if command.done or until(command):
                return command
        return command

    def into(self, phase):
        command = self.run(2000, lambda command: command.phase == phase)
        assert command.phase == phase, command
        return self


class Broken(SurfaceFollowing):
    """A task of somebody's own with a mistake in it, that shows in contact after a while."""

    def reference_velocity(self, elapsed):
        if elapsed > 0.2:
            return {}["speed"]
        return super().reference_velocity(elapsed)


def test_an_exception_in_a_task_fails_it_with_its_text_and_the_tip_leaves_the_surface():
    plant = Plant(Broken).into("follow")
    command = plant.run(2000)
    assert command.done and not command.succeeded and not command.twist.any()
    assert re.fullmatch(r"KeyError in phase follow: 'speed' \(.*test_phases\.py:\d+\)", command.reason)
    assert 'return {}["speed"]' in plant.task.traceback
    assert RETREAT in [command.phase for command in plant.commands]
    assert plant.T[2, 3] > 0.020 + 0.010  # off the surface
    jumps = np.diff([command.twist[2] for command in plant.commands])
    assert np.abs(jumps).max() < 0.5 * 0.011  # within the limiter's acceleration


def test_a_task_whose_last_word_fails_too_comes_to_rest_where_it_is():
    class Worse(Broken):
        def details(self):
            if self.traceback:
                raise ValueError("nothing works")
            return super().details()

    plant = Plant(Worse).into("follow")
    command = plant.run(2000)
    assert command.done and command.phase == FAILED and not command.twist.any()
    assert "KeyError in phase follow: 'speed'" in command.reason


@pytest.mark.parametrize("pause", [0.3, 0.9])
def test_after_a_pause_the_twist_begins_at_rest_and_the_task_goes_on(pause):
    plant = Plant().into("follow")
    plant.run(100)
    assert np.linalg.norm(plant.commands[-1].twist) > 0.005
    plant.now_ns += round(pause * 1e9)
    plant.run(1)
    assert not plant.commands[-1].twist.any()
    assert plant.run(30).phase == "follow" and np.linalg.norm(plant.commands[-1].twist) > 0.005


def test_a_task_that_stood_still_for_longer_than_its_patience_does_not_go_on():
    plant = Plant().into("follow")
    plant.run(100)
    plant.now_ns += 3_000_000_000
    command = plant.run(1)
    assert command.phase == FAILED and not command.twist.any()
    assert "the controller stood still for 3.0" in command.reason and "(limit 1 s)" in command.reason


@pytest.mark.parametrize("way", [1.2, 1e9])
def test_a_start_that_is_far_away_is_refused_before_anything_moves(way):
    start = se3.pose_from_euler([0, 0, 0.023 - way, 0, np.pi, 0])
    plant = Plant(start=start)
    plant.T[2, 3] = 0.05
    command = plant.run(2000)
    assert command.done and not command.succeeded and "m away (limit 1 m)" in command.reason
    assert all(not command.twist.any() for command in plant.commands)


# ---- the first contact ----


def phases_of(plant):
    return list(dict.fromkeys(command.phase for command in plant.commands))


def test_a_dry_touch_comes_before_the_approach_and_by_presence_alone():
    plant = Plant(dry_touch=True).into("follow")
    assert phases_of(plant)[:5] == ["touch", "lift", "approach", "settle", "follow"]
    dry = [command for command in plant.commands if command.phase in ("touch", "lift")]
    assert all(np.isnan(command.error).all() for command in dry)  # nothing is servoed to
    assert plant.deepest < 0.0035


def test_a_contact_that_does_not_end_when_the_tip_lifts_off_is_none():
    plant = Plant(dry_touch=True)
    plant.feels = lambda depth, phase: phase != "touch" or depth > 0.0
    command = plant.run(3000)
    assert command.done and "does not end 9.0 mm off: is it one?" in command.reason
    assert plant.deepest < 0.0005


def test_a_surface_that_is_not_felt_again_where_it_was_ends_the_approach():
    plant = Plant(dry_touch=True)
    plant.feels = lambda depth, phase: phase == "touch" and depth > 0.0
    command = plant.run(3000)
    assert command.done and "a contact was felt 1.5 mm before, and is not felt again" in command.reason
    assert plant.deepest < 0.0025


def test_a_surface_that_is_never_felt_ends_the_approach_after_15_mm():
    plant = Plant()
    plant.T[2, 3] = 0.032  # 12 mm above it, as in the example scenes
    plant.feels = lambda depth, phase: False
    command = plant.run(3000)
    assert command.done and "no contact within 15.0 mm of approach" in command.reason
    assert plant.deepest < 0.0035
