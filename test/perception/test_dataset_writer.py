"""Writer of the public data layout: what is written survives an interruption, and nothing is there twice."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactile_perception.datasets.dataset import DatasetError, open_folder, read_dataset
from tactile_perception.datasets.writer import DatasetWriter
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor

EULER = np.array(
    [[1.0, -2.0, 3.0, 10.0, -12.0, 4.0], [0.5, 0.0, 1.0, 0.0, 5.0, -1.0], [2.0, 2.0, 5.5, 1.0, 2.0, 3.0]]
)
SETTINGS = PreprocessingSettings()


def camera_image(seed: int) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 255, (48, 64), dtype=np.uint8)
    return cv2.resize(image, (640, 480), interpolation=cv2.INTER_CUBIC)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_writing_goes_on_where_it_was_interrupted(tmp_path):
    with DatasetWriter(tmp_path, SETTINGS) as writer:
        writer.add(2, camera_image(2), EULER[1])
        writer.add(1, camera_image(1), EULER[0])
    journal = next(tmp_path.glob("*.partial.csv"))
    journal.write_text(journal.read_text()[:-4])  # killed in the middle of a row
    with DatasetWriter(tmp_path, SETTINGS) as resumed:
        assert resumed.done == {2}
        resumed.add(1, camera_image(1), EULER[0])
        resumed.add(3, camera_image(3), EULER[2])
        resumed.finish()
    data = read_dataset(tmp_path)
    assert data.names == ["image_1.png", "image_2.png", "image_3.png"]
    np.testing.assert_array_equal(data.euler_mm_deg, EULER)
    assert data.report.problems == {}


def test_a_row_whose_image_is_gone_is_done_again(tmp_path):
    with DatasetWriter(tmp_path, SETTINGS, images="both") as writer:
        writer.add(1, camera_image(1), EULER[0])
        writer.add(2, camera_image(2), EULER[1])
        (tmp_path / "images" / "image_2.png").unlink()
        assert writer.done == {1}


def test_two_processes_do_not_write_to_one_folder(tmp_path):
    with DatasetWriter(tmp_path, SETTINGS), pytest.raises(DatasetError, match="another process"):
        DatasetWriter(tmp_path, SETTINGS)
    DatasetWriter(tmp_path, SETTINGS).close()


WRITE = """
import sys, numpy as np
from tactile_perception.datasets.writer import DatasetWriter
from tactile_perception.estimating.preprocessing import PreprocessingSettings
writer = DatasetWriter(sys.argv[1], PreprocessingSettings())
number = max(writer.done, default=0)
while True:
    number += 1
    writer.add(number, np.full((480, 640), number % 256, np.uint8), [0, 0, number, 0, 0, 0])
    print(number, flush=True)
"""


def test_a_killed_writer_loses_nothing_that_it_had_said_was_done(tmp_path):
    folder, said = tmp_path / "data", set()
    for _ in range(2):
        with subprocess.Popen(
            [sys.executable, "-c", WRITE, folder], stdout=subprocess.PIPE, text=True
        ) as process:
            started = time.monotonic()
            while time.monotonic() - started < 20.0 and len(said) % 30 != 29:
                said.add(int(process.stdout.readline()))
            said.add(int(process.stdout.readline()))
            os.kill(process.pid, signal.SIGKILL)
            said |= {int(line) for line in process.stdout if line.endswith("\n")}
    with DatasetWriter(folder, SETTINGS) as writer:
        assert said <= writer.done and len(said) >= 30
        writer.finish()
    data = rows(folder / "targets_images.csv")
    numbers = [int(float(row["pose_z"])) for row in data]
    assert numbers == list(range(1, len(numbers) + 1)), "every number once, in order"
    assert open_folder(folder).report.problems.keys() <= {"image without its row"}


def test_camera_images_are_kept_where_asked_for_and_give_the_same_inputs(tmp_path):
    with DatasetWriter(tmp_path, SETTINGS, images="both") as writer:
        writer.add(1, camera_image(1), EULER[0])
        writer.finish()
    raw = cv2.imread(str(tmp_path / "images" / "image_1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(raw, camera_image(1))
    processed = cv2.imread(str(tmp_path / "processed_images" / "image_1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(processed, Preprocessor(SETTINGS).processed(raw))


def test_further_columns_stand_behind_those_of_the_layout(tmp_path):
    with DatasetWriter(tmp_path, SETTINGS, extra=("stamp_ns",), durable=True) as writer:
        writer.add(1, camera_image(1), EULER[0], {"stamp_ns": 12345678901234567})
        path = writer.finish()
    row = rows(path)[0]
    assert list(row)[-1] == "stamp_ns" and row["stamp_ns"] == "12345678901234567"
    with DatasetWriter(tmp_path / "forces", SETTINGS, extra=("Fx", "Fy", "Fz")) as writer:
        writer.add(
            1, camera_image(1), EULER[0], dict(zip(("Fx", "Fy", "Fz"), np.array([0.1, 2, -3]), strict=True))
        )
        writer.finish()
    np.testing.assert_array_equal(read_dataset(tmp_path / "forces").force, [[0.1, 2.0, -3.0]])
    np.testing.assert_array_equal(read_dataset(tmp_path).euler_mm_deg, EULER[:1])


def test_an_unknown_kind_of_images_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="processed, raw, both"):
        DatasetWriter(tmp_path, SETTINGS, images="binary")
