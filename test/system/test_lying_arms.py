"""Whole tasks on arms whose drivers lie, and what comes of it by the simulated cell's own truth."""

import pytest

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_doubles.lying_arm import LyingArm

FOLLOWING, APPROACHING = 7.0, 2.5  # s, of the plane's run

SAYS = {
    "moves_by_itself": "does not do what it is told",
    "moves_sideways": "does not do what it is told",
    "flipped_y": "does not do what it is told",
    "double_speed": "does not do what it is told",
    "servo_off": "does not do what it is told",
    "loses_commands": "does not do what it is told",
    "frozen_pose": "does not do what it is told",
    "frozen_pose_alone": "does not do what it is told",
    "late_states": "pose is ",
    "pose_jumps": "the arm cannot have moved by 5",
}
#: s from the beginning of the lie to rest, and m of way, of what takes a window to be known
WITHIN = dict.fromkeys(("frozen_pose", "frozen_pose_alone", "servo_off"), (0.45, 0.006))
WITHIN["loses_commands"] = (2.0, 0.012)  # it stands and goes
GOES_ON = ("moves_by_itself",)  # nothing here can stop it


@pytest.mark.parametrize("begins", [APPROACHING, FOLLOWING], ids=["approaching", "following"])
@pytest.mark.parametrize("name", SAYS)
def test_a_task_on_an_arm_that_lies_fails_and_the_arm_rests_before_much_comes_of_it(name, begins):
    lies = LyingArm(name, begins)
    record = run_arms_offline("plane", options=OfflineOptions(fidelity="ideal", lies=lies))["arm"]
    assert not record.result["succeeded"] and SAYS[name] in record.result["reason"]
    truth = lies.witness["arm"]
    seconds, way = WITHIN.get(name, (0.25, 0.004))
    if name not in GOES_ON and begins == FOLLOWING:
        assert truth.rests_since < seconds and truth.way < way
    assert truth.deepest < 0.004  # 3 mm are asked for


@pytest.mark.parametrize("name", [name for name in SAYS if name not in GOES_ON])
def test_a_push_on_an_arm_that_lies_ends_and_presses_no_deeper(name):
    lies = LyingArm(name, begins=8.0)
    record = run_arms_offline("pushing", "pushing", OfflineOptions(fidelity="ideal", lies=lies))["arm"]
    assert not record.result["succeeded"] and SAYS[name] in record.result["reason"]
    assert lies.witness["arm"].deepest < 0.0035  # the honest push is 2.1 mm deep


@pytest.mark.parametrize("liar", ["leader", "follower"])
@pytest.mark.parametrize("name", ["moves_sideways", "servo_off", "loses_commands", "frozen_pose"])
def test_where_two_arms_hold_an_object_both_rest_and_it_is_not_crushed(name, liar):
    lies = LyingArm(name, begins=9.0, arm=liar)
    records = run_arms_offline("dual_pushing", "dual_pushing", OfflineOptions(fidelity="ideal", lies=lies))
    assert not records[liar].result["succeeded"]
    assert all(truth.rests_since < 4.0 for truth in lies.witness.values())  # the other one retreats
    assert all(truth.deepest < 0.0061 for truth in lies.witness.values())  # 5.5 mm in an honest push
