"""Contacts on an edge: where its frame lies, what is pressed, and how touches find it."""

import dataclasses
import math

import numpy as np
import pytest
from collected import Look, Store
from kinematic_plant import TIP_RADIUS, Plant, pointing_down
from scipy.optimize import brentq

from tactile_base.settings import SettingError
from tactile_control.phases import StampedImage, StampedPose, TaskInputs
from tactile_geometry import se3
from tactile_records.collecting import geometry
from tactile_records.collecting.settings import (
    CollectionGoal,
    CollectionMotionSettings,
    DataCollectionSettings,
    EdgeSettings,
    TouchSettings,
)
from tactile_records.collecting.task import DataCollection
from tactile_scene.sampling import SamplingSettings, contact_poses, pose_of
from tactile_scene.shapes.box import Box, BoxSettings

BOX = Box(BoxSettings(size=(0.12, 0.08, 0.02), rounding=1e-6))
T_BASE_BOX = se3.pose_from_euler([0.4, 0.3, 0.05, 0.0, 0.0, 0.3])
SHOWS, EDGE_SHOWS = 2e-4, 4e-4  # m of depth on a plate and on an edge
START = T_BASE_BOX @ pointing_down((0.01, -0.038, 0.01 + TIP_RADIUS + 0.012))
EDGE = EdgeSettings(pressed=True)
TOUCH = TouchSettings(points=3)


def true_frame() -> np.ndarray:
    """{f} of the edge below the start: x along the box's, y to its middle, a radius over its top."""
    T = np.eye(4)
    T[:3, :3] = np.array([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], float)
    T[:3, 3] = [0.01, -0.04, 0.01 + TIP_RADIUS]
    return T_BASE_BOX @ T


def depth(T_base_sensor: np.ndarray) -> float:
    """Of the tip in the box, by the distance of the box's surface."""
    middle = (se3.inverse(T_BASE_BOX) @ T_base_sensor)[None, :3, 3]
    return TIP_RADIUS - float(BOX.distance(middle)[0])


def shows(T_base_sensor: np.ndarray) -> bool:
    """Whether an image shows contact, which is later on the edge than on the plate."""
    y = (se3.inverse(T_BASE_BOX) @ T_base_sensor)[1, 3]
    return depth(T_base_sensor) > (SHOWS if y > -0.04 else EDGE_SHOWS)


def test_the_frame_lies_on_the_nearest_edge_of_the_face_below():
    T = geometry.edge_frame(T_BASE_BOX, BOX.settings.size, START, TIP_RADIUS)
    np.testing.assert_allclose(T, true_frame(), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(T[:3, :3]), 1.0)


