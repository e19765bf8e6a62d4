"""`tactile data check`: what it says of healthy data, and that it finds wrong signs, units and axes."""

import argparse
import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_folder

from tactile_bringup.commands import data as data_command
from tactile_perception.datasets.check import check
from tactile_perception.datasets.conventions import (
    Conventions,
    Explanation,
    explain,
    find_conventions,
    sense_of_turning,
)
from tactile_perception.datasets.dataset import DatasetError, DatasetWriter, open_folder
from tactile_perception.datasets.statistics import label_statistics
from tactile_perception.datasets.table import ConventionSettings
from tactile_perception.datasets.visibility import better_parts, of_markers
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.markers.flow import FlowError, FlowSettings, MarkerFlow, flow_of, measure
from tactile_sim.collection import CollectionSettings, generate

COUNT = 260
SEED = 11
SETTINGS = FlowSettings(samples=COUNT)
COLUMNS = dict(
    zip(EULER_COMPONENTS, ("shear_x", "shear_y", "pose_z", "pose_Rx", "pose_Ry", "shear_Rz"), strict=True)
)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Simulated samples as `tactile data generate` makes them."""
    folder = tmp_path_factory.mktemp("data") / "train"
    samples = generate(CollectionSettings(), SEED, range(COUNT))
    return write_folder(folder, ((sample.image, sample.euler_mm_deg) for sample in samples))


@pytest.fixture(scope="module")
def flow(data) -> MarkerFlow:
    return measure(open_folder(data), SETTINGS)


def changed(data: Path, folder: Path, change) -> Path:
    """A copy of the data set with `change(row of label numbers by component)` applied; images are shared."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(data / "processed_image_params.json", folder)
    (folder / "processed_images").symlink_to(data / "processed_images")
    with (data / "targets_images.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        values = {name: float(row[column]) for name, column in COLUMNS.items()}
        for name, value in change(values).items():
            row[COLUMNS[name]] = repr(value)
    with (folder / "targets_images.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder


def flipped(*names: str):
    return lambda values: {name: -value if name in names else value for name, value in values.items()}


def texts(result, level: str) -> list[str]:
    return [finding.text for finding in result.findings if finding.level == level]


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    data_command.register(parser.add_subparsers())
    parsed = parser.parse_args(["data", "check", *arguments])
    return parsed.run(parsed)


def test_simulated_data_follow_the_papers_conventions(flow):
    found = find_conventions(flow)
    assert found.uncertain == [] and found.depth_flipped is False
    assert found.explanations == [Explanation()]
    assert (found.length_unit, found.angle_unit) == ("mm", "deg")
    assert found.order != "intrinsic"


def test_markers_are_followed_to_a_fraction_of_a_pixel(data, flow):
    from tactile_sim.collection import collect
    from tactile_sim.tactip import TacTip

    sensor, folder = TacTip(), open_folder(data)
    index = np.sort(np.random.default_rng(SETTINGS.seed).permutation(len(folder))[:COUNT])
    offset = np.array(folder.preprocessing.bbox[:2])
    for k in (3, 50, 120):
        collect(sensor, CollectionSettings(), SEED, int(index[k]))
        true = sensor.marker_pixels - offset
        found = flow.positions[k][np.isfinite(flow.positions[k][:, 0])]
        nearest = np.linalg.norm(found[:, None] - true[None], axis=2).min(axis=1)
        assert np.median(nearest) < 0.5 and len(found) > 250


@pytest.mark.parametrize("name", ["x", "y", "alpha", "beta", "gamma"])
def test_a_flipped_component_is_found_and_named(flow, name):
    labels = flow.labels.copy()
    labels[:, EULER_COMPONENTS.index(name)] *= -1.0
    found = find_conventions(flow_of(flow.positions, labels, flow.rest, flow.deeper, SETTINGS))
    assert found.explanations == [Explanation((name,))]
    assert found.depth_flipped is False


def test_radians_and_meters_are_found(flow):
    labels = flow.labels * ([1e-3] * 3 + [np.pi / 180] * 3)
    found = find_conventions(flow_of(flow.positions, labels, flow.rest, flow.deeper, SETTINGS))
    assert found.uncertain == []
    assert (found.length_unit, found.angle_unit) == ("m", "rad")
    assert found.explanations == [Explanation()]


# ---- signs, by the maps alone: every combination is quick ----


def maps(flow: MarkerFlow, names) -> tuple[np.ndarray, np.ndarray, float]:
    """Maps as they would be measured with these components flipped."""
    sign = {name: -1.0 if name in names else 1.0 for name in EULER_COMPONENTS}
    shear = -flow.shear.value * [sign["x"], sign["y"]]
    tilt = -flow.tilt.value * np.sign(flow.spread.value) * [sign["beta"], sign["alpha"]]
    return shear, tilt, float(flow.turn.value) * sign["gamma"]


@pytest.mark.parametrize("names", [("x", "gamma"), ("y", "alpha"), ("alpha", "gamma"), ("x", "y")])
def test_two_flipped_components_are_found_up_to_what_images_cannot_tell(flow, names):
    found = explain(*maps(flow, names))
    assert Explanation(names) in found or Explanation(("alpha", "beta")) in found
    assert len({explanation.cost for explanation in found}) == 1


def test_shear_named_by_where_it_started_is_told_as_one_of_two_ways(flow):
    found = {explanation.flipped for explanation in explain(*maps(flow, ("x", "y", "gamma")))}
    assert found == {("x", "y", "gamma"), ("alpha", "beta", "gamma")}


def test_mirrored_images_are_told_from_flipped_labels(flow):
    shear, tilt, turn = maps(flow, ())
    mirror = np.diag([-1.0, 1.0])
    assert explain(mirror @ shear, mirror @ tilt, -turn) == [Explanation(mirrored=True)]


def test_swapped_axes_are_found(flow):
    shear, tilt, turn = maps(flow, ())
    assert explain(shear[:, ::-1], tilt, turn) == [Explanation(swapped="x and y")]


def test_a_camera_turned_by_any_angle_changes_nothing(flow):
    shear, tilt, turn = maps(flow, ())
    for angle in np.radians([17, 90, 143, 251]):
        R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert explain(R @ shear, R @ tilt, turn) == [Explanation()]


def test_labels_that_the_images_do_not_follow_are_told_as_such(data, tmp_path):
    rng = np.random.default_rng(0)

    def noise(values):
        return {name: float(value) for name, value in zip(COLUMNS, rng.normal(size=6), strict=True)}

    folder = open_folder(changed(data, tmp_path / "noise", noise))
    try:
        found = find_conventions(measure(folder, SETTINGS))
    except FlowError:
        return  # too few markers could be followed
    assert found.explanations == [] and len(found.uncertain) >= 2


def test_markers_of_small_binary_and_of_gray_images_tell_the_same(data, tmp_path, flow):
    for name, shape in (("small", (200, 198)), ("gray", (440, 445))):
        folder = changed(data, tmp_path / name, flipped())
        target = folder / ("images" if name == "gray" else "processed_images")
        (folder / "processed_images").unlink()
        target.mkdir()
        for path in (data / "processed_images").iterdir():
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            image = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA)
            gray = 20 + cv2.GaussianBlur(image, (0, 0), 2.0) // 4
            cv2.imwrite(
                str(target / path.name), gray if name == "gray" else 255 * (image > 127).astype(np.uint8)
            )
        source = open_folder(folder)
        assert source.processed == (name == "small")
        measured = measure(source, SETTINGS)
        assert measured.found > 0.8 and find_conventions(measured).explanations == [Explanation()]


def test_depth_is_told_without_markers(tmp_path):
    poses = labels(200)
    wave = np.sin(np.arange(60) / 9.0)
    with DatasetWriter(tmp_path, PreprocessingSettings(), images="raw") as writer:
        for number, label in enumerate(poses, start=1):
            pattern = np.outer(np.roll(wave, number), np.roll(wave, 7 * number))
            image = cv2.resize((128 + 15 * label[2] * pattern).astype(np.uint8), (640, 480))
            writer.add(number, image, label * [1, 1, -1, 1, 1, 1])
        writer.finish()
    result = check(open_folder(tmp_path), FlowSettings(samples=200))
    assert any("z falls as contacts get deeper" in text for text in texts(result, "error"))
    assert any('{"flip": ["z"]' in text for text in texts(result, "note"))
    assert any("do not tell directions and units" in text for text in texts(result, "warning"))
    assert result.visibility.of == "image change"


# ---- what to write into conventions.json ----


def found(*explanations: Explanation, **changes) -> Conventions:
    values = {
        "depth_flipped": False,
        "uncertain": [],
        "camera_deg": 0.0,
        "length_unit": "mm",
        "angle_unit": "deg",
    }
    cameras = [10.0 * k for k in range(len(explanations))]
    return Conventions(
        explanations=list(explanations),
        cameras_deg=cameras,
        gains={},
        order="",
        order_t=0.0,
        **{**values, **changes},
    )


@pytest.mark.parametrize(
    ("conventions", "applied", "flips", "units"),
    [
        (found(Explanation(("beta",))), {}, [["beta"]], ("mm", "deg")),
        (found(Explanation(("alpha",))), {"flip": ("x",)}, [["alpha", "x"]], ("mm", "deg")),
        (found(Explanation(("x",))), {"flip": ("x",)}, [[]], ("mm", "deg")),
        (found(Explanation(), depth_flipped=True, angle_unit="rad"), {}, [["z"]], ("mm", "rad")),
        (found(Explanation(), depth_flipped=True), {"length_unit": "m"}, [["z"]], ("m", "deg")),
        (found(Explanation(("x",)), Explanation(("y",))), {}, [["x"], ["y"]], ("mm", "deg")),
        (found(Explanation(swapped="x and y"), Explanation(mirrored=True)), {}, [], None),
        (found(depth_flipped=True, uncertain=["the direction of x and y"]), {}, [["z"]], ("mm", "deg")),
        (found(depth_flipped=True), {}, [], None),
    ],
)
def test_the_lines_that_correct_what_was_found(conventions, applied, flips, units):
    lines = [content for content, _ in conventions.corrections(ConventionSettings(**applied))]
    assert [line["flip"] for line in lines] == flips
    assert all((line["length_unit"], line["angle_unit"]) == units for line in lines)


def test_where_two_lines_would_do_they_differ_by_half_a_turn_of_the_camera(flow):
    labels = flow.labels * [-1.0, -1.0, 1.0, 1.0, 1.0, -1.0]
    changed_flow = flow_of(flow.positions, labels, flow.rest, flow.deeper, SETTINGS)
    lines = find_conventions(changed_flow).corrections(ConventionSettings())
    assert [content["flip"] for content, _ in lines] == [["x", "y", "gamma"], ["alpha", "beta", "gamma"]]
    (_, first), (_, second) = lines
    assert abs(first - second) == pytest.approx(180.0)


@pytest.mark.parametrize("sense", [-1.0, 1.0])
def test_a_gamma_all_round_that_turns_the_wrong_way_is_found(sense):
    """At an edge markers are pushed to one side of it, and the edge turns by -gamma in the image."""
    rng = np.random.default_rng(7)
    poses = np.zeros((200, 6))
    poses[:, 1], poses[:, 5] = rng.uniform(-6, 6, 200), rng.uniform(-180, 180, 200)
    turned = np.radians(40.0 + sense * poses[:, 5])
    push = (6.0 - 0.3 * poses[:, 1])[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    rest = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), axis=2).reshape(-1, 2) * 20
    positions = rest + push[:, None] + rng.normal(size=(200, 144, 2))
    t = sense_of_turning(flow_of(positions, poses, rest, 2.0))
    assert t * sense > 5.0


