"""Estimates that lie, in whole runs without ROS, held against the cell's truth.

A lie begins while the task is at its work. What it leads to is measured: how deep the tip is in truth, when
the arms rest, and what is said.
"""

import numpy as np
import pytest

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task, task_path
from tactile_doubles.lying_estimates import LYING_ESTIMATES, REFUSED_COVARIANCES
from tactile_perception.estimating.estimator import shipped_model
from tactile_perception.estimating.perceive import DepthAgreement

BEGINS = {"plane": 6.0, "ramp": 6.0, "dome": 6.0, "tracking_flat": 8.0, "pushing": 8.0, "dual_pushing": 12.0}
TASKS = {"pushing": "pushing", "dual_pushing": "dual_pushing"}
TASKS |= dict.fromkeys(("tracking_flat", "tracking_ball"), "object_tracking")
LIAR = dict.fromkeys(("tracking_flat", "tracking_ball", "dual_pushing"), "follower")
GOALS = {"dome": ("theta_1",)}
DEEP = 6.0  # mm, of which no tip may be deeper
EVERY_COVARIANCE = [f"covariance {name}" for name in REFUSED_COVARIANCES]


def lied_to(scene, lie, fidelity="fitted", arm=None, begins=None, seed=0):
    """Records by arm of a run with that lie, and the stamp of its beginning."""
    begins = BEGINS.get(scene, 8.0) if begins is None else begins
    lies = LYING_ESTIMATES[lie](begins, arm or LIAR.get(scene, "arm"))
    options = OfflineOptions(fidelity=fidelity, seed=seed, goals=GOALS.get(scene, ()), lies=lies)
    return run_arms_offline(scene, TASKS.get(scene, "surface_following"), options), lies.begins_ns


@pytest.fixture
def any_plain_depth(monkeypatch):
    """Estimates are not held against the brightness of images: other checks have to do without."""
    monkeypatch.setattr(DepthAgreement, "__call__", lambda self, percept, limit: percept)


def depth_mm(record, begin_ns=0, end_ns=2**62):
    stamp_ns = record.truth.stamp_ns
    return 1e3 * record.truth.T_fs[(stamp_ns >= begin_ns) & (stamp_ns < end_ns), 2, 3]


def stopped_ns(records, begin_ns):
    """When the first arm was told to stop."""
    stops = []
    for record in records.values():
        command = record.command
        found = (command.stamp_ns >= begin_ns) & np.isin(command.phase, ("stopping", "failed"))
        stops += command.stamp_ns[found][:1].tolist()
    return min(stops)


def rests_after_ms(records, stop_ns):
    """Until the last of the arms rests, from the stop on."""
    first = []
    for record in records.values():
        rests = np.linalg.norm(record.arm_twist.twist[:, :3], axis=1) < 2e-3
        first.append(record.arm_twist.stamp_ns[rests & (record.arm_twist.stamp_ns >= stop_ns)][0])
    return (max(first) - stop_ns) / 1e6


def check(records, begin_ns, known_s, said):
    """Known within so many seconds, at rest 200 ms later, nothing deep, and told."""
    stop_ns = stopped_ns(records, begin_ns)
    assert (stop_ns - begin_ns) / 1e9 <= known_s
    assert rests_after_ms(records, stop_ns) <= 200.0
    for record in records.values():
        assert not record.result["succeeded"] and said in record.result["reason"]
        if len(record.truth):
            assert depth_mm(record, begin_ns).max() <= DEEP


@pytest.mark.parametrize(
    "lie, known_s, said",
    [
        ("z drifts up", 2.0, ""),
        ("z drifts down", 2.0, ""),
        ("z flipped", 0.2, "the brightness of the image"),
        ("tilts flipped", 1.3, "the surface's normal turned by"),
        ("images mirrored", 1.5, ""),
        ("images turned by 180 degrees", 1.0, "the estimates contradict the arm's motion"),
        ("5 mm of noise", 0.3, ""),
        ("10 degrees of noise", 0.5, ""),
        ("twice as large", 0.2, "by itself"),
        ("frozen", 0.3, "no belief came of"),
        ("frozen with noise", 8.0, ""),
        ("covariance not a number", 0.15, "no belief came of 52% of the latest images that show contact"),
    ],
)
@pytest.mark.parametrize("scene", ["plane", "ramp", "dome"])
def test_following_stops_for_estimates_that_the_arms_own_motion_contradicts(scene, lie, known_s, said):
    check(*lied_to(scene, lie), known_s, said)


