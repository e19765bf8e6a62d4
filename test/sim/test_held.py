"""An object held between a plate and a tip: when it sticks, slips and falls, against closed forms."""

import numpy as np
import pytest
from scipy.optimize import brentq

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_scene.scene_file import load_scene
from tactile_sim.cell import Cell
from tactile_sim.held import HeldObject, HeldSettings, HeldState

G = 9.81
DT = 1 / 60
TIP = np.array([0.0, 0.0, 0.057])


def plate(inclination_deg):
    """A plate whose normal is that far from straight up: 0 carries from below, 90 stands, 180 hangs."""
    return se3.pose_from_euler([0, 0, 0, np.radians(inclination_deg), 0, 0])


def held(mass=0.1, **changes):
    """An object that the hand has let go, wide enough not to tilt unless said otherwise."""
    settings = {"mass": mass, "hand_time": 0.0, "foot": (0.5, 0.5), "plate": (0.5, 0.5), **changes}
    return HeldObject(HeldSettings(**settings))


def uphill(T_world_plate, force):
    """A tip force along the plate, against gravity, in the plate's frame."""
    up = T_world_plate[:3, :3].T @ np.array([0, 0, 1.0])
    up[2] = 0
    return force * up / np.linalg.norm(up)


@pytest.mark.parametrize("mu_plate, mu_tip, press", [(0.5, 0.9, 2.0), (0.8, 0.3, 1.7), (0.1, 1.0, 5.0)])
@pytest.mark.parametrize("excess, state", [(0.999, HeldState.STICKING), (1.001, HeldState.SLIPPING)])
def test_on_a_standing_plate_it_slips_when_the_weight_exceeds_the_friction_of_plate_and_tip(
    mu_plate, mu_tip, press, excess, state
):
    T = plate(90)
    mass = excess * (mu_plate + mu_tip) * press / G
    body = held(mass, friction_plate=mu_plate)
    tip = uphill(T, mu_tip * press) - [0, 0, press]
    # in line with the centre of mass, so that nothing turns
    body.step(T, tip, body.T_plate_object[:3, 3], DT)
    assert body.state is state
    margin = 1 - (mass * G - mu_tip * press) / (mu_plate * press)
    assert body.load.margin == pytest.approx(margin, rel=1e-9)


@pytest.mark.parametrize("inclination", [20.0, 60.0, 110.0])
def test_on_an_inclined_plate_the_load_is_the_weight_along_it_over_friction_times_all_that_presses(
    inclination,
):
    body, theta = held(0.1, friction_plate=0.6), np.radians(inclination)
    body.step(plate(inclination), np.array([0, 0, -3.0]), TIP, DT)
    expected = 0.1 * G * np.sin(theta) / (0.6 * (3.0 + 0.1 * G * np.cos(theta)))
    assert body.load.slip == pytest.approx(expected, rel=1e-12)


def test_lying_on_the_plate_it_stays_without_any_press():
    body = held()
    for _ in range(100):
        body.step(plate(0), np.zeros(3), TIP, DT)
    body.step(plate(0), np.array([0, 0, -1.0]), TIP, DT)
    for _ in range(100):
        body.step(plate(0), np.zeros(3), TIP, DT)
    assert body.state is HeldState.STICKING
    np.testing.assert_allclose(body.T_plate_object[:2, 3], 0)


@pytest.mark.parametrize("share, state", [(1.001, HeldState.STICKING), (0.999, HeldState.FALLEN)])
def test_under_the_plate_it_falls_when_the_press_is_less_than_the_weight(share, state):
    body = held(0.2)
    body.step(plate(180), np.array([0, 0, -share * 0.2 * G]), TIP, DT)
    assert body.state is state


def pressed_by_a_spring(body, T, press, mu_tip, steps):
    """Keep pressing with a tip whose tangential force grows with the object's way, up to its own friction."""
    stiffness = body.settings.shear_stiffness(body.settings.depth(press))
    start = body.T_plate_object[:3, 3]
    for _ in range(steps):
        here = body.T_plate_object[:3, 3]
        shear = stiffness * (start - here)
        shear[2] = 0.0
        shear *= min(1.0, mu_tip * press / max(np.linalg.norm(shear), 1e-12))
        body.step(T, shear - [0, 0, press], here, DT)
    return body


