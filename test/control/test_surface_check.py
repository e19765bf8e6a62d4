"""Beliefs against the arm's own motion: what a surface can do is believed, what it cannot is refuted."""

import numpy as np
import pytest
from kinematic_plant import Plane, Plant, Sphere, contact_pose, pointing_down, run

from tactile_control.contact_phases import Servo
from tactile_control.phases import StampedPose, TaskInputs
from tactile_control.surface_check import SurfaceCheck, SurfaceSettings
from tactile_control.tasks.pushing import PushingSettings
from tactile_control.tasks.surface_following import (
    FOLLOW,
    FollowingGoal,
    SurfaceFollowing,
    SurfaceFollowingSettings,
)
from tactile_geometry import se3

FRAME = 1 / 60
MS = 1_000_000


def euler_pose(x=0.0, y=0.0, z=0.003, alpha=0.0, beta=0.0, gamma=0.0):
    """X_sf of an Euler contact pose."""
    return se3.inverse(se3.pose_from_euler([x, y, z, alpha, beta, gamma]))


def at(x=0.0, y=0.0, down=0.0):
    """The sensor above z = 0, so much further down."""
    return pointing_down((x, y, 0.017 - down))


def fed(check, seconds, contact, sensor, begins=0.0, rate=60.0):
    """Give beliefs for so long, by functions of the time (s) since; the time of a contradiction, or None."""
    for k in range(round(seconds * rate)):
        t = k / rate
        check.add(10**9 + round((begins + t) * 1e9), contact(t), sensor(t))
        if check.contradiction:
            return t
    return None


@pytest.fixture
def check():
    return SurfaceCheck(SurfaceSettings())


# ---- what a surface can do ----


@pytest.mark.parametrize("surface", [Plane(), Sphere(0.075), Sphere(0.05)])
@pytest.mark.parametrize("seed", range(3))
def test_whatever_an_arm_does_on_a_still_surface_fits(check, surface, seed):
    """Wandering, tilting, and going in and out, with the noise that estimates have."""
    check.configure(SurfaceSettings(depth_margin=0.01))
    rng = np.random.default_rng(seed)
    T = pointing_down(np.add(surface.top(), [0.0, 0.0, 0.017]))
    speeds = np.array([0.015, 0.015, 0.003, 0.1, 0.1, 0.1])
    phases, rates = rng.uniform(0, 6.28, 6), rng.uniform(1.0, 4.0, 6)
    for k in range(600):
        T = T @ se3.exp(FRAME * speeds * np.sin(rates * k * FRAME + phases))
        noise = [1e-4, 1e-4, 1e-4, 4e-3, 4e-3, 4e-3] * rng.standard_normal(6)
        check.add(10**9 + round(k * FRAME * 1e9), se3.exp(noise) @ se3.inverse(contact_pose(surface, T)), T)
    assert check.contradiction == "" and check.doubt < 0.7 and check.pace() == 1.0


def test_a_contact_that_slides_along_with_its_shear_fits(check):
    sheared = [min(0.010 * t, 0.004) for t in np.arange(600) * FRAME]
    along = lambda t: euler_pose(x=sheared[round(t * 60)])  # noqa: E731
    assert fed(check, 5.0, along, lambda t: at(x=-0.010 * t)) is None  # its x is the base's -x
    assert check.doubt < 0.7


def test_a_surface_that_moves_is_believed_from_the_works_beginning_on_as_fast_as_it_may():
    settings = SurfaceSettings(speed=0.02)
    still = lambda t: euler_pose()  # noqa: E731
    follows = lambda t: at(down=0.015 * t)  # noqa: E731
    check = SurfaceCheck(settings)
    assert fed(check, 2.0, still, follows) is not None, "it stands still until the work begins"
    check.begin()
    check.work()
    assert fed(check, 2.0, still, follows) is None
    check.begin()
    check.work()
    assert fed(check, 2.0, still, lambda t: at(down=0.05 * t)) is not None
    check = SurfaceCheck(settings.replaced(rests_at_first=False))
    assert fed(check, 2.0, still, follows) is None