# ---- how much of each component shows ----


def motion(labels: np.ndarray, rng: np.random.Generator, noise: float = 0.3) -> np.ndarray:
    """Markers (n, 40, 2) that follow all labels but gamma, of which they see a hundredth."""
    weights = rng.normal(size=(6, 40, 2)) * np.array([1, 1, 1, 0.3, 0.3, 0.01])[:, None, None]
    return np.einsum("nk,kmd->nmd", labels, weights) + rng.normal(size=(len(labels), 40, 2)) * noise


def test_a_component_that_hardly_shows_is_named_and_shares_are_those_put_in():
    rng = np.random.default_rng(3)
    labels = rng.uniform(-1, 1, (400, 6)) * [4, 4, 2, 15, 15, 5]
    found = of_markers(labels, motion(labels, rng), EULER_COMPONENTS)
    variance = labels.var(axis=0) * np.array([1, 1, 1, 0.09, 0.09, 1e-4])
    expected = variance / (variance.sum() + 0.09)
    np.testing.assert_allclose(list(found.shares.values()), expected, rtol=0.35, atol=2e-4)
    assert found.hardly == ["gamma"]
    assert found.noise == pytest.approx(0.09 / (variance.sum() + 0.09), rel=0.3)


def test_an_angle_all_round_shows_though_its_mean_effect_is_none():
    rng = np.random.default_rng(3)
    labels = np.zeros((400, 6))
    labels[:, 1], labels[:, 5] = rng.uniform(-6, 6, 400), rng.uniform(-180, 180, 400)
    gamma = np.radians(labels[:, 5])
    positions = (labels[:, 1:2] * np.stack([np.cos(gamma), np.sin(gamma)], axis=1))[:, None].repeat(
        30, axis=1
    )
    found = of_markers(labels, positions + rng.normal(size=positions.shape), ("y", "gamma"))
    assert found.hardly == [] and found.shares["gamma"] > 0.5