@pytest.mark.parametrize(
    "scene, lie, said",
    [
        ("ramp", "x drifts up", "mm sideways of its path"),
        ("ramp", "x drifts down", "mm sideways of its path"),
        ("ramp", "beta drifts up", "degrees about its path"),
        ("plane", "beta drifts down", "degrees about its path"),
    ],
)
def test_a_path_that_is_led_astray_ends(scene, lie, said):
    """The surface may be a curved one, for all that the estimates and the arm's motion say."""
    records, begin_ns = lied_to(scene, lie)
    result = records["arm"].result
    assert not result["succeeded"] and said in result["reason"]
    assert depth_mm(records["arm"], begin_ns).max() <= 4.0


@pytest.mark.parametrize("lie", ["z flipped", "5 mm of noise", "frozen", "half as large"])
def test_a_lie_from_the_start_is_known_while_the_task_settles(lie):
    """The arm goes in by some millimetres then, and what is told has to follow."""
    records, _ = lied_to("plane", lie, begins=0.0)
    assert depth_mm(records["arm"]).max() <= 4.0
    assert not records["arm"].result["succeeded"] and "follow" not in records["arm"].command.phase


@pytest.mark.parametrize("lie", EVERY_COVARIANCE)
def test_covariances_that_are_refused_bring_the_arm_to_rest_within_200_ms(lie):
    records, begin_ns = lied_to("plane", lie)
    stop_ns = stopped_ns(records, begin_ns)
    assert (stop_ns - begin_ns) / 1e6 + rests_after_ms(records, stop_ns) <= 200.0


@pytest.mark.parametrize(
    "lie, known_s",
    [
        ("z flipped", 0.3),
        ("half as large", 0.1),
        ("2 mm too deep", 0.1),
        ("2 mm too shallow", 0.1),
        ("5 mm of noise", 0.4),
        ("10 degrees of noise", 0.4),
        ("tilts flipped", 1.0),
        ("frozen", 0.3),
        ("covariance zero", 0.15),
    ],
)
def test_tracking_stops_for_them_though_its_surface_moves(lie, known_s):
    check(*lied_to("tracking_flat", lie), known_s, "follower: track: ")


@pytest.mark.parametrize(
    "lie, known_s",
    [("5 mm of noise", 0.4), ("10 degrees of noise", 0.4), ("frozen", 0.3), ("covariance zero", 0.15)],
)
def test_a_push_stops_for_them(lie, known_s):
    check(*lied_to("pushing", lie), known_s, "push: ")


@pytest.mark.parametrize("arm", ["follower", "leader"])
@pytest.mark.parametrize(
    "lie, known_s",
    [
        ("z flipped", 0.3),
        ("5 mm of noise", 0.4),
        ("tilts flipped", 2.0),
        ("frozen", 0.3),
        ("covariance zero", 0.15),
    ],
)
def test_of_two_arms_that_hold_an_object_both_rest_and_do_not_crush_it(arm, lie, known_s):
    records, begin_ns = lied_to("dual_pushing", lie, arm=arm)
    stop_ns = stopped_ns(records, begin_ns)
    assert (stop_ns - begin_ns) / 1e9 <= known_s and rests_after_ms(records, stop_ns) <= 200.0
    for record in records.values():
        before = depth_mm(record, begin_ns - 10**9, begin_ns).max()
        assert depth_mm(record, begin_ns).max() <= before + 0.5
        assert not record.result["succeeded"]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lie, known_s", [("z drifts down", 3.0), ("alpha drifts down", 10.0)])
