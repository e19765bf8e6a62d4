"""Contacts at a reference force: on skins of several laws, and a force that lies, stops or is none."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kinematic_plant import MS, Plane, Plant, Sphere, freeze_after, pointing_down, rest_after, run

from tactile_base.settings import SettingError
from tactile_control.force_reference import ForceControlSettings, ForceReference, StampedForce, normal_force
from tactile_control.phases import FAILED
from tactile_control.task_file import load_controller
from tactile_control.tasks.surface_following import (
    FOLLOW,
    FollowingGoal,
    SurfaceFollowing,
    SurfaceFollowingSettings,
)
from tactile_geometry import se3

STEP_NS = 16_666_667
#: A skin's force (N) by depth (m): the built-in tip has some 0.5 N at 3 mm and grows as z^1.7 (simulated).
SOFT = (0.5, 1.7)


def pressed(depth: float, law) -> float:
    at_3_mm, power = law
    return at_3_mm * (max(depth, 0.0) / 0.003) ** power


@given(
    st.floats(0.1, 50.0), st.floats(1.0, 2.0), st.floats(0.0012, 0.0055), st.floats(0.0012, 0.0055),
    st.floats(0.2, 3.0),
)  # fmt: skip
def test_on_a_skin_of_any_stiffness_the_depth_is_found_whose_force_is_the_reference(
    at_3_mm, power, start, wanted, rate
):
    """An arm that is where the reference was a step ago; nothing is known of the skin."""
    normal = pressed(wanted, (at_3_mm, power))
    press = ForceReference(ForceControlSettings(normal=normal, rate=rate))
    depth, way = start, []
    for k in range(round(12.0 / rate * 60)):
        depth = press.step(k * STEP_NS, start, depth, pressed(depth, (at_3_mm, power)))
        way.append(depth)
    assert depth == pytest.approx(wanted, rel=0.01)
    beyond = max(way) - max(start, wanted) if wanted > start else min(start, wanted) - min(way)
    assert beyond < 0.05 * abs(wanted - start) + 1e-6


def test_without_a_contact_it_goes_to_its_largest_depth_at_its_rate_and_no_further():
    settings = ForceControlSettings(normal=5.0, rate=1.0, most_depth=0.005)
    press = ForceReference(settings)
    depths = [press.step(k * STEP_NS, 0.003, 0.003, 0.0) for k in range(200)]
    assert np.diff(depths).max() <= 0.003 * 1.0 * STEP_NS * 1e-9 * 1.01  # the factor is held to 2
    assert depths[-1] == 0.005
    assert press.step(200 * STEP_NS + 10**12, 0.003, 0.003, 1e6) > 0.0045  # a gap counts 0.1 s at most


def test_it_holds_while_the_arm_does_not_follow_and_begins_anew():
    press = ForceReference(ForceControlSettings(normal=5.0))
    press.step(0, 0.003, 0.003, 1.0)
    held = [press.step(k * STEP_NS, 0.003, 0.003, 1.0, hold=True) for k in range(1, 50)]
    assert set(held) == {0.003}
    press.reset()
    assert press.step(10**10, 0.002, 0.003, 5.0) == 0.002


def test_the_normal_force_is_along_the_normal_whatever_sign_its_labels_had():
    X_sf = se3.pose_from_euler([0.0, 0.0, -0.003, 0.3, -0.2, 0.5])
    normal = X_sf[:3, 2]
    beside = np.cross(normal, [1.0, 0.0, 0.0])
    for sign in (1.0, -1.0):
        assert normal_force(sign * 4.0 * normal + 3.0 * beside, X_sf) == pytest.approx(4.0)


@pytest.mark.parametrize(
    "changes", [{"most_depth": 0.0005}, {"normal": 5.0, "most": 4.0}, {"normal": -1.0}, {"rate": 0.0}]
)
def test_settings_that_contradict_each_other_are_refused(changes):
    with pytest.raises(SettingError):
        ForceControlSettings().replaced(**changes)


# ---- tasks ----


@pytest.fixture
def settings(request):
    path = request.config.rootpath / "config/controllers/surface_following.yaml"
    return load_controller(path, SurfaceFollowingSettings())


def of_force(settings, **force):
    return dataclasses.replace(settings, force=ForceControlSettings(**force))


def feeling(law=SOFT, lie=lambda stamp_ns, force: force):
    """Adds the force of a skin of this law at each belief, with 2 % of noise; `lie` changes it."""
    random = np.random.default_rng(0)

    def change(k, inputs):
        if inputs.belief is None:
            return inputs
        X_sf = inputs.belief.T
        size = pressed(se3.inverse(X_sf)[2, 3], law) * (1.0 + 0.02 * random.standard_normal())
        force = lie(inputs.belief.stamp_ns, -size * X_sf[:3, 2])
        return dataclasses.replace(inputs, force=StampedForce(inputs.belief.stamp_ns, force))

    return change


def follow(settings, surface, change, length=0.06):
    top = surface.top() + np.array([0.0, 0.0, 0.024])
    return run(
        SurfaceFollowing(settings, FollowingGoal(length=length)),
        Plant(surface, pointing_down(top)),
        change=change,
    )


@pytest.mark.parametrize("surface", [Plane(), Sphere(0.15)], ids=["plane", "sphere"])
@pytest.mark.parametrize("law, normal", [(SOFT, 0.8), ((5.0, 1.0), 3.0), ((20.0, 1.5), 30.0)])
def test_a_surface_is_followed_at_a_force(settings, surface, law, normal):
    commands = follow(of_force(settings, normal=normal), surface, feeling(law))
    assert commands[-1][1].succeeded, commands[-1][1].reason
    at_work = [(now, pressed(depth, law)) for now, c, depth, _ in commands if c.phase == FOLLOW]
    settled = np.array([force for now, force in at_work if now > at_work[0][0] + 2500 * MS])
    assert len(settled) > 100
    assert np.sqrt(np.mean((settled / normal - 1.0) ** 2)) < 0.05


def test_without_a_reference_force_nothing_changes_whatever_is_felt(settings):
    plain = follow(settings, Plane(), lambda k, inputs: inputs)
    felt = follow(settings, Plane(), feeling())
    assert all(
        np.array_equal(a.twist, b.twist) for (_, a, _, _), (_, b, _, _) in zip(plain, felt, strict=True)
    )


def test_a_contact_that_presses_too_hard_is_left_and_says_so(settings):
    stiff = follow(of_force(settings, most=10.0), Plane(), feeling((30.0, 1.5)))
    last = stiff[-1][1]
    assert not last.succeeded and "the contact presses with" in last.reason and "over 10 N" in last.reason
    assert stiff[-1][2] < 0.0  # it has left the surface


@pytest.mark.parametrize("wish", [{"normal": 0.8}, {"most": 5.0}], ids=["normal", "most"])
def test_a_force_that_stops_brings_the_arm_to_rest_as_any_input_does(settings, wish):
    at_ns = 10**9 + 8000 * MS
    feel, freeze = feeling(), freeze_after(("force",), at_ns)
    commands = follow(of_force(settings, **wish), Plane(), lambda k, i: freeze(k, feel(k, i)), length=0.1)
    last = commands[-1][1]
    assert last.phase == FAILED and "force is" in last.reason and "limit 100 ms" in last.reason
    assert max(np.abs(c.twist).max() for now, c, _, _ in commands if now < at_ns) > 0.005
    assert rest_after(commands, at_ns) <= 200.0


def test_a_network_that_tells_no_force_lets_no_task_at_a_force_begin_its_work(settings):
    commands = follow(of_force(settings, normal=0.8), Plane(), lambda k, inputs: inputs)
    last = commands[-1][1]
    assert last.phase == FAILED and "no force has arrived within 10 s" in last.reason
    assert FOLLOW not in {c.phase for _, c, _, _ in commands}


def test_a_force_that_is_not_finite_counts_as_not_come(settings):
    def nan(stamp_ns, force):
        return force if stamp_ns < 10**9 + 8000 * MS else np.full(3, np.nan)

    last = follow(of_force(settings, normal=0.8), Plane(), feeling(lie=nan), length=0.1)[-1][1]
    assert last.phase == FAILED and "force is" in last.reason


@pytest.mark.parametrize("factor", [0.0, 0.2, 5.0])
def test_a_force_that_lies_moves_the_depth_within_its_bounds_alone(settings, factor):
    """Told too little it presses to the largest depth, where what limits depths holds; else to the least."""
    wanted = of_force(settings, normal=0.8, most_depth=0.005)
    lying = feeling(lie=lambda stamp_ns, force: factor * force)
    commands = follow(wanted, Plane(), lying, length=0.08)
    depths = [depth for _, c, depth, _ in commands if c.phase == FOLLOW]
    assert min(depths) > 0.0006 and max(depths) < 0.0055
    assert depths[-1] == pytest.approx(0.005 if factor < 1.0 else 0.0014, abs=0.0008)


def test_the_reference_is_changed_while_it_works(settings):
    forces = iter([0.5] * 700 + [1.2] * 5000)
    task = SurfaceFollowing(of_force(settings, normal=0.5), FollowingGoal(length=0.12))
    felt = feeling()

    def change(k, inputs):
        task.configure(of_force(settings, normal=next(forces)))
        return felt(k, inputs)

    plant = Plant(Plane(), pointing_down([0.0, 0.0, 0.024]))
    commands = run(task, plant, change=change)
    depths = np.array([depth for _, c, depth, _ in commands if c.phase == FOLLOW])
    assert pressed(depths[-1], SOFT) == pytest.approx(1.2, rel=0.05)
    assert np.abs(np.diff(depths)).max() < 0.0003
