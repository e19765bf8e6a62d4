"""Reader and writer of the public data layout, healthy and broken folders."""

import csv
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_folder

from tactile_perception.datasets.dataset import DatasetError, DatasetWriter, open_folder, read_dataset
from tactile_perception.estimating.preprocessing import PreprocessingSettings

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
    return write_folder(tmp_path / "data", zip(map(camera_image, range(1, 4)), EULER, strict=True))


def of_camera_images(folder: Path, raw: Path) -> Path:
    """The same samples as camera images."""
    (raw / "images").mkdir(parents=True)
    for number in (1, 2, 3):
        cv2.imwrite(str(raw / "images" / f"image_{number}.png"), camera_image(number))
    for name in ("targets_images.csv", "processed_image_params.json"):
        (raw / name).write_bytes((folder / name).read_bytes())
    return raw


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
    assert "image_1.png: must be 445x440 pixels, is 100x100" in first
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


@pytest.mark.parametrize("name", ["processed_image_params.json", "process_image_params.json"])
def test_image_settings_are_read_under_both_public_names(folder, name):
    (folder / "processed_image_params.json").unlink()
    (folder / name).write_text(json.dumps({"circle_mask_radius": 200}))
    source = open_folder(folder)
    assert source.preprocessing.circle_mask_radius == 200
    assert not any("assumed" in note for note in source.report.notes)


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
    raw = of_camera_images(folder, tmp_path / "raw")
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


# ---- what other labs' tools write ----


def renamed(folder: Path, names: dict[str, str]) -> list[str]:
    """Give the table's columns other names; returns them all."""
    rows = [{names.get(key, key): value for key, value in row.items()} for row in table(folder)]
    columns = [names.get(name, name) for name in COLUMNS]
    write_table(folder, rows, columns)
    return columns


@pytest.mark.parametrize(
    "pose, shear",
    [
        ([f"pose_{k}" for k in range(1, 7)], [f"shear_{k}" for k in range(1, 7)]),
        (["x", "y", "z", "Rx", "Ry", "Rz"], ["dx", "dy", "dz", "dRx", "dRy", "dRz"]),
    ],
)
def test_columns_of_other_generations_of_tools_are_read_and_said(folder, pose, shear):
    renamed(folder, dict(zip(COLUMNS[1:], [*pose, *shear], strict=True)))
    data = read_dataset(folder)
    np.testing.assert_array_equal(data.euler_mm_deg, EULER)
    assert any(f"labels read from {pose[0]}" in note and shear[5] in note for note in data.report.notes)


def test_of_a_move_to_the_pose_the_pose_counts_and_where_it_says_nothing_the_move(folder):
    """As tools with these columns work: the image is taken at the pose."""
    columns = [f"{kind}_{k}" for kind in ("pose", "move") for k in range(1, 7)]
    numbers = np.zeros((3, 12))
    numbers[:, :6] = [[0, 1, 3, 10, 0, 90], [0, -2, 4, 5, 1, -60], [0, 3, 5, -5, 2, 30]]
    numbers[:, 6:] = [[1, 2, 0, 3, -3, 4], [-1, 1, 0, 1, 2, 5], [2, 0, 0, -2, 1, 3]]
    names = [row["sensor_image"] for row in table(folder)]
    rows = [
        {"sensor_image": name, **dict(zip(columns, map(str, row), strict=True))}
        for name, row in zip(names, numbers, strict=True)
    ]
    write_table(folder, rows, ["sensor_image", *columns])
    data = read_dataset(folder)
    expected = numbers[:, :6].copy()
    expected[:, 0] = numbers[:, 6]
    np.testing.assert_array_equal(data.euler_mm_deg, expected)
    assert any("y, gamma of the pose, where the move had ended" in note for note in data.report.notes)


def test_object_poses_and_forces_beside_the_label_do_not_disturb(folder):
    rows = [{**row, "object_x": "-50", "Fx": "1.5", "speed": "3"} for row in table(folder)]
    write_table(folder, rows, [*COLUMNS, "object_x", "Fx", "speed"])
    data = read_dataset(folder)
    np.testing.assert_array_equal(data.euler_mm_deg, EULER)
    assert data.report.notes == ["targets_images.csv: columns not used: speed"]


def test_what_is_not_labelled_is_said_and_refused_by_those_who_need_all(folder):
    write_table(folder, table(folder), ["sensor_image", "pose_z", "pose_Rx", "pose_Ry"])
    with pytest.raises(DatasetError, match=r"x, y, gamma not labelled.*labels\.json"):
        read_dataset(folder)
    source = open_folder(folder)
    assert source.labelled == ("z", "alpha", "beta")
    assert any("x, y, gamma not labelled" in note for note in source.report.notes)
    (folder / "labels.json").write_text(json.dumps({"components": ["x", "y", "z", "alpha", "beta", "gamma"]}))
    np.testing.assert_array_equal(read_dataset(folder).euler_mm_deg[0], [0, 0, 3.0, 10.0, -12.0, 0])


