"""`tactile data import`: tables of other labs by mapping files, published layouts, what is refused."""

import argparse
import csv
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from transforms3d.euler import euler2mat

from tactile_base.settings import SettingError
from tactile_bringup.commands import data as data_command
from tactile_perception.datasets.dataset import DatasetError, open_folder, read_dataset
from tactile_perception.datasets.importing import flat_names, import_folder
from tactile_perception.datasets.mapping import Column, TableMapping, UnknownTable, read_mapping
from tactile_perception.datasets.sample_sheet import contact_direction, draw_samples, shear_direction
from tactile_perception.estimating.labels import EULER_COMPONENTS, surface_contact_pose

AXES = ("x", "y", "z", "Rx", "Ry", "Rz")
EULER = np.random.default_rng(4).uniform([-4, -4, 0.5, -20, -20, -5], [4, 4, 6, 20, 20, 5], (40, 6)).round(3)


def run(*arguments: object) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    data_command.register(parser.add_subparsers())
    parsed = parser.parse_args(["data", "import", *map(str, arguments)])
    return parsed.run(parsed)


def write_csv(path: Path, columns: list[str], rows: list[list]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])


def write_images(folder: Path, names: list[str], shape: tuple[int, int], binary: bool = True) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        image = np.random.default_rng(k).integers(0, 255, shape, dtype=np.uint8)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), 255 * (image > 127).astype(np.uint8) if binary else image)


def images(count: int = len(EULER), first: int = 1) -> list[str]:
    return [f"image_{first + k}.png" for k in range(count)]


def normal_and_shear(label: np.ndarray) -> list[float]:
    """The twelve numbers of the public layout: normal contact and shear."""
    x, y, z, alpha, beta, gamma = label
    return [0, 0, z, alpha, beta, 0, x, y, 0, 0, 0, gamma]


def public_folder(folder: Path, table: str = "targets_images.csv") -> Path:
    columns = [f"{kind}_{axis}" for kind in ("pose", "shear") for axis in AXES]
    rows = [[name, *normal_and_shear(label)] for name, label in zip(images(), EULER, strict=True)]
    write_csv(folder / table, ["sensor_image", *columns], rows)
    write_images(folder / "processed_images", images(), (42, 42))
    return folder


def mapping_file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mapping.yaml"
    path.write_text(text)
    return path


# ---- the maths, by transforms3d (its letters: s for static, which is extrinsic, r for rotating) ----


@settings(max_examples=150, deadline=None)
@given(
    euler=st.sampled_from(
        [
            f"{kind} {a}"
            for kind in ("extrinsic", "intrinsic")
            for a in ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")
        ]
    ),
    inverted=st.booleans(),
    pose=st.lists(st.floats(-80, 80), min_size=6, max_size=6),
    shear=st.lists(st.floats(-5, 5), min_size=6, max_size=6),
    flip=st.sets(st.sampled_from(EULER_COMPONENTS)),
)
def test_any_order_of_angles_and_inverted_poses_become_ours(euler, inverted, pose, shear, flip):
    kind, axes = euler.split()
    mapping = TableMapping(euler=euler, inverted=inverted, flip=tuple(flip))
    contact, slid = mapping.converted(np.array([pose]), np.array([shear]))
    signs = np.array([-1.0 if name in flip else 1.0 for name in EULER_COMPONENTS])
    for ours, theirs in ((contact, signs * pose), (contact + slid, signs * np.add(pose, shear))):
        angles = np.radians([theirs[3 + "xyz".index(axis)] for axis in axes])
        T = np.eye(4)
        T[:3, :3] = euler2mat(*angles, axes=("s" if kind == "extrinsic" else "r") + axes)
        T[:3, 3] = 1e-3 * theirs[:3]
        np.testing.assert_allclose(
            surface_contact_pose(ours[0]), np.linalg.inv(T) if inverted else T, atol=1e-7
        )


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_units_and_signs_of_a_mapping_give_our_labels(tmp_path, separator):
    folder = tmp_path / "theirs"
    theirs = EULER * [1, 1, -1e-3, np.radians(1), -np.radians(1), 1]
    rows = [
        [f"run1/{name}", *map(repr, row.tolist()), 7.5] for name, row in zip(images(), theirs, strict=True)
    ]
    write_csv(folder / "contacts.csv", ["file", "tx", "ty", "height", "roll", "pitch", "yaw", "load"], rows)
    table = folder / "contacts.csv"
    table.write_text(table.read_text().replace(",", separator))
    write_images(folder / "run1", images(), (60, 80), binary=False)
    text = """
table: contacts.csv
image: file
pose:
  z: {column: height, unit: m, sign: -1}
  alpha: {column: roll, unit: rad}
  beta: {column: pitch, unit: rad, sign: -1}
shear:
  x: {column: tx, unit: mm}
  y: {column: ty}
  gamma: {column: yaw}
force:
  Fz: {column: load}
"""
    imported, said = import_folder(folder, tmp_path / "ours", read_mapping(mapping_file(tmp_path, text)))
    np.testing.assert_allclose(imported.euler_mm_deg, EULER, atol=1e-12)
    assert imported.labelled == EULER_COMPONENTS and imported.forces == ("Fz",)
    assert imported.force[0].tolist() == [0.0, 0.0, 7.5]
    assert said["images"] == {"kind": "gray", "width": 80, "height": 60, "circular": False}
    np.testing.assert_allclose(read_dataset(tmp_path / "ours").euler_mm_deg, EULER, atol=1e-12)