def test_markers_that_follow_the_pose_alone_are_told_from_those_that_follow_the_sum():
    rng = np.random.default_rng(5)
    pose = rng.uniform(-1, 1, (400, 6)) * [4, 4, 2, 15, 15, 5]
    shear = np.zeros_like(pose)
    shear[:, 3:5] = rng.uniform(-5, 5, (400, 2))
    assert better_parts(pose, shear, motion(pose + shear, rng), EULER_COMPONENTS) == {}
    shown = pose + shear * [1, 1, 1, 0, 1, 1]
    assert better_parts(pose, shear, motion(shown, rng), EULER_COMPONENTS) == {"alpha": "pose"}


# ---- the labels alone ----


def labels(count: int = 2000, seed: int = 0) -> np.ndarray:
    from tactile_scene.sampling import SamplingSettings, pose_of

    poses = np.array([pose_of(SamplingSettings(), seed, k) for k in range(count)])
    return poses * ([1e3] * 3 + [180 / np.pi] * 3)


def test_the_papers_sampling_is_even_balanced_and_uncorrelated():
    found = label_statistics(labels())
    assert all(spread.even for spread in found.spreads) and len(found.spreads) == 4
    assert not (found.constant or found.off_center or found.correlated or found.repeated or found.sorted_by)
    assert found.outliers == []
    assert found.shear_sectors.sum() == 2000 and found.shear_sectors.min() > 50