def test_what_gives_way_does_so_under_the_tip_and_comes_back_with_it_and_only_so_far():
    settings = SurfaceSettings(yields=0.003)
    still = lambda t: euler_pose()  # noqa: E731
    assert fed(SurfaceCheck(settings), 1.0, still, lambda t: at(down=0.0025 * t)) is None
    assert fed(SurfaceCheck(settings), 1.0, still, lambda t: at(down=0.0060 * t)) is not None
    assert fed(SurfaceCheck(settings), 1.0, still, lambda t: at(down=-0.0025 * t)) is None
    assert fed(SurfaceCheck(settings), 1.0, still, lambda t: at(down=-0.0060 * t)) is not None
    deeper, less = lambda t: euler_pose(z=0.003 + 0.002 * t), lambda t: euler_pose(z=0.003 - 0.002 * t)
    assert fed(SurfaceCheck(settings), 1.0, deeper, lambda t: at()) is not None, "of itself it goes nowhere"
    assert fed(SurfaceCheck(settings), 1.0, less, lambda t: at()) is not None


# ---- what it cannot ----


@pytest.mark.parametrize("sign, depth, arm", [(1, "deeper", "out of"), (-1, "less deep", "into")])
def test_a_depth_that_drifts_is_contradicted_by_the_arm_that_follows_it(check, sign, depth, arm):
    """The arm keeps the depth that it is told by going out as fast as that drifts in."""
    when = fed(check, 3.0, lambda t: euler_pose(), lambda t: at(down=-sign * 1e-3 * t))
    assert 1.0 <= when <= 1.2
    assert f"while the arm went 1.1 mm {arm} it: the estimates contradict" in check.contradiction
    assert check.pace() == 0.0
    check.begin()
    when = fed(check, 3.0, lambda t: euler_pose(z=0.003 + sign * 1e-3 * t), lambda t: at())
    assert 1.0 <= when <= 1.2
    assert f"mm {depth} while the arm went 0.0 mm into it" in check.contradiction


def test_the_arm_goes_slower_before_it_has_to_stop(check):
    fed(check, 0.95, lambda t: euler_pose(), lambda t: at(down=1e-3 * t))
    assert check.contradiction == "" and 0.7 < check.doubt < 1.0 and 0.25 < check.pace() < 1.0
    check.configure(SurfaceSettings(slow_from=1.0))
    assert check.pace() == 1.0


def test_a_normal_that_turns_by_more_than_a_surface_can_is_a_contradiction(check):
    tilted = lambda t: euler_pose(alpha=0.1 * t)  # noqa: E731
    when = fed(check, 3.0, tilted, lambda t: at())
    assert 0.7 <= when <= 1.0 and "the surface's normal turned by" in check.contradiction
    check.begin()
    assert fed(check, 1.5, tilted, lambda t: at(y=0.010 * t)) is None, (
        "on its way over a curved surface it may"
    )


def test_a_contact_that_slides_against_its_shear_is_a_contradiction(check):
    backwards = lambda t: euler_pose(x=-0.002)  # noqa: E731
    when = fed(check, 2.0, backwards, lambda t: at(x=-0.010 * t))
    assert 0.3 <= when <= 0.5 and "mm against its own shear" in check.contradiction


def test_a_contact_that_turns_against_its_twist_is_a_contradiction(check):
    turning = lambda t: at() @ se3.exp([0, 0, 0, 0, 0, 0.5 * t])  # noqa: E731
    assert fed(check, 2.0, lambda t: euler_pose(gamma=0.1), turning) is None
    check.begin()
    when = fed(check, 2.0, lambda t: euler_pose(gamma=-0.1), turning)
    assert 0.6 <= when <= 0.9 and "degrees against its own twist" in check.contradiction


def test_a_belief_that_jumps_is_a_contradiction_at_once(check):
    when = fed(check, 2.0, lambda t: euler_pose(z=0.003 if t < 1.0 else -0.003), lambda t: at())
    assert when == pytest.approx(1.0, abs=1e-9)
    assert "the contact went 6.0 mm less deep by itself" in check.contradiction


