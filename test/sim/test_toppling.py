"""An object that tilts about an edge and topples: its moments, and who keeps it standing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_scene.scene_file import load_scene
from tactile_sim.cell import Cell
from tactile_sim.pushed import PushedSettings, PushedState
from tactile_sim.pushing_scene import pushing_scene
from tactile_sim.toppling import Tipping, Touch

EDGE = (np.array([0.04, 0.04]), np.array([-0.04, 0.04]))  # the front one of a square foot
HEIGHT = 0.045  # m, of the tips


def tip(force, y, stiffness=700.0):
    """A tip on the rear (y < 0) or the front of a box, with its force on it."""
    return Touch(np.array(force), np.array([0.0, y, HEIGHT]), np.array([0.0, np.sign(y), 0.0]), stiffness,
                 stiffness, False)  # fmt: skip


def tilted(touches, weight, height=0.08, steps=1):
    """The angle about the front edge of a box with its centre of gravity in its middle."""
    tipping = Tipping()
    for _ in range(steps):
        T = tipping.step(EDGE, lambda p: p, touches, np.array([0.0, 0.0, height]), weight)
    return tipping, T


@settings(deadline=None)
@given(
    weight=st.floats(1.0, 10.0),
    caught=st.floats(0.1, 2.0),
    press=st.floats(0.0, 1.0),
    lift=st.floats(0.0, 1.0),
)
def test_it_tilts_exactly_when_the_push_at_the_caught_edge_exceeds_weight_press_and_lift(
    weight, caught, press, lift
):
    """Mu h (W + P - L) against l W + d P, with l = 40 mm and d = 80 mm."""
    friction = caught * (weight + press - lift)
    excess = friction * HEIGHT - 0.04 * weight - 0.08 * press
    if abs(excess) < 1e-9:
        return
    # the follower presses back with 2.6 N, which the leader has to push on top
    touches = [tip([0, friction + 2.6, -press], -0.04), tip([0, -2.6, lift], 0.04)]
    tipping, _ = tilted(touches, weight)
    assert (tipping.angle > 0) == (excess > 0)
    assert (tipping.edge is None) == (excess <= 0)


def test_it_turns_about_the_edge_by_what_lets_the_skins_take_the_moment():
    tipping, T = tilted([tip([0, 6.0, 0], -0.04)], 5.0)
    # the point of the tip rises by the turn times 80 mm and goes ahead by it times 45 mm
    stiffness = 700.0 * (0.08**2 + HEIGHT**2) - 5.0 * 0.08
    assert tipping.angle == pytest.approx((6.0 * HEIGHT - 5.0 * 0.04) / stiffness, rel=1e-9)
    np.testing.assert_allclose(T @ [0, 0.04, 0, 1], [0, 0.04, 0, 1], atol=1e-15)
    rear = T @ [0, -0.04, 0, 1]
    assert rear[2] == pytest.approx(0.08 * np.sin(tipping.angle), rel=1e-9)


def test_it_comes_back_when_the_push_ends():
    tipping, _ = tilted([tip([0, 6.0, 0], -0.04)], 5.0)
    for _ in range(20):
        T = tipping.step(EDGE, lambda p: p, [tip([0, 0.5, 0], -0.04)], np.array([0.0, 0.0, 0.08]), 5.0)
    assert tipping.angle == 0.0
    np.testing.assert_array_equal(T, np.eye(4))


def test_it_is_over_when_its_centre_of_gravity_is_above_the_edge():
    tipping = Tipping()
    tipping.step(EDGE, lambda p: p, [], np.array([0.0, 0.0401, 0.09]), 5.0)
    assert tipping.over
    assert tipping.angle == pytest.approx(np.pi / 2)


def single(edge_friction, name="tall_red_square"):
    """A single arm that pushes a tall object straight ahead."""
    base = load_scene("pushing").with_fidelity("ideal")
    body = base.bodies["pushed"]
    body.motion_settings.values["edge_friction"] = edge_friction
    return Cell(pushing_scene(base, name, "mdf"))


def push(cell, seconds, until=lambda cell: False):
    """The arm goes along its axis at 10 mm/s and gives way to vertical shear; the last frame."""
    end_ns, frame = cell.stamp_ns + round(seconds * 1e9), None
    while cell.stamp_ns < end_ns and not until(cell):
        shear = frame.truth.shear[0] if frame and frame.truth.in_contact else 0.0
        cell.command("arm", cell.stamp_ns, [-2.0 * shear, 0, 0.01, 0, 0, 0])
        cell.step()
        frame = cell.expose("arm") if cell.exposure_due("arm") else frame
    return frame


def down(cell):
    return cell.motion("pushed").state is PushedState.TOPPLED


def test_pushed_by_one_tip_a_tall_object_whose_edge_catches_topples_and_the_tip_loses_it():
    cell = single(1.2)
    push(cell, 12.0, until=down)
    assert down(cell)
    T = cell.T_world_body("pushed")
    assert T[2, 2] == pytest.approx(0.0, abs=1e-9)  # on its side, ahead
    assert T[1, 2] > 0.99
    assert not push(cell, 0.2).truth.in_contact
    np.testing.assert_array_equal(cell.T_world_body("pushed"), T)


def test_one_whose_edge_does_not_catch_stays_upright():
    cell = single(0.0)
    push(cell, 6.0)
    assert cell.motion("pushed").state is PushedState.SLIDING
    assert cell.T_world_body("pushed")[2, 2] == 1.0


def test_the_edge_holds_only_what_the_moment_about_it_allows():
    """Below l / h, friction at the edge slows nothing down enough to tilt."""
    cell = single(0.95 * 0.028 / HEIGHT)
    push(cell, 6.0)
    assert cell.motion("pushed").state is PushedState.SLIDING
    assert cell.motion("pushed").friction > PushedSettings().friction