def test_a_component_that_is_zero_in_every_row_is_not_labelled(tmp_path):
    labels = np.tile(EULER, (10, 1)) * [1, 1, 1, 1, 1, 0]
    folder = write_folder(tmp_path / "data", ((camera_image(k), euler) for k, euler in enumerate(labels)))
    with pytest.raises(DatasetError, match="gamma not labelled"):
        read_dataset(folder)


@pytest.mark.parametrize("content", ["[]", '{"components": []}', '{"components": ["w"]}', "{}"])
def test_labels_that_cannot_be_understood_are_an_error(folder, content):
    (folder / "labels.json").write_text(content)
    with pytest.raises(DatasetError, match=r"labels\.json: components = "):
        open_folder(folder)


def test_components_in_both_pose_and_shear_are_said(folder):
    rows = [{**row, "pose_x": str(k)} for k, row in enumerate(table(folder))]
    write_table(folder, rows)
    data = read_dataset(folder)
    assert any("pose and shear both vary in x" in note for note in data.report.notes)
    assert data.euler_mm_deg[2, 0] == EULER[2, 0] + 2


def test_raw_images_with_their_own_table_are_read(folder):
    (folder / "processed_images").rename(folder / "sensor_images")
    (folder / "targets_images.csv").rename(folder / "targets.csv")
    for number in (1, 2, 3):
        cv2.imwrite(str(folder / "sensor_images" / f"image_{number}.png"), camera_image(number))
    source = open_folder(folder)
    assert not source.processed and len(source) == 3
    assert source.image(0).shape == (480, 640)


def test_images_elsewhere_are_found_by_the_path_in_the_table(folder):
    (folder / "processed_images").rename(folder.parent / "elsewhere")
    (folder / "processed_images").mkdir()
    rows = [{**row, "sensor_image": f"../../elsewhere/{row['sensor_image']}"} for row in table(folder)]
    write_table(folder, rows)
    assert len(read_dataset(folder)) == 3


def test_the_image_without_contact_is_no_stray_and_can_be_had(folder):
    cv2.imwrite(str(folder / "processed_images" / "image_0.png"), np.zeros((440, 445), np.uint8))
    source = open_folder(folder)
    assert source.report.problems == {}
    assert source.reference().shape == (440, 445)
    assert read_dataset(folder).rest.shape == read_dataset(folder).images.shape[1:]
    assert open_folder(folder).names == ["image_1.png", "image_2.png", "image_3.png"]


@pytest.mark.parametrize("content", [b"cut", cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()])
def test_an_image_without_contact_that_is_damaged_or_too_small_is_done_without(folder, tmp_path, content):
    raw = of_camera_images(folder, tmp_path / "raw")
    (raw / "images" / "image_0.png").write_bytes(content)
    data = read_dataset(raw)
    assert data.rest is None and len(data) == 3


def test_processed_images_of_another_size_are_taken_as_they_are_and_said(folder):
    for number in (1, 2, 3):
        path = str(folder / "processed_images" / f"image_{number}.png")
        cv2.imwrite(path, np.full((128, 120), 40 * number, np.uint8))
    data = read_dataset(folder)
    assert data.images.shape == (3, 128, 128)
    assert any("processed images are 120x128, not 445x440" in note for note in data.report.notes)


def test_camera_images_of_another_size_are_taken_whole_and_said(tmp_path, folder):
    raw = tmp_path / "raw"
    (raw / "images").mkdir(parents=True)
    for number in (1, 2, 3):
        cv2.imwrite(str(raw / "images" / f"image_{number}.png"), np.zeros((256, 256), np.uint8))
    (raw / "targets.csv").write_bytes((folder / "targets_images.csv").read_bytes())
    source = open_folder(raw)
    assert source.preprocessing.raw_shape == source.preprocessing.crop_shape == (256, 256)
    assert any("camera images are 256x256, not 640x480" in note for note in source.report.notes)


@pytest.mark.parametrize(
    "conventions, expected",
    [
        ({"flip": ["x", "gamma"]}, [-1.0, -2.0, 3.0, 10.0, -12.0, -4.0]),
        ({"angle_unit": "rad"}, [1.0, -2.0, 3.0, *np.degrees([10.0, -12.0, 4.0])]),
        ({"length_unit": "m"}, [1000.0, -2000.0, 3000.0, 10.0, -12.0, 4.0]),
    ],
)
def test_a_folder_says_in_which_conventions_it_is_written(folder, conventions, expected):
    (folder / "conventions.json").write_text(json.dumps(conventions))
    data = read_dataset(folder)
    np.testing.assert_allclose(data.euler_mm_deg[0], expected)
    assert any("conventions.json" in note for note in data.report.notes)


