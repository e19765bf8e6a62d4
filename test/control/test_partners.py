"""Arms that hold one object mind each other: whose trouble counts when, and that it ends with its cause."""

from dataclasses import dataclass

import numpy as np
import pytest
from kinematic_plant import PERIOD, Plane, Plant, freeze_after, pointing_down

from tactile_control.partners import Partners
from tactile_control.phases import FAILED, StampedPose
from tactile_control.tasks.surface_following import (
    FollowingGoal,
    SurfaceFollowing,
    SurfaceFollowingSettings,
)

SECOND = 1_000_000_000


@dataclass(frozen=True)
class Says:
    """A word of a task; at work and well unless it says otherwise."""

    at_work: bool = True
    trouble: str = ""
    over: bool = False
    hold: StampedPose | None = None


ENDED_BADLY = Says(at_work=False, trouble="target passed", over=True)
BLIND = Says(trouble="presence is 120 ms old")


def test_an_awaited_arm_is_minded_from_the_beginning_to_the_end():
    partners = Partners(awaited=["follower"], age_limit=0.2)
    assert partners.trouble(0.0) == "follower: nothing is heard of its controller"
    partners.hear("follower", 1.0, Says())
    assert partners.trouble(1.1) == ""
    assert partners.trouble(1.3) == "follower: nothing is heard of its controller"
    partners.hear("follower", 1.4, BLIND)
    assert partners.trouble(1.4) == "follower: presence is 120 ms old"
    partners.hear("follower", 1.45, Says(at_work=False))
    assert partners.trouble(1.5) == "", "it may be waited for a phase before its own"
    partners.hear("follower", 1.5, Says(at_work=False, over=True))
    assert partners.trouble(1.5) == "follower: its task is over"


def test_one_that_waits_for_this_arm_is_minded_from_its_own_work_on():
    partners = Partners(waiting=["leader"], age_limit=0.2)
    assert partners.trouble(5.0) == "", "it may not be there yet"
    partners.hear("leader", 5.0, Says(at_work=False, trouble="no pose has arrived"))
    assert partners.trouble(9.0) == ""
    partners.hear("leader", 9.0, Says())
    assert partners.trouble(9.1) == ""
    assert partners.trouble(9.3) == "leader: nothing is heard of its controller"
    partners.hear("leader", 9.4, BLIND)
    assert partners.trouble(9.4) == "leader: presence is 120 ms old"


def test_where_the_partner_holds_the_object_is_known_while_one_alone_says_so():
    partners = Partners(awaited=["follower"], waiting=["leader"], age_limit=0.2)
    here, there = StampedPose(1, np.eye(4)), StampedPose(2, np.eye(4))
    assert partners.hold is None
    partners.hear("follower", 1.0, Says(hold=here))
    assert partners.hold is here
    partners.hear("leader", 1.0, Says(hold=there))
    assert partners.hold is None
    partners.hear("follower", 1.1, Says())
    assert partners.hold is there


def test_one_that_waits_may_end_well_and_begin_again_but_its_failure_counts_until_the_next_goal():
    partners = Partners(waiting=["leader"], age_limit=0.2)
    partners.hear("leader", 1.0, Says())
    partners.hear("leader", 1.1, Says(at_work=False, over=True))
    assert partners.trouble(9.0) == "", "it has done what it is for, and may say nothing more"
    partners.hear("leader", 9.0, Says())
    partners.hear("leader", 9.1, ENDED_BADLY)
    partners.hear("leader", 9.2, ENDED_BADLY)
    assert partners.trouble(9.2) == "leader: target passed"
    partners.begin()
    partners.hear("leader", 9.3, ENDED_BADLY)
    assert partners.trouble(9.3) == "", "of a goal before"


def test_of_several_each_is_named_and_others_are_of_no_concern():
    partners = Partners(awaited=["left", "right"], waiting=["leader"])
    assert set(partners.arms) == {"left", "right", "leader"}
    for arm in (*partners.arms, "stranger"):
        partners.hear(arm, 0.0, BLIND)
    said = "presence is 120 ms old"
    assert partners.trouble(1e9) == f"leader: {said}; left: {said}; right: {said}"


class Pair:
    """A leader and a follower, each along a plane of its own, that mind each other a step late."""

    def __init__(self, blind: str, at: float, until: float) -> None:
        settings = SurfaceFollowingSettings()
        self.minds = {"leader": Partners(awaited=["follower"]), "follower": Partners(waiting=["leader"])}
        self.plants = {arm: Plant(Plane(), pointing_down((0.0, 0.0, 0.024))) for arm in self.minds}
        self.tasks = {arm: SurfaceFollowing(settings, FollowingGoal(length=0.2)) for arm in self.minds}
        self.commands = {arm: [] for arm in self.minds}
        self.blind, self.at, self.until = blind, at, until
        self.freeze = freeze_after(("belief", "presence"), round((1.0 + at) * SECOND))

    def run(self, seconds: float) -> None:
        for number in range(round(seconds / PERIOD)):
            for arm, plant in self.plants.items():
                inputs, task = plant.inputs(), self.tasks[arm]
                if arm == self.blind and number * PERIOD < self.until:
                    inputs = self.freeze(number, inputs)
                task.partner = self.minds[arm].trouble(plant.now_ns * 1e-9)
                self.commands[arm].append(task.step(plant.now_ns, inputs))
            for arm, plant in self.plants.items():
                plant.step(self.commands[arm][-1].twist)
                for mind in self.minds.values():
                    mind.hear(arm, plant.now_ns * 1e-9, self.commands[arm][-1])

    def moves(self, arm: str, since: float, until: float) -> np.ndarray:
        """Whether it is told to move, step by step."""
        commands = self.commands[arm][round(since / PERIOD) : round(until / PERIOD)]
        return np.array([bool(command.twist.any()) for command in commands])


@pytest.mark.parametrize("blind", ["leader", "follower"])
def test_both_rest_as_one_feels_nothing_and_both_go_on_when_it_feels_again(blind):
    pair = Pair(blind, at=4.0, until=4.7)
    pair.run(7.0)
    for arm, commands in pair.commands.items():
        assert pair.moves(arm, 3.5, 4.0).all()
        assert not pair.moves(arm, 4.25, 4.7).any(), arm
        assert pair.moves(arm, 4.8, 7.0).all(), "an echo of the other one's rest holds nobody"
        assert commands[-1].phase == "follow" and not commands[-1].trouble
    other = next(arm for arm in pair.tasks if arm != blind)
    resting = pair.commands[other][round(4.5 / PERIOD)]
    assert not resting.trouble, "it lacks nothing itself"
    assert resting.reason.startswith(f"{blind}: presence is ") and "leader: follower" not in resting.reason


@pytest.mark.parametrize("blind", ["leader", "follower"])
def test_both_fail_when_one_feels_nothing_for_longer_than_the_patience(blind):
    pair = Pair(blind, at=4.0, until=60.0)
    pair.run(6.0)
    for arm, commands in pair.commands.items():
        assert commands[-1].phase == FAILED and "presence is" in commands[-1].reason
        assert not pair.moves(arm, 4.25, 6.0).any()


def test_the_one_that_is_waited_for_goes_on_when_the_other_one_has_ended_well():
    pair = Pair("", at=60.0, until=0.0)
    pair.run(4.0)
    pair.tasks["leader"].finish()
    pair.run(3.0)
    assert pair.commands["leader"][-1].succeeded
    assert pair.moves("follower", 4.0, 7.0).all()