def test_a_contact_deeper_than_expected_ends_it_though_the_arm_went_there():
    check = SurfaceCheck(SurfaceSettings(depth_margin=0.003), reference=0.003)
    when = fed(check, 2.0, lambda t: euler_pose(z=0.003 + 0.005 * t), lambda t: at(down=0.005 * t))
    assert 0.6 <= when <= 0.8 and check.contradiction.endswith("mm deep, which is over 6 mm")


def test_the_limit_of_depth_goes_with_the_reference_and_leaves_time_to_come_up_to_a_new_one():
    depth = {3: 0.003, 6: 0.006}
    settings = SurfaceSettings(depth_margin=0.001)
    sinking = lambda t: 0.006 - 0.003 * min(t, 1.0)  # noqa: E731
    for reference, fits in ((6, True), (3, False)):
        check = SurfaceCheck(settings, reference=depth[reference])
        assert (fed(check, 1.0, lambda t: euler_pose(z=0.006), lambda t: at(down=0.006)) is None) == fits
    check = SurfaceCheck(settings, reference=depth[6])
    assert fed(check, 1.0, lambda t: euler_pose(z=0.006), lambda t: at(down=0.006)) is None
    check.configure(settings, reference=depth[3])
    up = lambda t: at(down=sinking(t))  # noqa: E731
    assert fed(check, 2.0, lambda t: euler_pose(z=sinking(t)), up, begins=1.0) is None
    back = lambda t: 0.003 + 0.003 * min(t, 1.0)  # noqa: E731
    when = fed(check, 2.0, lambda t: euler_pose(z=back(t)), lambda t: at(down=back(t)), begins=3.0)
    assert when is not None and check.contradiction.endswith("which is over 4 mm")


def test_images_that_show_contact_and_give_no_belief_end_it_after_seven(check):
    given = [False] * 5 + [True] * 60 + [False] * 7
    for number, believed in enumerate(given):
        assert check.contradiction == "", f"image {number}"
        check.see(believed)
    assert check.contradiction == "no belief came of 52% of the latest images that show contact"


def test_a_new_contact_and_another_memory_do_not_stand_in_the_way(check):
    assert fed(check, 3.0, lambda t: euler_pose(), lambda t: at(down=1e-3 * t)) is not None
    check.begin()
    assert check.contradiction == "" and check.pace() == 1.0
    assert fed(check, 3.0, lambda t: euler_pose(), lambda t: at()) is None
    check.configure(SurfaceSettings(memory=1.0))
    assert fed(check, 3.0, lambda t: euler_pose(), lambda t: at(down=0.5e-3 * t), begins=3.0) is None, (
        "forgotten"
    )


def seen(check, sensor, still, seconds=2.0):
    """How far the sensor had come when images that stand still were refuted, m; None if they were not."""
    for k in range(round(60 * seconds)):
        T = sensor(k / 60)
        check.add(10**9 + round(k / 60 * 1e9), euler_pose(), T)
        check.see(True, still(k / 60))
        if check.contradiction:
            return float(np.linalg.norm(T[:3, 3] - sensor(0.0)[:3, 3]))
    return None


def test_an_arm_that_moves_over_images_that_stand_still_is_told_after_3_mm_whatever_is_believed(check):
    """On the plane: what is believed fits the motion to the micrometre."""
    assert 0.003 < seen(check, lambda t: at(x=0.010 * t), lambda t: True) < 0.0034
    assert check.contradiction.startswith("the arm went 3.") and "nothing but noise" in check.contradiction


@pytest.mark.parametrize(
    ("sensor", "still"),
    [
        (lambda t: at(x=0.010 * t), lambda t: False),
        (lambda t: at(x=0.002 * np.sin(8.0 * t)), lambda t: True),  # to and fro, which sums up to more
        (lambda t: at(x=0.010 * t), lambda t: t % 0.3 < 0.2),  # they move again before that
        (lambda t: at(), lambda t: True),
    ],
)
def test_an_arm_that_stays_where_it_is_or_images_that_move_again_are_no_contradiction(check, sensor, still):
    assert seen(check, sensor, still) is None