def test_a_mapping_that_names_move_columns_as_shear_is_taken_at_its_word(tmp_path):
    """Without a mapping a move ends at the pose, which then counts alone."""
    rows = [[name, *map(repr, (0.5 * row).tolist())] for name, row in zip(images(), EULER, strict=True)]
    write_csv(tmp_path / "theirs" / "table.csv", ["file", "pose_2", "move_2", *"abcd"], rows)
    write_images(tmp_path / "theirs", images(), (60, 80), binary=False)
    text = "table: table.csv\nimage: file\npose: {y: {column: pose_2}}\nshear: {y: {column: move_2}}"
    imported, _ = import_folder(
        tmp_path / "theirs", tmp_path / "ours", read_mapping(mapping_file(tmp_path, text))
    )
    np.testing.assert_allclose(imported.euler_mm_deg[:, 1], 0.5 * (EULER[:, 0] + EULER[:, 1]), atol=1e-12)


def test_signs_and_units_of_a_folder_come_before_what_its_poses_are_turned_by(tmp_path):
    folder = public_folder(tmp_path / "theirs")
    (folder / "conventions.json").write_text('{"flip": ["beta"], "length_unit": "m"}')
    mapping = read_mapping(mapping_file(tmp_path, "pose_of: surface in sensor"))
    imported, _ = import_folder(folder, tmp_path / "ours", mapping)
    T = surface_contact_pose(EULER[3] * [1e3, 1e3, 1e3, 1, -1, 1])
    np.testing.assert_allclose(surface_contact_pose(imported.euler_mm_deg[3]), np.linalg.inv(T), atol=1e-9)


def test_a_mapping_without_columns_turns_poses_of_a_known_table(tmp_path):
    public_folder(tmp_path / "theirs")
    mapping = read_mapping(mapping_file(tmp_path, "euler: intrinsic xyz"))
    imported, _ = import_folder(tmp_path / "theirs", tmp_path / "ours", mapping)
    alpha, beta, gamma = np.radians(EULER[3, 3:])
    expected = euler2mat(alpha, beta, gamma, axes="rxyz")
    np.testing.assert_allclose(surface_contact_pose(imported.euler_mm_deg[3])[:3, :3], expected, atol=1e-9)


# ---- layouts as they are published ----


def test_parts_are_found_images_are_linked_and_the_source_is_left_alone(tmp_path, capsys):
    for part in ("train_data", "val_data"):
        public_folder(tmp_path / "theirs" / part)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "theirs").rglob("*")}
    assert run(tmp_path / "theirs", "--out", tmp_path / "ours") in (0, 1)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "theirs").rglob("*")} == before
    theirs = tmp_path / "theirs" / "val_data" / "processed_images" / "image_3.png"
    assert os.path.samefile(theirs, tmp_path / "ours" / "val" / "processed_images" / "image_3.png")
    np.testing.assert_array_equal(read_dataset(tmp_path / "ours" / "train").euler_mm_deg, EULER)
    output = " ".join(capsys.readouterr().out.split())
    assert "images: binary of 42x42" in output and "labelled: x, y, z, alpha, beta, gamma" in output
    assert (tmp_path / "ours" / "train" / "samples.png").stat().st_size > 20_000


