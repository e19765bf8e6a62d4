"""A pushed object against rigid bodies: sticking and sliding by the motion cone of Mason and Lynch.

An independent integrator of a rigid tip that pushes the flat side of an object on an ellipsoid of friction
(Lynch, Maekawa and Tanie 1992): where the force that a sticking contact needs lies in the cone of friction it
sticks, else the force is the edge of the cone and the contact slides. No step of it knows a stiffness.
"""

import numpy as np
import pytest
from pushed_cell import SPEED, place, push, scene

from tactile_sim.cell import Cell
from tactile_sim.limit_surface import Foot

FRICTION, HALF, HEIGHT, RADIUS, GAP = 0.3, 0.04, 0.022, 0.020, 0.001
ARM = Foot.around(HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])).arm
WAY = 0.015  # m
PUSHES = {  # where the tip meets the side, m; its direction; friction of the tip; centre of friction, m
    "sticks": (0.01, (0.2, 1.0), 0.9, (0.0, 0.0)),
    "sticks beside a shifted centre": (-0.01, (0.1, 1.0), 0.9, (0.015, 0.005)),
    "slides": (0.0, (1.0, 1.0), 0.2, (0.0, 0.0)),
    "slides beside the middle": (0.01, (1.0, 1.0), 0.3, (0.0, 0.0)),
    "slides away from the middle": (-0.015, (-0.8, 1.0), 0.1, (0.0, 0.01)),
    "slides far": (0.02, (0.8, 0.6), 0.5, (0.0, 0.0)),
    "slides without friction": (-0.02, (0.5, 1.0), 0.0, (0.01, 0.0)),
}


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def rigid_twist(contact, pusher, friction, off):
    """Motion (v_x, v_y of the body's origin, turn) while a point pushes the side y = -HALF; in the body."""
    ahead = np.zeros(2)  # of the pressure, by the height of the push
    for _ in range(8):
        center = off + ahead
        x, y = contact - center
        inverse = np.array([[ARM**2 + x * x, x * y], [x * y, ARM**2 + y * y]]) / (ARM**2 + x * x + y * y)
        force = inverse @ pusher
        if abs(force[0]) > friction * force[1]:  # slides along the edge of the cone
            force = np.array([np.sign(force[0]) * friction, 1.0])
        turn = (x * force[1] - y * force[0]) / ARM**2
        scale = pusher[1] / (force[1] + turn * x)
        assert scale > 0.0
        ahead = HEIGHT * FRICTION * force / np.hypot(np.hypot(*force), ARM * turn)
    velocity, turn = scale * force, scale * turn
    return np.array([*(velocity - turn * np.array([-center[1], center[0]])), turn])


def rigid_end(pose, center, direction, friction, off, way, steps=400):
    """x, y and turn (m, rad) of an object at a pose after the way of a tip that is at its side, m."""
    velocity, pose = np.asarray(direction) / direction[1], np.array(pose)
    for k in range(steps):
        at = rotation(pose[2]).T @ (center + (k + 0.5) * way / steps * velocity - pose[:2])
        contact = np.array([at[0], -HALF])
        twist = rigid_twist(contact, rotation(pose[2]).T @ velocity, friction, off) * way / steps
        pose += [*(rotation(pose[2] + 0.5 * twist[2]) @ twist[:2]), twist[2]]
    return pose


def ends(tmp_path, name, stiffness, speed, *ways):
    """Where the object is after ways of the tip from touching it, with that many times the shipped skin."""
    tip, direction, friction, off = PUSHES[name]
    skin = {"skin_force": 8.45 * stiffness, "skin_shear": 1053.0 * stiffness}
    cell = Cell(
        scene(tmp_path, (tip,), center_of_friction=off, friction_tip=friction, friction=FRICTION, **skin)
    )
    found, gone = [], -GAP
    for way in ways:
        push(cell, (way - gone) / speed, speed * np.asarray(direction) / direction[1])
        found.append(place(cell))
        gone = way
    return found


def tip_after(name, way):
    """The middle of the tip, m."""
    tip, direction, *_ = PUSHES[name]
    return np.array([tip, -RADIUS]) + np.array([(GAP + way) * direction[0] / direction[1], way])


@pytest.mark.parametrize("stiffness", [100.0, 300.0, 1000.0])
@pytest.mark.parametrize("name", PUSHES)
def test_a_stiff_tip_pushes_as_a_rigid_one_whether_it_sticks_or_slides(tmp_path, name, stiffness):
    """But for the way between two exposures, 0.17 mm, that passes until the first sees the contact."""
    (found,) = ends(tmp_path, name, stiffness, SPEED, WAY)
    rigid = rigid_end([0.0, HALF, 0.0], tip_after(name, 0.0), *PUSHES[name][1:], WAY)
    np.testing.assert_allclose(found[:2], rigid[:2], atol=0.3e-3)
    assert np.degrees(found[2] - rigid[2]) == pytest.approx(0.0, abs=0.25)
    assert abs(np.degrees(rigid[2])) > 4.0


@pytest.mark.parametrize(
    "stiffness, speed, part",
    [(1.0, 0.01, 0.03), (10.0, 0.01, 0.02), (100.0, 0.03, 0.08), (1000.0, 0.001, 0.002)],
)
@pytest.mark.parametrize("name", PUSHES)
def test_from_wherever_it_is_it_goes_on_as_under_a_rigid_tip(tmp_path, name, stiffness, speed, part):
    """The part by which it may differ grows with the way between two exposures."""
    before, after = ends(tmp_path, name, stiffness, speed, 0.02, 0.024)
    rigid = rigid_end(before, tip_after(name, 0.02), *PUSHES[name][1:], 0.004)
    np.testing.assert_allclose(after - before, rigid - before, rtol=part, atol=2e-6)
