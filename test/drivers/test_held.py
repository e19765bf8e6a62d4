"""An object held between a plate and a tip: when it sticks, slips and falls, against closed forms."""

import numpy as np
import pytest
from scipy.optimize import brentq

from tactile_base.settings import SettingError
from tactile_drivers.sim.held import HeldObject, HeldSettings, HeldState
from tactile_filter import se3

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


@pytest.mark.parametrize("share, state", [(1.01, HeldState.STICKING), (0.99, HeldState.FALLEN)])
def test_it_topples_when_its_centre_of_mass_is_too_high_for_the_press_and_its_foot(share, state):
    mass, height, foot = 0.237, 0.029, 0.04
    press = share * mass * G * height / foot  # so that the center of pressure is at the foot's edge
    body = held(mass, friction_plate=5.0, standoff=height, foot=(foot, foot), stiffness=1e9)
    body.step(plate(90), np.array([0, 0, -press]), TIP, DT)
    assert body.state is state
    assert body.load.tilt == pytest.approx(1 / share, rel=1e-6)


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