def test_a_table_named_labels_is_read_like_the_others(tmp_path):
    public_folder(tmp_path / "data", "labels.csv")
    np.testing.assert_array_equal(read_dataset(tmp_path / "data").euler_mm_deg, EULER)


def test_an_edge_has_three_labels_and_no_others_are_made_up(tmp_path):
    folder = tmp_path / "edge"
    columns = [f"{kind}_{k}" for kind in ("pose", "move") for k in range(1, 7)]
    still = [0.0] * 6
    rows = [
        [name, 0.0, y, z, 0.0, 0.0, 30 * g, *still]
        for name, (_, y, z, _, _, g) in zip(images(), EULER, strict=True)
    ]
    write_csv(folder / "targets.csv", ["sensor_image", *columns], rows)
    write_images(folder / "images", images(), (128, 128))
    imported, said = import_folder(folder, tmp_path / "ours")
    assert said["components"] == ("y", "z", "gamma") == imported.labelled and imported.processed
    header = (tmp_path / "ours" / "targets_images.csv").read_text().splitlines()[0]
    assert header == "sensor_image,pose_y,pose_z,pose_Rz,shear_y,shear_z,shear_Rz"
    for source in (folder, tmp_path / "ours"):
        with pytest.raises(DatasetError, match="x, alpha, beta not labelled, only y, z, gamma"):
            read_dataset(source)


def test_gray_images_with_forces_and_no_crop_are_taken_whole(tmp_path):
    folder = tmp_path / "pad"
    columns = [*(f"{kind}_{axis}" for kind in ("pose", "shear") for axis in AXES), "Fx", "Fy", "Fz", "Tx"]
    rows = [
        [name, *normal_and_shear(label), 1, -2, 30, 0]
        for name, label in zip(images(first=0), EULER, strict=True)
    ]
    rows[5][-2] = ""
    write_csv(folder / "targets.csv", ["sensor_image", *columns], rows)
    write_images(folder / "sensor_images", images(first=0), (45, 60), binary=False)
    (folder / "sensor_image_params.json").write_text('{"gray": true, "bbox":[0, 0, 0, 0], "dims": [60, 45]}')
    imported, said = import_folder(folder, tmp_path / "ours")
    assert imported.forces == ("Fx", "Fy", "Fz") and imported.force[0].tolist() == [1, -2, 30]
    assert np.isnan(imported.force[5]).all() and len(imported) == len(EULER)
    assert imported.image(0).shape == (45, 60) and imported.image_folder.name == "images"
    assert imported.reference() is None  # number 0 is a contact here
    assert any("Tx" in note for note in said["notes"])


def test_names_that_occur_in_two_folders_stay_apart():
    names = ["a/1.png", "b/1.png", "../c/2.png"]
    assert flat_names(names) == ["a_1.png", "b_1.png", "2.png"]
    assert len(set(flat_names([*names, "a_1.png"]))) == 4


def test_color_and_a_circle_are_told(tmp_path):
    folder = public_folder(tmp_path / "data")
    disc = cv2.circle(np.zeros((42, 42, 3), np.uint8), (20, 20), 18, (90, 160, 200), -1)
    for name in images():
        cv2.imwrite(str(folder / "processed_images" / name), disc)
    _, said = import_folder(folder, tmp_path / "ours")
    assert said["images"]["kind"] == "color, read as gray" and said["images"]["circular"]


# ---- what is refused ----


def test_an_unknown_table_is_refused_with_its_columns_and_a_template_that_works(tmp_path, capsys):
    folder = tmp_path / "theirs"
    rows = [[name, label[2]] for name, label in zip(images(), EULER, strict=True)]
    write_csv(folder / "contacts.csv", ["frame", "depth"], rows)
    write_images(folder / "frames", images(), (128, 128))
    assert run(folder, "--out", tmp_path / "ours") == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "contacts.csv" in message and "its columns: frame, depth" in message and "mapping.yaml" in message
    path = tmp_path / "ours" / "mapping.yaml"
    with pytest.raises(SettingError, match="says nothing"):
        read_mapping(path)
    text = path.read_text().replace("#image: NAME", "image: frame")
    path.write_text(text.replace("#  z: {column: NAME", "  z: {column: depth", 1))
    for name in images():
        (folder / "frames" / name).rename(folder / name)
    assert run(folder, "--out", tmp_path / "ours", "--mapping", path) in (0, 1)
    assert open_folder(tmp_path / "ours").labelled == ("z",)
    assert path.read_text().startswith("# How contacts.csv is to be read. Its columns: frame, depth")