def test_with_an_object_that_is_carried_along_images_may_stand_still_for_a_while():
    check = SurfaceCheck(PushingSettings().surface)
    check.work()
    assert seen(check, lambda t: at(x=0.010 * t), lambda t: t < 5.0, seconds=8.0) is None
    check.begin()
    assert 0.06 < seen(check, lambda t: at(x=0.010 * t), lambda t: True, seconds=8.0) < 0.061


def test_it_can_be_left_out():
    check = SurfaceCheck(SurfaceSettings(checked=False))
    for _ in range(60):
        check.see(False, still=True)
    assert fed(check, 3.0, lambda t: euler_pose(), lambda t: at(down=5e-3 * t)) is None


# ---- in a task ----


def test_a_task_that_is_lied_to_stops_leaves_the_surface_and_says_what_contradicts_what():
    plant, begins = Plant(Plane(), pointing_down((0.0, 0.0, 0.022))), 6 * 10**9

    def drifting(k, inputs):
        if inputs.belief is None or inputs.belief.stamp_ns < begins:
            return inputs
        euler = se3.euler_from_pose(se3.inverse(inputs.belief.T))
        euler[2] -= 1e-3 * (inputs.belief.stamp_ns - begins) * 1e-9
        lied = StampedPose(inputs.belief.stamp_ns, euler_pose(*euler))
        return TaskInputs(lied, inputs.presence, inputs.sensor_pose)

    commands = run(
        SurfaceFollowing(SurfaceFollowingSettings(), FollowingGoal(length=0.2)), plant, change=drifting
    )
    last = commands[-1][1]
    assert last.phase == "failed" and last.reason.endswith("the estimates contradict the arm's motion")
    slower = [c.reason for _, c, _, _ in commands if "slower" in c.reason]
    assert slower and slower[0].startswith("slower: what is believed of the contact nears a limit (7")
    stopped = next(now for now, c, _, _ in commands if c.phase == "stopping")
    rest = next(now for now, c, _, _ in commands if now >= stopped and np.abs(c.twist).max() < 1e-6)
    assert rest - stopped <= 100 * MS
    assert max(depth for _, _, depth, _ in commands) < 0.0045
    assert commands[-1][2] < -0.005, "off the surface"


def test_images_that_give_no_belief_any_more_bring_the_arm_to_rest_and_off_the_surface():
    plant, silent_ns = Plant(Plane(), pointing_down((0.0, 0.0, 0.022)), delay_steps=0), 5 * 10**9

    def silent(k, inputs):
        if plant.now_ns < silent_ns:
            return inputs
        return TaskInputs(None, inputs.presence, inputs.sensor_pose)

    commands = run(
        SurfaceFollowing(SurfaceFollowingSettings(), FollowingGoal(length=0.2)), plant, change=silent
    )
    assert commands[-1][1].phase == "failed" and "no belief came of 52%" in commands[-1][1].reason
    rest = next(now for now, c, _, _ in commands if now >= silent_ns and np.abs(c.twist).max() < 1e-6)
    assert rest - silent_ns <= 200 * MS
    assert commands[-1][2] < -0.005


def test_in_doubt_an_arm_goes_slower_but_for_the_way_out():
    """Its phase is asked for its twist alone."""
    task = SurfaceFollowing(SurfaceFollowingSettings(), FollowingGoal(length=0.1))
    task.check.doubt = 1.0
    for z, slowed in ((0.02, 0.005), (-0.02, -0.02)):
        twist, said = Servo(task, FOLLOW).adjust(np.array([0.0, 0.01, z, 0.1, 0.0, 0.0]), "")
        np.testing.assert_allclose(twist, [0.0, 0.0025, slowed, 0.025, 0.0, 0.0])
        assert said.startswith("slower: ")