def test_holes_lopsidedness_and_repetitions_are_found():
    bad = labels()
    bad = bad[bad[:, 0] > -1.0]
    bad[:, 3] = 3.0
    bad[:50] = bad[0]
    bad[7, 2] = 60.0
    found = label_statistics(bad)
    assert found.constant == ["alpha"] and "x" in found.off_center
    assert found.repeated >= 48 and 7 in found.outliers
    assert (found.shear_sectors == 0).any()


def test_uneven_depths_and_correlations_are_found():
    bad = labels()
    bad[:, 2] = 0.5 + 5.5 * ((bad[:, 2] - 0.5) / 5.5) ** 4
    bad[:, 5] += bad[:, 0]
    found = label_statistics(bad)
    assert next(spread.name for spread in found.spreads if not spread.even) == "z"
    assert ("x", "gamma") in [(a, b) for a, b, _ in found.correlated]


@pytest.mark.parametrize("direction", [1, -1])
def test_sorted_rows_are_noticed(direction):
    values = labels(300)
    assert label_statistics(values[np.argsort(direction * values[:, 2])]).sorted_by == "z"


# ---- the command ----


def test_the_command_shows_a_table_and_writes_pictures(data, tmp_path, capsys):
    assert run(str(data), "--samples", "120", "--out", str(tmp_path / "check")) == 0
    output = capsys.readouterr().out
    assert "x (mm)" in output and "0 error" in output
    assert run(str(data), "--samples", "120", "--out", str(tmp_path / "check")) == 0
    assert (tmp_path / "check-1" / "check.json").exists() and (tmp_path / "check" / "check.json").exists()
    capsys.readouterr()
    for name in ("labels.png", "rows.png", "flow.png"):
        assert (tmp_path / "check" / name).stat().st_size > 5000
    content = json.loads((tmp_path / "check" / "check.json").read_text())
    assert content["worst"] != "error" and content["samples"] == COUNT


