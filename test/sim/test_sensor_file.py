"""Sensor files say what a sensor and its rig are; the shipped ones load and give usable images."""

import numpy as np
import pytest

from tactile_base.config_paths import config_names
from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_perception.markers.detection import detect
from tactile_scene.simulated_sensors import TacTipSettings
from tactile_sim.collection import (
    CollectionSettings,
    Mounting,
    SensorFile,
    collect,
    load_sensor,
    press_then_shear,
)
from tactile_sim.tactip import TacTip
from tactile_sim.variation import VariationSettings


@pytest.fixture(scope="module")
def sensor() -> TacTip:
    return TacTip(seed=1)


def written(folder, text: str):
    path = folder / "sensor.yaml"
    path.write_text(text)
    return path


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    path = written(tmp_path, "camera: {focal_length: 700.0}\ncollection: {depth_offset: -2.0e-4}\n")
    sensor = load_sensor(path)
    assert sensor.sensor.camera.focal_length == 700.0
    assert sensor.sensor.skin == TacTipSettings().skin
    assert sensor.collection == CollectionSettings(depth_offset=-2e-4)
    assert sensor.variation is None


def test_variation_is_there_where_the_file_has_it(tmp_path):
    assert load_sensor(written(tmp_path, "variation: {}\n")).variation == VariationSettings()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("camra: {}\n", r"sensor.yaml:1: .*camra.*camera"),
        ("camera:\n  focal_length: -3.0\n", r"sensor.yaml:2: .*focal_length"),
        ("collection:\n  surface_tilt: [0.0]\n", r"sensor.yaml:2: .*surface_tilt"),
    ],
)
def test_what_is_wrong_is_told_with_file_and_line(tmp_path, text, complaint):
    with pytest.raises(SettingError, match=complaint):
        load_sensor(written(tmp_path, text))


def test_an_unknown_sensor_is_told_with_those_there_are():
    with pytest.raises(FileNotFoundError, match="tactip_franka"):
        load_sensor("tactip_frank")


@pytest.mark.parametrize("name", [name for name in config_names("sensors") if name != "gel_dome"])
def test_the_shipped_sensors_with_markers_see_all_of_them(name):
    file = load_sensor(name)
    sensor = TacTip(file.sensor, seed=1)
    true = sensor.marker_pixels
    press_then_shear(sensor, np.array([0.0, 0.0, -1e-3, 0.0, 0.0, 0.0]))
    found = detect(sensor.image())
    assert len(found) == len(true) == 331
    nearest = np.linalg.norm(true[:, None] - found.centers[None], axis=2).min(axis=1)
    assert nearest.max() < 0.5


def test_the_depth_offset_is_of_the_truth_not_of_the_label(sensor):
    exact = {"position_noise": 0.0, "angle_noise": 0.0}
    sample = collect(sensor, CollectionSettings(depth_offset=-3e-4, **exact), 4, 2)
    assert sample.truth.depth * 1e3 == pytest.approx(sample.euler_mm_deg[2] - 0.3, abs=1e-9)


def test_an_arm_that_turns_about_another_point_presses_deeper_or_less(sensor):
    """A tool centre point 2 mm off the axis: the dome's centre goes down by 2 mm times sin(tilt)."""
    mounting = Mounting.of(CollectionSettings(tool_offset=(2e-3, 0.0, 0.0)))
    beta = np.radians(20.0)
    depths = []
    for used in (None, mounting):
        sensor.reset()
        press_then_shear(sensor, np.array([0.0, 0.0, 2e-3, 0.0, beta, 0.0]), mounting=used)
        depths.append(sensor.truth().depth)
    assert abs(depths[1] - depths[0]) == pytest.approx(2e-3 * np.sin(beta), rel=1e-6)


def test_a_tool_centre_along_the_axis_changes_nothing_without_tilt(sensor):
    mounting = Mounting.of(CollectionSettings(tool_offset=(0.0, 0.0, 3e-3)))
    depths = {}
    for tilt in (0.0, 20.0):
        sensor.reset()
        pose = np.array([0.0, 0.0, 2e-3, np.radians(tilt), 0.0, 0.0])
        press_then_shear(sensor, pose, mounting=mounting)
        depths[tilt] = sensor.truth().depth
    assert depths[0.0] == pytest.approx(2e-3, abs=1e-12)
    assert abs(depths[20.0] - 2e-3) == pytest.approx(3e-3 * (1 - np.cos(np.radians(20.0))), rel=1e-6)


def test_a_tilted_surface_is_a_tilted_contact(sensor):
    mounting = Mounting.of(CollectionSettings(surface_tilt=(0.05, 0.0)))
    sensor.reset()
    press_then_shear(sensor, np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 0.0]), mounting=mounting)
    angles = se3.euler_from_pose(sensor.truth().T_fs)[3:5]
    assert np.hypot(*angles) == pytest.approx(0.05, rel=1e-6)


def test_a_sample_with_variation_depends_on_seed_and_index_only(sensor):
    settings = CollectionSettings()
    samples = [collect(sensor, settings, 7, index, VariationSettings()) for index in (3, 4, 3)]
    plain = collect(sensor, settings, 7, 3)
    assert np.array_equal(samples[0].image, samples[2].image)
    assert not np.array_equal(samples[0].image, plain.image)
    np.testing.assert_array_equal(samples[0].euler_mm_deg, plain.euler_mm_deg)


def test_without_a_file_all_is_default():
    file = SensorFile()
    assert file == SensorFile(TacTipSettings(), CollectionSettings(), None)