def test_what_the_plate_cannot_carry_sags_until_the_skin_of_the_tip_does():
    press, mass, T = 1.7, 0.237, plate(90)
    body = pressed_by_a_spring(held(mass, friction_plate=0.8, stiffness=1e9), T, press, 0.9, 600)
    stiffness = body.settings.shear_stiffness(body.settings.depth(press))
    sag = (mass * G - 0.8 * press) / stiffness
    assert 0.003 < sag < 0.006
    assert np.linalg.norm(body.T_plate_object[:2, 3]) == pytest.approx(sag, rel=1e-6)
    assert body.load.slip == pytest.approx(1.0, abs=1e-6)


def test_what_plate_and_tip_together_cannot_carry_slides_off_and_falls():
    press = 1.7
    mass = 1.01 * (0.8 + 0.9) * press / G
    size = {"foot": (0.03, 0.03), "plate": (0.04, 0.04)}
    body = held(mass, friction_plate=0.8, center_of_mass=(0, 0, -0.0285), **size)
    pressed_by_a_spring(body, plate(90), press, 0.9, 120)
    assert body.state is HeldState.FALLEN


def test_without_a_tip_it_slides_down_as_a_block_on_an_inclined_plane():
    body, steps, dt = held(friction_plate=0.3), 1000, 1e-4
    body.step(plate(0), np.array([0, 0, -1.0]), TIP, dt)  # the first touch, after which the hand lets go
    for _ in range(steps):
        body.step(plate(45), np.zeros(3), TIP, dt)
    acceleration = G * (np.sin(np.pi / 4) - 0.3 * np.cos(np.pi / 4))
    gone = np.linalg.norm(body.T_plate_object[:2, 3])
    assert gone == pytest.approx(acceleration * (steps * dt) ** 2 / 2, rel=2e-3)
    downhill = -(plate(45)[:3, :3].T @ [0, 0, 1.0])[:2]
    assert body.T_plate_object[:2, 3] @ downhill > 0


@pytest.mark.parametrize("share, state", [(1.01, HeldState.STICKING), (0.99, HeldState.ROCKING)])
def test_it_rocks_when_its_centre_of_mass_is_too_high_for_the_press_and_its_foot(share, state):
    mass, height, foot = 0.237, 0.029, 0.04
    press = share * mass * G * height / foot  # so that the center of pressure is at the foot's edge
    body = held(mass, friction_plate=5.0, standoff=height, foot=(foot, foot), stiffness=1e9)
    body.step(plate(90), np.array([0, 0, -press]), np.array([0, 0, 2 * height]), DT)
    assert body.state is state
    assert body.load.tilt == pytest.approx(1 / share, rel=1e-6)


def pushed_at_its_top(body, shear, steps):
    """A tip, stuck to the top of an object without weight, that has gone `shear` along x."""
    press, height = 4.0, 0.06
    stiffness = body.settings.shear_stiffness(body.settings.depth(press))
    on_top = np.array([0, 0, height - body.settings.standoff, 1.0])
    for _ in range(steps):
        top = (body.T_plate_object @ on_top)[:3]
        force = np.array([stiffness * (shear - top[0]), -stiffness * top[1], -press])
        body.step(np.eye(4), force, top, DT, gravity=(0, 0, 0))
    return stiffness, press, height


def test_it_rocks_until_the_skin_no_longer_tips_it_and_back_when_the_push_ends():
    body = held(friction_plate=5.0, foot=(0.02, 0.03), standoff=0.03, stiffness=1e9)
    stiffness, press, height = pushed_at_its_top(body, 0.008, 60)

    def moment(angle):
        """About the edge at x = 20 mm, of the tip's force on the top of a block that is turned about it."""
        x, z = (
            0.02 - 0.02 * np.cos(angle) + height * np.sin(angle),
            0.02 * np.sin(angle) + height * np.cos(angle),
        )
        return z * stiffness * (0.008 - x) - (0.02 - x) * press

    expected = brentq(moment, 0, 0.2)
    assert np.degrees(expected) > 2.0
    assert body.state is HeldState.ROCKING
    turned = np.arctan2(body.T_plate_object[0, 2], body.T_plate_object[2, 2])
    assert turned == pytest.approx(expected, rel=1e-5)
    pushed_at_its_top(body, 0.0, 60)
    assert body.state is HeldState.STICKING
    np.testing.assert_allclose(body.T_plate_object[:3, :3], np.eye(3), atol=1e-12)


def test_a_moment_that_no_skin_takes_topples_it():
    body = held(friction_plate=5.0, foot=(0.02, 0.03), standoff=0.03)
    for _ in range(100):
        body.step(np.eye(4), np.array([3.0, 0, -4.0]), np.array([0, 0, 0.06]), DT)
    assert body.state is HeldState.FALLEN


