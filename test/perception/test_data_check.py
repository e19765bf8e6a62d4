"""`tactile data check`: what it says of healthy data, and that it finds wrong signs, units and axes."""

import argparse
import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from folders import write_folder

from tactile_bringup.commands import data as data_command
from tactile_perception.datasets.check import check
from tactile_perception.datasets.conventions import Explanation, explain, find_conventions
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.statistics import label_statistics
from tactile_perception.estimating.labels import EULER_COMPONENTS
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
    parser = argparse.ArgumentParser()
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


def test_a_folder_that_is_none_ends_with_2(tmp_path, capsys):
    assert run(str(tmp_path / "none")) == 2
    assert "is not a folder" in capsys.readouterr().err


def test_too_few_images_leave_the_conventions_open_and_say_so(data, tmp_path):
    folder = open_folder(data)
    few = replace(folder, names=folder.names[:40], euler_mm_deg=folder.euler_mm_deg[:40])
    result = check(few, FlowSettings(samples=60))
    assert any("at least 60 are needed" in text for text in texts(result, "warning"))