@pytest.mark.parametrize("text", ['{"flip": ["w"]}', '{"angle": "rad"}', "[1]", "{"])
def test_conventions_that_cannot_be_understood_are_an_error(folder, text):
    (folder / "conventions.json").write_text(text)
    with pytest.raises(DatasetError, match=r"conventions\.json"):
        open_folder(folder)


# ---- what is damaged ----


def test_a_table_cut_in_a_row_gives_the_rows_before_and_names_the_cut_one(folder):
    path = folder / "targets_images.csv"
    text = path.read_text()
    path.write_text(text[: text.rstrip().rfind(",")])
    data = read_dataset(folder)
    assert data.names == ["image_1.png", "image_2.png"]
    assert ["image_3.png"] in data.report.problems.values()


def test_a_table_cut_within_the_last_number_does_not_give_a_wrong_label(folder):
    path = folder / "targets_images.csv"
    path.write_text(path.read_text().rstrip()[:-2])
    data = read_dataset(folder)
    assert data.names == ["image_1.png", "image_2.png"]
    (problem,) = data.report.problems
    assert "without a line end" in problem


def test_an_unfinished_collection_is_read_as_far_as_it_got_and_said(tmp_path):
    with DatasetWriter(tmp_path, PreprocessingSettings()) as writer:
        for number in (1, 2):
            writer.add(number, camera_image(number), EULER[number - 1])
    data = read_dataset(tmp_path)
    np.testing.assert_array_equal(data.euler_mm_deg, EULER[:2])
    assert any("was not finished" in note for note in data.report.notes)


@pytest.mark.parametrize("keep", [0, 30, 200, 0.5, 0.99])
def test_a_cut_image_is_named_however_much_of_it_is_there(folder, keep):
    path = folder / "processed_images" / "image_2.png"
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    report = read_dataset(folder).report
    assert "image_2.png: is not a readable image" in report.problems["unusable image"][0]
    assert report.samples == 2


def test_rows_run_together_are_named(folder):
    path = folder / "targets_images.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1] + "," + lines[2], lines[3]]) + "\n")
    report = read_dataset(folder).report
    assert report.problems["row with more fields than there are columns"] == ["image_1.png"]
    assert report.samples == 1


def test_a_table_from_a_spreadsheet_with_a_byte_order_mark_is_read(folder):
    path = folder / "targets_images.csv"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_dataset(folder)) == 3


def test_zero_bytes_and_foreign_letters_in_a_table_are_survived(folder):
    path = folder / "targets_images.csv"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:2], b"\0" * 50 + b"\n", b"\xff\xfe,1,2\n", *lines[2:]]))
    data = read_dataset(folder)
    assert len(data) == 3 and data.report.rows == 4


def test_an_empty_table_is_an_error_that_says_what_is_missing(folder):
    (folder / "targets_images.csv").write_text("")
    with pytest.raises(DatasetError, match="has no column sensor_image"):
        open_folder(folder)


@pytest.mark.parametrize("text", ['{"a": [1, 2}', '{"a": 1', '{"a": [1, 2]]}', '{"a": {"b": 1}'])
def test_brackets_too_many_or_too_few_are_repaired_with_their_place(folder, text):
    (folder / "meta.json").write_text(text)
    source = open_folder(folder)
    assert "a" in source.parameters["meta.json"]
    assert any("meta.json: malformed JSON" in note for note in source.report.notes)


def test_image_settings_of_the_wrong_kind_are_an_error(folder):
    (folder / "processed_image_params.json").write_text(json.dumps({"thresh": 61}))
    with pytest.raises(DatasetError, match="thresh = 61: must be a block and an offset"):
        open_folder(folder)


def test_a_pipe_among_the_images_is_a_missing_image(folder):
    image = folder / "processed_images" / table(folder)[1]["sensor_image"]
    image.unlink()
    os.mkfifo(image)
    assert len(open_folder(folder).names) == 2


@pytest.mark.parametrize(
    ("name", "complaint"),
    [("targets_images.csv", "has no targets_images.csv"), ("conventions.json", "is a pipe")],
)
def test_a_pipe_in_place_of_a_file_that_is_needed_is_refused(folder, name, complaint):
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    with pytest.raises(DatasetError, match=complaint):
        open_folder(folder)


@pytest.mark.parametrize("content", ["[" * 100_000, '{"flip": ' + "9" * 5000 + "}", "3", "\udcff"])
def test_conventions_that_cannot_be_used_are_refused(folder, content):
    (folder / "conventions.json").write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(DatasetError, match=r"conventions\.json: "):
        open_folder(folder)


def test_a_description_that_cannot_be_read_is_named_and_left_out(folder):
    (folder / "deep.json").write_text("[" * 100_000)
    os.mkfifo(folder / "pipe.json")
    report = "\n".join(open_folder(folder).report.lines())
    assert "deep.json" in report and "pipe.json: is a pipe" in report