def test_the_command_ends_with_1_for_wrong_signs_and_can_mend_them(data, tmp_path, capsys):
    folder = changed(data, tmp_path / "bad", flipped("z", "gamma"))
    options = (str(folder), "--samples", str(COUNT))
    assert run(*options, "--write-conventions") == 1
    output = capsys.readouterr().out
    assert "gamma has the opposite sign" in output and "conventions.json" in output
    assert "z falls as contacts get deeper" in output
    assert json.loads((folder / "conventions.json").read_text())["flip"] == ["gamma", "z"]
    np.testing.assert_array_equal(open_folder(folder).euler_mm_deg, open_folder(data).euler_mm_deg)


def test_damage_is_told_by_the_command(data, tmp_path, capsys):
    folder = changed(data, tmp_path / "bad", flipped())
    images = folder / "processed_images"
    images.unlink()
    shutil.copytree(data / "processed_images", images)
    (images / "image_1.png").unlink()
    (images / "image_2.png").write_bytes((images / "image_2.png").read_bytes()[:500])
    shutil.copy(images / "image_3.png", images / "image_4.png")
    assert run(str(folder), "--samples", "60") == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "row without its image: 1" in output
    assert "1 images that cannot be read" in output and "1 images with the same content" in output


def test_parts_are_checked_each(data, tmp_path, capsys):
    for name in ("train_data", "val_data"):
        changed(data, tmp_path / name, flipped())
    assert run(str(tmp_path), "--samples", "60", "--out", str(tmp_path / "check")) == 0
    assert {path.parent.name for path in (tmp_path / "check").glob("*/check.json")} == {"train", "val"}


def test_check_and_estimate_say_the_same_of_camera_images_of_another_size(tmp_path, capsys):
    for count in range(60):
        image = np.full((420, 420), count, np.uint8)
        image[:200] = 255
        (tmp_path / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / f"image_{count + 1}.png"), image)
    columns = ["x", "y", "z", "Rx", "Ry", "Rz"]
    rows = [[f"image_{k + 1}.png", *label] for k, label in enumerate(labels(60).tolist())]
    with (tmp_path / "labels.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["image_name", *columns], *rows])
    run(str(tmp_path), "--samples", "60")
    output = " ".join(capsys.readouterr().out.split())
    with pytest.raises(DatasetError) as refusal:
        open_folder(tmp_path, PreprocessingSettings())
    said = str(refusal.value).partition(": ")[2]
    assert "camera images are 420x420, not 640x480" in said and said in output


def test_a_folder_that_is_none_ends_with_2(tmp_path, capsys):
    assert run(str(tmp_path / "none")) == 2
    assert "is not a folder" in capsys.readouterr().err


def test_too_few_images_leave_the_conventions_open_and_say_so(data, tmp_path):
    folder = open_folder(data)
    few = replace(folder, names=folder.names[:40], pose=folder.pose[:40], shear=folder.shear[:40])
    result = check(few, FlowSettings(samples=60))
    assert any("at least 60 are needed" in text for text in texts(result, "warning"))