def test_the_mapping_in_the_docs_is_one(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    mapping = read_mapping(mapping_file(tmp_path, page.partition("```yaml\n")[2].partition("```")[0]))
    assert mapping.labelled == ("x", "z", "beta") and mapping.forces == ("Fz",)
    assert mapping.pose[2] == Column("depth", -1000.0)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("image: f\npose: {z: {column: d, unit: inch}}", "unit.*inch"),
        ("image: f\npose: {alpha: {column: d, unit: mm}}", "unit.*mm"),
        ("image: f\npose: {z: {column: d, sign: 2}}", "sign = 2: must be 1 or -1"),
        ("image: f\npose: {w: {column: d}}", "pose: .*w"),
        ("image: f\npose: {z: {unit: mm}}", "pose.z.column is missing"),
        ("image: f\npose: {z: {column: d}, x: {column: d}}", "column d is used more than once"),
        ("image: f\npose: {z: {column: d}}\neuler: zyx", "euler.*zyx"),
        ("image: f\npose: {z: {column: d}}\npose_of: camera", "pose_of.*camera"),
        ("image: f", "at least one component must be labelled"),
        ("pose: {z: {column: d}}", "image is missing"),
    ],
)
def test_mistakes_in_a_mapping_are_named_with_their_line(tmp_path, text, complaint):
    with pytest.raises(SettingError, match=rf"mapping\.yaml:\d+: .*{complaint}"):
        read_mapping(mapping_file(tmp_path, text))


def test_a_pose_that_lacks_components_cannot_be_turned_round_unless_they_are_given(tmp_path):
    folder = tmp_path / "theirs"
    write_csv(
        folder / "labels.csv",
        ["f", "d"],
        [[name, -label[2]] for name, label in zip(images(), EULER, strict=True)],
    )
    write_images(folder / "images", images(), (64, 64))
    text = "image: f\npose_of: surface in sensor\npose: {z: {column: d}"
    mapping = read_mapping(mapping_file(tmp_path, text + "}"))
    with pytest.raises(DatasetError, match=r"x, y, alpha, beta, gamma must be there.*surface in sensor"):
        open_folder(folder, mapping=mapping)
    held = ", ".join(f"{name}: {{value: 0}}" for name in EULER_COMPONENTS if name != "z")
    imported, _ = import_folder(
        folder, tmp_path / "ours", read_mapping(mapping_file(tmp_path, f"{text}, {held}}}"))
    )
    np.testing.assert_allclose(imported.euler_mm_deg[:, 2], EULER[:, 2])
    assert imported.labelled == EULER_COMPONENTS


def test_a_mapping_whose_columns_are_not_there_lists_those_that_are(tmp_path):
    folder = public_folder(tmp_path / "theirs")
    mapping = read_mapping(mapping_file(tmp_path, "image: frame\npose: {z: {column: depth}}"))
    with pytest.raises(UnknownTable, match="has no column frame, depth; its columns: sensor_image, pose_x"):
        open_folder(folder, mapping=mapping)


def test_nothing_is_written_into_the_source(tmp_path, capsys):
    folder = public_folder(tmp_path / "theirs")
    assert run(folder, "--out", folder / "ours") == 2
    assert "left as it is" in " ".join(capsys.readouterr().err.split()) and not (folder / "ours").exists()


# ---- the picture ----


def test_directions_on_the_picture_are_those_of_the_sensor():
    label = np.array([[2.0, 0.0, 3.0, 10.0, -4.0, 0.0], [2.0, 0.0, 3.0, 0.0, 0.0, 90.0]])
    np.testing.assert_allclose(contact_direction(label)[0], [4.0, 10.0])
    np.testing.assert_allclose(shear_direction(label), [[2.0, 0.0], [0.0, -2.0]], atol=1e-12)


def test_the_picture_survives_an_image_that_cannot_be_read(tmp_path):
    folder = public_folder(tmp_path / "data")
    (folder / "processed_images" / "image_2.png").write_bytes(b"")
    draw_samples(open_folder(folder), tmp_path / "samples.png", None)
    assert (tmp_path / "samples.png").stat().st_size > 20_000
