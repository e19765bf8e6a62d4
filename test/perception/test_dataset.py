"""Reader and writer of the public data layout, healthy and broken folders."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactile_perception.dataset import DatasetError, DatasetWriter, open_folder, read_dataset
from tactile_perception.preprocessing import PreprocessingSettings

COLUMNS = [
    "sensor_image",
    *(f"{kind}_{axis}" for kind in ("pose", "shear") for axis in ("x", "y", "z", "Rx", "Ry", "Rz")),
]
EULER = np.array(
    [[1.0, -2.0, 3.0, 10.0, -12.0, 4.0], [0.5, 0.0, 1.0, 0.0, 5.0, -1.0], [2.0, 2.0, 5.5, 1.0, 2.0, 3.0]]
)


def camera_image(seed: int) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 255, (48, 64), dtype=np.uint8)
    return cv2.resize(image, (640, 480), interpolation=cv2.INTER_CUBIC)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A healthy folder of three samples."""
    writer = DatasetWriter(tmp_path / "data", PreprocessingSettings())
    for number, euler in enumerate(EULER, start=1):
        writer.add(number, camera_image(number), euler)
    writer.finish()
    return tmp_path / "data"


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "targets_images.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def write_table(folder: Path, rows: list[dict[str, str]], columns: list[str] = COLUMNS) -> None:
    with (folder / "targets_images.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def test_what_is_written_is_read_back(folder):
    data = read_dataset(folder)
    assert data.names == ["image_1.png", "image_2.png", "image_3.png"]
    np.testing.assert_array_equal(data.euler_mm_deg, EULER)
    assert data.images.shape == (3, 128, 128) and data.images.dtype == np.uint8
    assert data.labels.shape == (3, 6)
    assert data.report.problems == {} and data.report.notes == []


def test_table_has_the_public_columns_normal_contact_and_shear_apart(folder):
    row = table(folder)[0]
    assert list(row) == COLUMNS
    assert [float(row[name]) for name in COLUMNS[1:]] == [0, 0, 3.0, 10.0, -12.0, 0, 1.0, -2.0, 0, 0, 0, 4.0]


def test_settings_of_the_images_travel_with_the_folder(tmp_path):
    settings = PreprocessingSettings(
        bbox=(100, 20, 500, 420), threshold_block=31, threshold_offset=-4.0, median=3
    )
    writer = DatasetWriter(tmp_path, settings)
    writer.add(1, camera_image(0), EULER[0])
    writer.finish()
    assert open_folder(tmp_path).preprocessing == settings


def test_hash_follows_labels_images_and_order(folder):
    first = read_dataset(folder).sha256
    assert read_dataset(folder).sha256 == first
    rows = table(folder)
    write_table(folder, rows[::-1])
    reordered = read_dataset(folder).sha256
    rows[0]["pose_z"] = "3.0001"
    write_table(folder, rows)
    assert len({first, reordered, read_dataset(folder).sha256}) == 3


def test_missing_counterparts_are_named_and_counted(folder):
    (folder / "processed_images" / "image_2.png").unlink()
    cv2.imwrite(str(folder / "processed_images" / "stray.png"), np.zeros((440, 445), np.uint8))
    data = read_dataset(folder)
    assert data.names == ["image_1.png", "image_3.png"]
    assert data.report.problems == {
        "row without its image": ["image_2.png"],
        "image without its row": ["stray.png"],
    }
    assert "2 usable samples of 3 rows" in data.report.lines()[0]


@pytest.mark.parametrize(
    "value, problem",
    [
        ("nan", "non-finite"),
        ("inf", "non-finite"),
        ("", "missing or not a number"),
        ("x", "missing or not a number"),
    ],
)
def test_unusable_labels_are_named(folder, value, problem):
    rows = table(folder)
    rows[1]["shear_x"] = value
    write_table(folder, rows)
    report = read_dataset(folder).report
    assert [problem in key for key in report.problems] == [True]
    assert list(report.problems.values()) == [["image_2.png"]]


def test_images_of_another_size_and_broken_files_are_named(folder):
    images = folder / "processed_images"
    cv2.imwrite(str(images / "image_1.png"), np.zeros((100, 100), np.uint8))
    (images / "image_2.png").write_bytes((images / "image_2.png").read_bytes()[:60])
    report = read_dataset(folder).report
    first, second = report.problems["unusable image"]
    assert "image_1.png: is 100x100, must be 445x440" in first
    assert "image_2.png: is not a readable image" in second


def test_repeated_rows_are_kept_once_and_named(folder):
    rows = table(folder)
    write_table(folder, [*rows, rows[0]])
    data = read_dataset(folder)
    assert len(data) == 3
    assert data.report.problems == {"repeated row (first kept)": ["image_1.png"]}


def test_rows_that_contradict_each_other_are_all_left_out(folder):
    rows = table(folder)
    write_table(folder, [*rows, {**rows[0], "pose_z": "1"}])
    data = read_dataset(folder)
    assert data.names == ["image_2.png", "image_3.png"]
    assert data.report.problems == {"image with rows that disagree (all left out)": ["image_1.png"]}


def test_identical_images_are_named_and_kept(folder):
    images = folder / "processed_images"
    (images / "image_3.png").write_bytes((images / "image_1.png").read_bytes())
    data = read_dataset(folder)
    assert len(data) == 3
    assert list(data.report.problems.values()) == [["image_3.png"]]


def test_malformed_json_is_repaired_with_a_note(folder):
    (folder / "env_params.json").write_text('{"tcp_pose": [0, 0, 72]]}')
    source = open_folder(folder)
    assert source.parameters["env_params.json"] == {"tcp_pose": [0, 0, 72]}
    assert any(
        "env_params.json: malformed JSON; dropped a surplus ']'" in note for note in source.report.notes
    )


def test_hopeless_json_is_named_and_ignored(folder):
    (folder / "env_params.json").write_text("not json")
    report = open_folder(folder).report
    assert "unreadable JSON file (ignored)" in report.problems


def test_without_image_settings_the_defaults_are_assumed_and_said(folder):
    (folder / "processed_image_params.json").unlink()
    assert any("assumed the default" in note for note in open_folder(folder).report.notes)


def test_impossible_image_settings_are_an_error(folder):
    (folder / "processed_image_params.json").write_text(json.dumps({"bbox": [0, 0, 900, 100]}))
    with pytest.raises(DatasetError, match=r"processed_image_params\.json: bbox"):
        open_folder(folder)


def test_a_table_without_shear_columns_is_read_as_whole_poses(folder):
    write_table(folder, table(folder), COLUMNS[:7])
    data = read_dataset(folder)
    np.testing.assert_array_equal(data.euler_mm_deg[0], [0, 0, 3.0, 10.0, -12.0, 0])
    assert any("no shear_* columns" in note for note in data.report.notes)


def test_a_table_with_some_shear_columns_is_an_error(folder):
    write_table(folder, table(folder), COLUMNS[:9])
    with pytest.raises(DatasetError, match="missing shear_z, shear_Rx"):
        read_dataset(folder)


def test_a_table_without_labels_is_an_error_that_lists_its_columns(folder):
    write_table(folder, table(folder), ["sensor_image"])
    with pytest.raises(DatasetError, match=r"has no column pose_x.*its columns: sensor_image"):
        read_dataset(folder)


def test_a_folder_of_camera_images_gives_the_same_inputs(folder, tmp_path):
    raw = tmp_path / "raw"
    (raw / "images").mkdir(parents=True)
    for number in (1, 2, 3):
        cv2.imwrite(str(raw / "images" / f"image_{number}.png"), camera_image(number))
    (raw / "targets_images.csv").write_bytes((folder / "targets_images.csv").read_bytes())
    np.testing.assert_array_equal(read_dataset(raw).images, read_dataset(folder).images)


@pytest.mark.parametrize(
    "missing, message", [("targets_images.csv", "has no targets"), ("processed_images", "has neither")]
)
def test_a_folder_of_another_layout_is_an_error_that_says_what_is_expected(folder, missing, message):
    (folder / missing).rename(folder.parent / "elsewhere")
    with pytest.raises(DatasetError, match=f"{message}.*a data folder holds"):
        open_folder(folder)


def test_no_folder_is_an_error(tmp_path):
    with pytest.raises(DatasetError, match="is not a folder"):
        open_folder(tmp_path / "none")


def test_a_folder_without_a_usable_sample_is_an_error_that_says_why(folder):
    for path in (folder / "processed_images").iterdir():
        path.unlink()
    with pytest.raises(DatasetError, match="row without its image: 3"):
        open_folder(folder)


def test_a_limit_takes_samples_from_the_whole_table(folder):
    data = read_dataset(folder, limit=2)
    assert data.names == ["image_1.png", "image_3.png"]
    assert any("took 2 of 3" in note for note in data.report.notes)
