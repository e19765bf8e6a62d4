"""Where collected samples go: rows with what was asked for, the surface found by touch, and going on."""

import csv

import numpy as np
import pytest

from tactile_geometry import se3
from tactile_perception.datasets.dataset import DatasetError, read_dataset
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_records.collecting.sample_store import EXTRA_COLUMNS, SURFACE_NAME, SampleStore, found_surface
from tactile_records.collecting.settings import Capture

EULER = np.array([0.001, -0.002, 0.003, 0.1, -0.2, 0.05])
T = se3.pose_from_euler([0.4, 0.1, 0.02, np.pi, 0.1, 0.2])


def image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (480, 640), dtype=np.uint8)


def store(folder) -> SampleStore:
    return SampleStore(folder, PreprocessingSettings(), "both")


def test_a_row_keeps_label_stamp_target_and_where_the_sensor_was(tmp_path):
    ours = store(tmp_path)
    assert ours.missing(2) == [1, 2]
    ours.keep(Capture(2, 1234567890123456789, EULER, EULER * 1.01, T), image(2))
    assert ours.missing(2) == [1]
    ours.finish()
    with (tmp_path / "targets_images.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["stamp_ns"] == "1234567890123456789"
    assert float(row["shear_x"]) == pytest.approx(1.0) and float(row["target_x"]) == pytest.approx(1.01)
    assert float(row["pose_Rx"]) == pytest.approx(np.degrees(0.1))
    assert float(row["base_sensor_x"]) == pytest.approx(400.0)
    assert list(row)[-len(EXTRA_COLUMNS) :] == list(EXTRA_COLUMNS)
    np.testing.assert_allclose(
        read_dataset(tmp_path).euler_mm_deg[0], EULER * ([1e3] * 3 + [180 / np.pi] * 3), rtol=1e-12
    )


def test_the_image_without_contact_is_number_0_and_no_sample(tmp_path):
    ours = store(tmp_path)
    ours.keep_reference(image(0))
    ours.keep(Capture(1, 1, EULER, EULER, T), image(1))
    ours.finish()
    data = read_dataset(tmp_path)
    assert data.names == ["image_1.png"] and data.report.problems == {}
    assert (tmp_path / "images" / "image_0.png").exists()


def test_the_surface_found_by_touch_is_there_again_and_said_in_words(tmp_path):
    ours = store(tmp_path)
    assert ours.surface() is None
    found = T @ se3.pose_from_euler([0.0, 0.0, 0.0005, 0.01, 0.0, 0.0])
    ours.keep_surface(found, T, 3)
    _, text = found_surface(tmp_path)
    assert "3 touches" in text and "+0.50 mm deeper" in text and "0.57 deg" in text
    np.testing.assert_allclose(ours.surface(), found, atol=1e-12)


@pytest.mark.parametrize("text", ["", "{}", '{"frame": [1, 2]}', '{"frame": [1, 2, 3, 4, 5, NaN]}'])
def test_a_surface_file_that_cannot_be_read_is_an_error_that_names_it(tmp_path, text):
    ours = store(tmp_path)
    (tmp_path / SURFACE_NAME).write_text(text)
    with pytest.raises(DatasetError, match=SURFACE_NAME):
        ours.surface()