def test_a_press_beside_the_centre_of_mass_adds_torsion_to_the_load():
    aside, mass, press = 0.012, 0.1, 3.0
    body = held(mass, friction_plate=0.8, foot=(0.03, 0.03), center_of_mass=(0, 0, -0.0285))
    body.step(plate(90), np.array([0, 0, -press]), np.array([aside, 0, 0.057]), DT)
    assert abs(body.load.torsion) == pytest.approx(aside * mass * G, rel=1e-9)
    assert body.load.slip == pytest.approx(mass * G * np.hypot(1, aside / 0.03) / (0.8 * press), rel=1e-9)


def test_an_object_that_torsion_makes_slip_turns_with_it():
    body = held(0.1, friction_plate=0.2, foot=(0.03, 0.03), center_of_mass=(0.0, 0, -0.0285))
    body.step(plate(90), np.array([0, 0, -2.0]), np.array([0.01, 0, 0.057]), DT)
    assert body.state is HeldState.SLIPPING
    turn = np.arctan2(body.T_plate_object[1, 0], body.T_plate_object[0, 0])
    assert np.sign(turn) == np.sign(body.load.torsion)
    lever = 0.03
    expected = body.load.torsion / lever**2 / np.linalg.norm(body.load.force[:2])
    assert turn / np.linalg.norm(body.T_plate_object[:2, 3]) == pytest.approx(expected, rel=1e-6)


def test_a_concave_plate_holds_as_much_as_its_rim_is_steeper():
    settings = HeldSettings(friction_plate=0.5, rim_deg=30.0)
    assert np.degrees(np.arctan(settings.friction)) == pytest.approx(np.degrees(np.arctan(0.5)) + 30)


@pytest.mark.parametrize("stiffness", [100.0, 400.0, 1.6e4])
def test_a_linear_skin_and_the_object_share_the_depth_by_their_stiffness(stiffness):
    body, k_tip, depth = held(stiffness=stiffness, skin_exponent=1.0), 1.69 / 6e-3, 0.006
    for _ in range(50):
        given = body.settings.standoff - body.T_plate_object[2, 3]
        body.step(plate(0), np.array([0, 0, -k_tip * (depth - given)]), TIP, DT)
    given = body.settings.standoff - body.T_plate_object[2, 3]
    assert given == pytest.approx(depth * k_tip / (k_tip + stiffness), rel=1e-9)


@pytest.mark.parametrize("stiffness", [50.0, 400.0, 1.6e4])
@pytest.mark.parametrize("skin", [0.5, 1.0, 2.0])
def test_the_yield_finds_the_balance_with_a_skin_that_is_not_the_curve_of_its_settings(stiffness, skin):
    body, depth = held(stiffness=stiffness), 0.009
    s = body.settings
    for _ in range(200):
        given = s.standoff - body.T_plate_object[2, 3]
        body.step(plate(0), np.array([0, 0, -skin * s.normal_force(depth - given)]), TIP, DT)
    balance = brentq(lambda y: skin * s.normal_force(depth - y) - stiffness * y, 0, depth, xtol=1e-15)
    assert s.standoff - body.T_plate_object[2, 3] == pytest.approx(balance, rel=1e-6)


def test_the_hand_holds_it_until_a_while_after_the_first_touch():
    body = held(0.1, hand_time=1.0)
    for _ in range(600):
        body.step(plate(90), np.zeros(3), TIP, DT)
    assert body.state is HeldState.BY_HAND
    little = np.array([0, 0, -0.2])
    for _ in range(60):
        body.step(plate(90), little, TIP, DT)
    assert body.state is HeldState.BY_HAND
    for _ in range(60):
        body.step(plate(90), little, TIP, DT)
    assert body.state is not HeldState.BY_HAND
    assert body.load.margin < 0


def test_once_the_tip_is_gone_it_falls_and_stays_so():
    body, T = held(0.1), plate(90)
    press = np.array([0, 0, -3.0])
    for _ in range(3):
        body.step(T, press, TIP, DT)
    assert body.state is HeldState.STICKING
    body.step(T, np.zeros(3), TIP, DT)
    assert body.state is HeldState.FALLEN
    where = body.T_plate_object
    for _ in range(10):
        body.step(T, press, TIP, DT)
    assert body.state is HeldState.FALLEN
    np.testing.assert_array_equal(body.T_plate_object, where)