def test_tracking_an_object_whose_leader_is_known_is_held_against_its_motion(
    lie, known_s, seed, any_plain_depth
):
    """By itself the follower would believe that the plate moves as slowly as its depth drifts."""
    check(*lied_to("tracking_flat", lie, seed=seed), known_s, "seen from the arm that carries the object")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scene", ["tracking_flat", "tracking_ball"])
@pytest.mark.parametrize("lie", ["frozen with noise", "z drifts down"])
def test_the_brightness_of_images_ends_tracking_whose_depth_nothing_else_contradicts(lie, scene, seed):
    records, begin_ns = lied_to(scene, lie, seed=seed)
    assert depth_mm(records["follower"], begin_ns).max() <= DEEP
    assert "protective stop" not in records["follower"].result["reason"]


def moved_by_a_person(lie, seed):
    """Of an object that nobody says how it moves: deepest in mm, and how it ended."""
    task = load_task(
        task_path("object_tracking"), "tracking_flat", changes=["follower.surface.carried=false"]
    )
    lies = LYING_ESTIMATES[lie](8.0, "follower")
    options = OfflineOptions(fidelity="fitted", seed=seed, lies=lies)
    record = run_arms_offline("tracking_flat", task, options)["follower"]
    return depth_mm(record, lies.begins_ns).max(), record.result["reason"]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("lie", ["z drifts down", "frozen with noise"])
def test_the_same_of_what_a_person_moves(lie, seed):
    deepest, reason = moved_by_a_person(lie, seed)
    assert deepest <= DEEP and "no belief came of" in reason


def test_without_brightness_and_a_carrier_a_drift_of_the_depth_ends_at_the_arms_own_stop(any_plain_depth):
    assert "protective stop" in moved_by_a_person("z drifts down", 0)[1]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("arm", ["follower", "leader"])
def test_two_arms_know_of_a_depth_that_drifts_by_the_width_of_their_object(arm, seed, any_plain_depth):
    """A follower cannot tell a drift from an object that moves, nor can a leader; both together can."""
    records, begin_ns = lied_to("dual_pushing", "z drifts down", arm=arm, seed=seed)
    assert max(depth_mm(record, begin_ns).max() for record in records.values()) <= DEEP
    assert (stopped_ns(records, begin_ns) - begin_ns) / 1e9 <= 2.5
    assert "the object between both arms became 1." in records["leader"].result["reason"]


@pytest.mark.parametrize("lie", ["x drifts up", "x drifts down"])
def test_a_follower_whose_shear_drifts_climbs_no_further_than_its_workspace_and_presses_no_deeper(lie):
    """The sensor's x is vertical: a tip that climbs far enough turns the object over."""
    records, begin_ns = lied_to("dual_pushing", lie)
    height = 1e3 * records["follower"].pose.T_base_sensor[:, 2, 3]
    assert 2.0 < np.abs(height - 45.0).max() < 3.1
    assert max(depth_mm(record, begin_ns).max() for record in records.values()) <= DEEP


@pytest.mark.parametrize("fidelity", ["fitted", "ideal"])
@pytest.mark.parametrize("scene", BEGINS)
def test_nobody_who_tells_the_truth_is_stopped_or_slowed(scene, fidelity):
    said = []
    run = run_arms_offline(
        scene,
        TASKS.get(scene, "surface_following"),
        OfflineOptions(fidelity=fidelity, seed=3, goals=GOALS.get(scene, ())),
        progress=lambda arm, goal, command: said.append(command.reason) if command.reason else None,
    )
    assert all(record.result["succeeded"] for record in run.values())
    assert not [reason for reason in said if "slower" in reason]


@pytest.mark.skipif(
    not shipped_model().is_file(), reason="the shipped model is not there: `make model` trains it"
)
@pytest.mark.parametrize(
    "lie, known_s, said",
    [
        ("z drifts down", 2.0, "no belief came of"),
        ("z flipped", 0.2, "the brightness of the image"),
        ("tilts flipped", 1.5, "the estimates contradict the arm's motion"),
        ("frozen with noise", 4.0, "no belief came of"),
    ],
)
def test_with_simulated_images_and_the_shipped_model(lie, known_s, said):
    check(*lied_to("plane", lie, fidelity="image"), known_s, said)