def test_a_sensor_beside_the_box_has_no_edge_below():
    beside = T_BASE_BOX @ pointing_down((0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="beside or within the box"):
        geometry.edge_frame(T_BASE_BOX, BOX.settings.size, beside, TIP_RADIUS)


def test_poses_are_those_of_a_surface_moved_across_the_edge_and_turned():
    sampling = SamplingSettings()
    for index in range(50):
        pressed, sheared = contact_poses(sampling, EDGE, 3, index)
        plain = pose_of(sampling, 3, index)
        np.testing.assert_allclose(sheared - pressed, plain * [1, 1, 0, 0, 0, 1], atol=1e-12)
        assert EDGE.offset[0] <= pressed[1] <= EDGE.offset[1] and abs(pressed[5]) <= EDGE.direction
        flat, same = contact_poses(sampling, None, 3, index)
        np.testing.assert_array_equal(same, plain)
        np.testing.assert_array_equal(flat, plain * [0, 0, 1, 1, 1, 0])


def test_a_turn_never_goes_the_way_that_winds_cables_up():
    pressed = np.array([0.0, 0.0, 0.004, 0.0, 0.0, math.radians(-170.0)])
    turns = [turn[5] for turn in geometry.turns_to(pressed, math.radians(170.0))]
    np.testing.assert_allclose(turns, [0.0, math.radians(-170.0)], atol=1e-12)
    assert len(geometry.turns_to(pressed, math.radians(-10.0))) == 1


def test_a_tip_beside_the_plate_is_as_deep_as_it_is_in_the_edge():
    for y in (-0.006, -0.002, 0.001, 0.005):
        X_fs = geometry.at(0.003, y, 0.004)
        expected = depth(true_frame() @ X_fs)
        assert geometry.contact_depth(X_fs, EDGE) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("moved", [(0.0, 0.0, 0.0), (0.002, -0.0015, 3.0), (-0.001, 0.002, -4.0)])
def test_touches_find_height_tilt_offset_and_direction_of_the_edge(moved):
    """With a ball that is let down on the box, seen later on its edge, from a frame that is a bit wrong."""
    y, z, turn = moved
    wrong = se3.pose_from_euler([0.0, y, z, math.radians(1.0), math.radians(-0.5), math.radians(turn)])
    assumed = true_frame() @ wrong
    centers = []
    for place in geometry.places(TOUCH, EDGE):

        def late(down, place=place):
            T = assumed @ geometry.at(*place, down)
            beside = (se3.inverse(true_frame()) @ T)[1, 3] < 0.0
            return depth(T) - (EDGE_SHOWS if beside else SHOWS)

        centers.append([*place, brentq(late, -0.006, 0.012)])
    found = geometry.frame_from_touches(assumed, np.array(centers), TOUCH, EDGE)
    off = se3.log(se3.inverse(true_frame()) @ found)
    np.testing.assert_allclose(off[1:3], 0.0, atol=2e-5)
    np.testing.assert_allclose(off[3:], 0.0, atol=2e-3)


def test_touches_that_meet_the_plate_where_its_end_should_be_are_no_edge():
    centers = np.array([[*place, SHOWS] for place in geometry.places(TOUCH, EDGE)])
    with pytest.raises(ValueError, match="10 mm beside it there is still plate"):
        geometry.frame_from_touches(true_frame(), centers, TOUCH, EDGE)


def test_a_reach_beyond_the_tip_is_refused():
    with pytest.raises(SettingError, match="would meet the edge with its side"):
        EdgeSettings(reach=0.018)


class Bench(Plant):
    """An arm over the box, with a camera that shows contact."""

    def __init__(self) -> None:
        super().__init__(None, START, time_constant=0.01)
        self._known = False

    def inputs(self) -> TaskInputs:
        stamp, T = self.history[-1]
        seen = shows(T) if len(self.history) > 5 else None
        return TaskInputs(sensor_pose=StampedPose(stamp, T), image=StampedImage(stamp, T, seen))


def test_the_arm_finds_the_edge_and_presses_on_both_sides_of_it_without_turning_round():
    assumed = true_frame() @ se3.pose_from_euler([0.0, 0.0015, 0.0005, 0.0, 0.0, 0.03])
    settings = dataclasses.replace(
        DataCollectionSettings(),
        motion=CollectionMotionSettings(settle_time=0.05),
        touch=TOUCH,
        edge=EDGE,
        sampling=SamplingSettings(depth=(3e-3, 5.5e-3), disk_radius=3e-3, cap_angle=0.17),
    ).replaced(data__frame=tuple(se3.euler_from_pose(assumed).tolist()))
    store, bench = Store(), Bench()
    task = DataCollection(settings, CollectionGoal(samples=8, seed=1), store=store, look=Look())
    wrist = [0.0]
    for _ in range(round(240e9 / bench.period_ns)):
        command = task.step(bench.now_ns, bench.inputs())
        if command.done:
            break
        before = bench.T.copy()
        bench.step(command.twist)
        wrist.append(wrist[-1] + se3.log(se3.inverse(before) @ bench.T)[5])
    assert command.succeeded, command.reason
    off = se3.log(se3.inverse(true_frame()) @ store.surfaces[-1])
    np.testing.assert_allclose(off[1:3], 0.0, atol=2e-4)
    np.testing.assert_allclose(off[3:], 0.0, atol=1e-2)
    labels = np.array([capture.euler for capture in store.captures])
    truth = np.array(
        [se3.euler_from_pose(se3.inverse(store.surfaces[-1]) @ c.T_base_sensor) for c in store.captures]
    )
    np.testing.assert_allclose(labels, truth, atol=1e-9)
    targets = np.array([capture.target for capture in store.captures])
    np.testing.assert_allclose(labels[:, :3], targets[:, :3], atol=6e-5)
    assert labels[:, 1].min() < -1e-3 and labels[:, 1].max() > 1e-3
    assert np.ptp(labels[:, 5]) > np.pi, "it has turned far, but"
    assert np.ptp(wrist) < 2.0 * np.pi, "never wound up"
