"""Simulated contacts on an edge: as on a plate far from it, as an arm makes them, and none beside it."""

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_records.collecting.geometry import edge_frame
from tactile_scene.sampling import ON_EDGES, EdgeSampling
from tactile_scene.shapes.box import Box, BoxSettings
from tactile_sim.collection import CollectionSettings, Collector, press_on_edge, press_then_shear
from tactile_sim.tactip import TacTip

SETTINGS = CollectionSettings().replaced(**ON_EDGES)
PRESSED = np.array([0.0, 2e-3, 4e-3, 0.05, -0.1, 0.6])
SHEARED = PRESSED + np.array([1e-3, -5e-4, 0.0, 0.0, 0.0, 0.03])


@pytest.fixture(scope="module")
def sensor() -> TacTip:
    return TacTip()


def markers(sensor: TacTip) -> np.ndarray:
    return np.asarray(sensor.marker_pixels).copy()


def test_far_over_the_plate_an_edge_is_a_surface(sensor):
    over = np.array([0.0, 0.04, 0.0, 0.0, 0.0, 0.0])
    pose = np.array([1e-3, -5e-4, 4e-3, 0.05, -0.1, 0.03])
    sensor.reset(seed=1)
    press_on_edge(sensor, over + pose * [0, 0, 1, 1, 1, 0], over + pose)
    on_edge = markers(sensor)
    sensor.reset(seed=1)
    press_then_shear(sensor, pose)
    assert np.linalg.norm(on_edge - markers(sensor), axis=1).max() < 0.1


def test_beside_the_plate_there_is_no_contact(sensor):
    sensor.reset(seed=1)
    rest = markers(sensor)
    beside = np.array([0.0, -0.03, 4e-3, 0.0, 0.0, 0.5])
    press_on_edge(sensor, beside, beside)
    np.testing.assert_array_equal(markers(sensor), rest)


def test_it_is_the_contact_that_an_arm_makes_on_a_box_somewhere(sensor):
    size, radius = (0.12, 0.09, 0.04), sensor.settings.skin.radius
    box = Box(BoxSettings(size=size, rounding=2e-4))
    over = se3.pose_from_euler([0.055, 0.01, 0.05, np.pi, 0.0, 0.0])  # near the edge towards +x
    T_box_f = edge_frame(np.eye(4), size, over, radius)
    sensor.reset(seed=1)
    for pose in (PRESSED - [0, 0, 5e-3, 0, 0, 0], PRESSED, SHEARED):
        sensor.advance(box, T_box_f @ se3.pose_from_euler(pose))
    by_arm = markers(sensor)
    sensor.reset(seed=1)
    press_on_edge(sensor, PRESSED, SHEARED)
    assert np.linalg.norm(by_arm - markers(sensor), axis=1).max() < 0.1


def test_samples_lie_where_edge_sampling_says():
    edge = EdgeSampling(offset=(1e-3, 2e-3), direction=0.2)
    collector = Collector(SETTINGS.replaced(disk_radius=0.0, gamma=0.0), 3, edge=edge)
    poses = np.array([collector(index).euler_mm_deg for index in range(8)])
    assert np.all((poses[:, 1] >= 1.0) & (poses[:, 1] <= 2.0)) and np.ptp(poses[:, 1]) > 0.2
    assert np.degrees(0.2) >= np.abs(poses[:, 5]).max() > 1.0
    np.testing.assert_array_equal(poses[:, 0], 0.0)


def test_offsets_upside_down_are_refused():
    with pytest.raises(SettingError, match="offset"):
        EdgeSampling(offset=(5e-3, 1e-3))