def test_a_friction_cone_that_opens_too_far_is_refused():
    with pytest.raises(SettingError, match=r"the cone opens to 88\.7 degrees, must be at most 85"):
        HeldSettings(friction_plate=0.8, rim_deg=50.0)


GAINS = np.diag([10.0, 10.0, 10.0, 4.0, 4.0, 0.0])  # twice those of the paper's follower


def followed(scene, depth, seconds, lead):
    """Cell and truths of a follower that presses `depth` deep, by the true contact pose."""
    cell, truths = Cell(scene), []
    reference = se3.pose_from_euler([0, 0, depth, 0, 0, 0])
    for _ in range(round(seconds * 120)):
        cell.step()
        cell.command("leader", cell.stamp_ns, lead(cell.stamp_ns * 1e-9))
        if cell.exposure_due("follower"):
            truth = cell.expose("follower").truth
            truths.append(truth)
            twist = np.array([0, 0, 0.01, 0, 0, 0])
            if truth.in_contact:
                twist = GAINS @ se3.log(se3.inverse(truth.T_fs) @ reference)
            cell.command("follower", cell.stamp_ns, twist)
    return cell, truths


def still(time):
    return np.zeros(6)


def swinging(time):
    """The paper's periodic velocity, once the hand has let go."""
    amplitude = np.array([0.075, 0.075, 0.075, *np.radians([25.0] * 3)])
    phase = np.array([np.pi / 2, 0, 0, 0, 0, 0])
    rate = 2 * np.pi / 30
    return rate * amplitude * np.cos(rate * (time - 4) + phase) * (time > 4)


@pytest.mark.parametrize("name", ["flat", "cube", "mustard", "ball"])
def test_a_follower_at_the_papers_depth_keeps_contact_over_a_period_of_the_papers_motion(name):
    truths = followed(load_scene(f"tracking_{name}").with_fidelity("ideal"), 0.006, 34, swinging)[1]
    touched = [truth.in_contact for truth in truths]
    assert all(touched[touched.index(True) :])
    assert min(truth.depth for truth in truths[240:]) > 0.004


@pytest.mark.parametrize("name", ["cube", "mustard"])
def test_a_follower_that_presses_too_little_loses_the_object_when_the_hand_lets_go(name):
    cell, truths = followed(load_scene(f"tracking_{name}").with_fidelity("ideal"), 0.0005, 6, still)
    touched = [truth.in_contact for truth in truths]
    start = touched.index(True)
    assert all(touched[start : start + 110])  # while the hand holds it, for two seconds
    assert not any(touched[-60:])
    assert cell.T_world_body(name)[2, 3] < 0.4 - 1.0  # on the floor


def test_a_soft_ball_gives_way_as_its_stiffness_says():
    scene = load_scene("tracking_ball").with_fidelity("ideal")
    cell, truths = followed(scene, 0.006, 8, still)
    settings = HeldSettings(**scene.bodies["ball"].motion_settings.values)
    given = cell.scene.T_world_body("ball")[0, 3] - cell.T_world_body("ball")[0, 3]
    assert truths[-1].depth == pytest.approx(0.006, abs=1e-4)
    assert given == pytest.approx(settings.normal_force(truths[-1].depth) / settings.stiffness, rel=1e-3)


def test_with_the_forces_of_the_simulated_skin_the_cube_is_held_as_by_the_curves():
    scene = load_scene("tracking_cube")
    truths = followed(scene, 0.006, 4, still)[1]
    settings = HeldSettings(**scene.bodies["cube"].motion_settings.values)
    assert truths[-1].in_contact
    assert truths[-1].normal_force == pytest.approx(settings.normal_force(truths[-1].depth), rel=0.1)


def test_a_simulated_tip_that_loses_an_object_on_its_way_goes_on_without_contact():
    def sideways(time):
        return np.array([0.08, 0, 0, 0, 0, 0]) * (time > 2)  # faster than the follower's gains hold it

    truths = followed(load_scene("tracking_cube"), 0.004, 5, sideways)[1]
    touched = [truth.in_contact for truth in truths]
    assert touched[120]
    assert not any(touched[-30:])


def test_a_held_body_needs_an_arm_with_the_plate(tmp_path):
    text = (load_scene("tracking_cube").path).read_text()
    path = tmp_path / "scene.yaml"
    path.write_text(text.replace("    carried_by: leader\n", ""))
    with pytest.raises(SettingError, match="body 'cube': motion 'held' needs carried_by"):
        Cell(load_scene(path))
