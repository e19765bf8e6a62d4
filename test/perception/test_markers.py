"""Markers are found where they are, merged ones apart, and their density shows where the tip is pressed."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tactile_bringup.cli import main as tactile
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.preprocessing import Preprocessor
from tactile_perception.markers.detection import (
    DetectionSettings,
    density,
    density_change,
    detect,
    is_binary,
    redrawn,
)
from tactile_perception.markers.view import draw_density, draw_markers, side_by_side
from tactile_sim.collection import press_then_shear
from tactile_sim.tactip import TacTip

REST = [0.0, 0.0, -1e-3, 0.0, 0.0, 0.0]
PRESSED = [2e-3, -1e-3, 4e-3, np.radians(8.0), np.radians(-12.0), np.radians(3.0)]


def contact(pose) -> tuple[np.ndarray, np.ndarray]:
    """Camera image of a simulated contact, and where its markers are (n, 2) px."""
    sensor = TacTip(seed=3)
    press_then_shear(sensor, np.array(pose))
    return sensor.image(), sensor.marker_pixels


def discs(centers, radius: float = 5.0, shape=(120, 160), gray: int = 255) -> np.ndarray:
    """Anti-aliased discs, drawn eight times as large and averaged."""
    scale = 8
    image = np.zeros((shape[0] * scale, shape[1] * scale), np.uint8)
    for column, row in centers:
        middle = (round((column + 0.5) * scale - 0.5), round((row + 0.5) * scale - 0.5))
        cv2.circle(image, middle, round(radius * scale), gray, -1)
    return cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA)


def distances(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return cKDTree(found).query(true)[0]


@pytest.mark.parametrize("pose", [REST, PRESSED], ids=["no contact", "pressed and sheared"])
def test_all_markers_of_a_camera_image_are_found_to_a_tenth_of_a_pixel(pose):
    image, true = contact(pose)
    found = detect(image)
    assert len(found) == len(true) == 331
    assert np.sqrt(np.mean(distances(found.centers, true) ** 2)) < 0.1


@pytest.mark.parametrize("pose", [REST, PRESSED], ids=["no contact", "pressed and sheared"])
def test_the_markers_of_the_pre_processed_image_are_the_same_to_half_a_pixel(pose):
    image, true = contact(pose)
    preprocessor = Preprocessor()
    found = detect(preprocessor.processed(image))
    offset = preprocessor.settings.bbox[:2]
    distance = distances(found.centers + offset, true)
    assert np.count_nonzero(distance > 3.0) <= 3
    assert np.sqrt(np.mean(distance[distance < 3.0] ** 2)) < 0.5


@settings(max_examples=25, deadline=None)
@given(column=st.floats(30, 34), row=st.floats(40, 44))
def test_a_center_is_found_between_pixels(column, row):
    true = np.array([[column + 22 * i, row + 22 * j] for i in range(4) for j in range(3)])
    for image in (discs(true, gray=200), np.where(discs(true) > 127, 255, 0).astype(np.uint8)):
        found = detect(image, DetectionSettings(median=0))
        assert len(found) == 12
        assert distances(found.centers, true).max() < 0.35


@pytest.mark.parametrize(
    "together",
    [
        [(60, 60), (69, 60)],
        [(60, 60), (67, 66)],
        [(55, 60), (64, 60), (73, 62)],
        [(60, 60), (69, 60), (64, 68), (73, 68)],
    ],
    ids=["pair", "slanting pair", "row of three", "four"],
)
def test_merged_markers_are_told_apart(together):
    alone = [(20 + 25 * i, 20) for i in range(6)] + [(20 + 25 * i, 100) for i in range(6)]
    image = np.where(discs(alone + together) > 127, 255, 0).astype(np.uint8)
    found = detect(image, DetectionSettings(median=0, neighbors=0))
    assert found.merged.sum() == len(together) and len(found) == 12 + len(together)
    assert distances(found.centers[found.merged], np.array(together, float)).max() < 1.5


def test_specks_rims_and_reflections_are_no_markers():
    true = [(30 + 20 * i, 25 + 20 * j) for i in range(6) for j in range(4)]
    image = discs(true, radius=4.0, shape=(160, 240))
    cv2.line(image, (2, 110), (150, 116), 255, 3)  # a rim
    image[130:137, 200:218] = 255  # a reflection
    image[60, 20] = image[61, 20] = 255  # a speck of dust
    found = detect(np.where(image > 127, 255, 0).astype(np.uint8))
    assert len(found) == 24 and distances(found.centers, np.array(true, float)).max() < 0.5


def test_a_redrawn_image_has_the_same_markers_and_nothing_else():
    image, _ = contact(PRESSED)
    image[200:204, :60] = 255  # a reflection
    markers = detect(image)
    again = redrawn(markers, image.shape, radius=6.0)
    found = detect(again)
    assert len(found) == len(markers) and distances(found.centers, markers.centers).max() < 0.5
    assert np.median(found.areas) == pytest.approx(np.pi * 6.0**2, rel=0.15)
    assert not again[200:204, :20].any()


def test_an_image_without_markers_has_none():
    for gray in (0, 90, 255):
        assert len(detect(np.full((480, 640), gray, np.uint8))) == 0
    noise = np.random.default_rng(0).normal(20, 2, (480, 640)).clip(0, 255).astype(np.uint8)
    assert len(detect(noise)) == 0


def test_binary_images_are_recognized():
    assert is_binary(np.array([[0, 255]], np.uint8)) and not is_binary(np.array([[0, 254]], np.uint8))


@pytest.mark.parametrize(
    ("image", "complaint"),
    [
        (np.zeros((4, 4)), "float64"),
        (np.zeros((4, 4, 3), np.uint8), r"\(4, 4, 3\)"),
        ([[0, 255]], "is list"),
    ],
)
def test_what_is_no_gray_image_is_refused(image, complaint):
    with pytest.raises(ImageError, match=complaint):
        detect(image)


def test_an_even_neighborhood_is_refused():
    with pytest.raises(ValueError, match="neighborhood = 60: must be odd"):
        DetectionSettings(neighborhood=60)


def test_the_density_is_the_sum_of_gaussians():
    rng = np.random.default_rng(1)
    centers, columns, rows = rng.uniform(0, 50, (20, 2)), np.arange(0, 50, 3.0), np.arange(0, 40, 5.0)
    expected = np.zeros((len(rows), len(columns)))
    for column, row in centers:
        square = (columns[None] - column) ** 2 + (rows[:, None] - row) ** 2
        expected += np.exp(-square / (2 * 4.0**2)) / (2 * np.pi * 4.0**2)
    np.testing.assert_allclose(density(centers, columns, rows, 4.0), expected, rtol=1e-12)


def test_the_density_integrates_to_the_number_of_markers():
    centers = np.array([[100.0, 90.0], [120.0, 110.0], [100.0, 120.0]])
    grid = np.arange(0.0, 220.0, 2.0)
    assert density(centers, grid, grid, 8.0).sum() * 4.0 == pytest.approx(3.0, rel=1e-6)


def test_pressing_parts_the_markers_where_the_contact_is():
    reference = detect(contact(REST)[0])
    image, _ = contact([0.0, 0.0, 4e-3, 0.0, 0.0, 0.0])
    markers = detect(image)
    change = density_change(markers, reference, image.shape)
    row, column = np.unravel_index(change.values.argmin(), change.values.shape)
    middle = reference.centers.mean(axis=0)
    assert change.values.min() < -0.15 and change.values.max() > 0.1
    assert np.hypot(change.columns[column] - middle[0], change.rows[row] - middle[1]) < 80
    assert change.spacing == pytest.approx(reference.spacing())


def test_without_contact_the_density_does_not_change():
    image, _ = contact(REST)
    markers = detect(image)
    assert not density_change(markers, markers, image.shape).values.any()


def test_a_reference_without_markers_is_refused():
    nothing = detect(np.zeros((48, 64), np.uint8))
    with pytest.raises(ImageError, match="0 markers found: at least two"):
        density_change(nothing, nothing, (48, 64))


def test_the_pictures_show_markers_and_change():
    image, _ = contact(PRESSED)
    markers, reference = detect(image), detect(contact(REST)[0])
    change = density_change(markers, reference, image.shape)
    rings, map_ = draw_markers(image, markers), draw_density(change, markers, image.shape)
    assert rings.shape == map_.shape == (480, 640, 3)
    least, most = (np.unravel_index(f(change.values), change.values.shape) for f in (np.argmin, np.argmax))
    blue, red = (map_[int(change.rows[r]), int(change.columns[c])].astype(int) for r, c in (least, most))
    assert blue[0] > blue[2] and red[2] > red[0]
    np.testing.assert_array_equal(side_by_side(image, markers, change), np.hstack([rings, map_]))


def test_the_command_writes_picture_and_table(tmp_path, capsys):
    for name, pose in (("rest", REST), ("pressed", PRESSED)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), contact(pose)[0])
    out, csv = tmp_path / "new" / "picture.png", tmp_path / "centers.csv"
    arguments = ["--reference", str(tmp_path / "rest.png"), "--out", str(out), "--csv", str(csv)]
    assert tactile(["markers", str(tmp_path / "pressed.png"), *arguments]) == 0
    assert "331 markers" in capsys.readouterr().out
    assert cv2.imread(str(out)).shape == (480, 1280, 3)
    assert len(csv.read_text().splitlines()) == 332
    assert tactile(["markers", str(tmp_path / "rest.png"), "--out", str(out), "--csv", str(csv)]) == 0
    assert cv2.imread(str(out.with_name("picture-1.png"))).shape == (480, 1280, 3)
    assert len((tmp_path / "centers-1.csv").read_text().splitlines()) == 332
    assert f"the earlier {out} is {tmp_path / 'new' / 'picture-1.png'} now" in capsys.readouterr().err


def test_the_command_says_what_is_wrong(tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((40, 40), np.uint8))
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((48, 64), np.uint8))
    (tmp_path / "text.png").write_text("no image")
    image = str(tmp_path / "image.png")
    for arguments, complaint in (
        ([str(tmp_path / "none.png")], "there is no such file"),
        ([str(tmp_path / "text.png")], "is not a readable image"),
        ([image, "--reference", str(tmp_path / "small.png")], "is 40x40; must be 64x48"),
        ([image, "--reference", image], "0 markers found"),
    ):
        assert tactile(["markers", *arguments]) == 1
        assert complaint in capsys.readouterr().err
