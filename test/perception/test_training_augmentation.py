"""Symmetry of the marker pattern and augmentation: images and labels that belong together. Needs PyTorch."""

import cv2
import numpy as np
import pytest
from scipy.linalg import expm, logm
from tangent import hat, vee

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")

from tactile_base.settings import SettingError  # noqa: E402
from tactile_geometry import se3  # noqa: E402
from tactile_perception.training.augmentation import (  # noqa: E402
    AugmentationError,
    Augmenter,
    without_markers,
)
from tactile_perception.training.settings import AugmentationSettings  # noqa: E402
from tactile_perception.training.symmetry import (  # noqa: E402
    CropGeometry,
    SymmetryAxis,
    find_center,
    find_mirror,
    patterns_at_rest,
)

SHAPE, SIDE = (440, 445), 256
CENTER = np.array([226.3, 219.8])
GEOMETRY = CropGeometry(SHAPE, SIDE)


def rings(
    center: np.ndarray = CENTER, push: tuple[float, float] = (0.0, 0.0), twist: float = 0.15, by: float = 0.0
) -> np.ndarray:
    """The TacTip's markers on the crop, those within 60 px of the center moved by `push`.

    Each ring is turned by `twist` against the next, and all of them by `by`.
    """
    crop = np.zeros(SHAPE, np.uint8)
    for ring in range(1, 11):
        for k in range(6 * ring):
            angle = 2 * np.pi * k / (6 * ring) + twist * ring + by
            point = 20.0 * ring * np.array([np.cos(angle), np.sin(angle)])
            point = point + center + (np.array(push) if ring < 4 else 0.0)
            cv2.circle(crop, tuple(np.round(16 * point).astype(int)), 16 * 5, 255, -1, cv2.LINE_AA, 4)
    return crop


def square(crop: np.ndarray, side: int = SIDE) -> np.ndarray:
    return cv2.resize(crop, (side, side), interpolation=cv2.INTER_AREA)


def augmenter(images: np.ndarray, **settings) -> Augmenter:
    given = AugmentationSettings(**{"symmetry": 6, **settings})
    return Augmenter(images, np.arange(len(images), dtype=float), SHAPE, given)


def test_center_of_the_markers_is_found_in_the_images():
    images = np.stack([square(rings())] * 4)
    (pattern, *_) = patterns_at_rest(images, np.arange(4.0))
    center, correlation = find_center(pattern, GEOMETRY, order=6, radius=200.0)
    np.testing.assert_allclose(center, CENTER, atol=0.5)
    assert correlation > 0.95


def test_images_without_the_symmetry_are_refused():
    crop = rings()
    crop[:, : SHAPE[1] // 2] = 0
    with pytest.raises(AugmentationError, match="do not look the same after a turn"):
        augmenter(np.stack([square(crop)] * 2))


@pytest.mark.parametrize("level", [0, 90])
def test_images_that_show_nothing_are_refused(level):
    with pytest.raises(AugmentationError, match="do not look the same after a turn"):
        augmenter(np.full((4, SIDE, SIDE), level, np.uint8))


def test_an_image_without_contact_shows_the_markers_where_no_contact_does():
    pressed = rings()
    pressed[:, : SHAPE[1] // 2] = 0
    images, rest = np.stack([square(pressed)] * 4), square(rings())
    with pytest.raises(AugmentationError, match="do not look the same after a turn"):
        augmenter(images)
    given = Augmenter(images, np.arange(4.0), SHAPE, AugmentationSettings(symmetry=6), rest=rest)
    np.testing.assert_allclose(given.center, CENTER, atol=0.5)


@pytest.mark.parametrize("k", range(6))
def test_a_turned_image_is_that_of_the_turned_contact(k):
    """The markers pushed in one direction, turned, against the markers pushed in the turned direction."""
    push, angle = np.array([9.0, 4.0]), k * np.pi / 3
    turned_push = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ push
    images = np.stack([square(rings(push=tuple(push)))])
    turned = augmenter(images, symmetry_center=CENTER.tolist()).turned(images[0], k)
    expected = square(rings(push=tuple(turned_push)))
    small = [square(image, 64).astype(float) for image in (turned, expected)]
    assert np.corrcoef(small[0].ravel(), small[1].ravel())[0, 1] > 0.99
    unturned = square(images[0], 64).astype(float)
    assert k == 0 or np.corrcoef(small[1].ravel(), unturned.ravel())[0, 1] < 0.97


def test_what_is_outside_of_the_disk_does_not_turn():
    crop = rings()
    crop[5:25, 5:60] = 255
    turned = augmenter(np.stack([square(crop)] * 2), symmetry_center=CENTER.tolist()).turned(square(crop), 2)
    outside = ~GEOMETRY.disk(CENTER, 209.0)
    np.testing.assert_array_equal(turned[outside], square(crop)[outside])


@pytest.mark.parametrize("sense", [1, -1])
def test_labels_turn_as_poses_conjugated_by_a_turn_about_the_axis(sense):
    start = (1.5, -2.0, 0.02, -0.03)
    axis = SymmetryAxis(start, order=6, sense=sense)
    rng = np.random.default_rng(0)
    labels = rng.normal(size=(12, 6)) * [2, 2, 1, 0.2, 0.2, 0.05]
    turns = np.arange(12) % 6
    with torch.no_grad():
        answer = axis(torch.tensor(labels, dtype=torch.float32), torch.from_numpy(turns)).numpy()
    place = expm(hat(np.array([*start[:2], 0, 0, 0, 0]))) @ expm(hat(np.array([0, 0, 0, *start[2:], 0])))
    for label, turn, found in zip(labels, turns, answer, strict=True):
        about_z = expm(hat(np.array([0, 0, 0, 0, 0, sense * turn * np.pi / 3])))
        move = place @ about_z @ np.linalg.inv(place)
        expected = vee(logm(move @ expm(hat(label)) @ np.linalg.inv(move)).real)
        np.testing.assert_allclose(found, expected, atol=2e-5)


def reflected(direction: float) -> np.ndarray:
    """(4, 4) mirror at the plane through z and this direction, by its normal (Householder)."""
    normal = np.array([-np.sin(direction), np.cos(direction), 0.0])
    mirror = np.eye(4)
    mirror[:3, :3] -= 2.0 * np.outer(normal, normal)
    return mirror


def test_mirrored_labels_are_poses_conjugated_by_a_reflection():
    start, direction = (1.5, -2.0, 0.02, -0.03), 0.4
    axis = SymmetryAxis(start, order=6, sense=1, mirror=direction)
    rng = np.random.default_rng(0)
    labels = rng.normal(size=(6, 9)) * [2, 2, 1, 0.2, 0.2, 0.05, 3, 3, 9]
    turns = 6 + np.arange(6)
    with torch.no_grad():
        answer = axis(torch.tensor(labels, dtype=torch.float32), torch.from_numpy(turns)).numpy()
    place = expm(hat(np.array([*start[:2], 0, 0, 0, 0]))) @ expm(hat(np.array([0, 0, 0, *start[2:], 0])))
    for label, turn, found in zip(labels, turns, answer, strict=True):
        about_z = expm(hat(np.array([0, 0, 0, 0, 0, (turn - 6) * np.pi / 3])))
        move = place @ reflected(direction) @ about_z @ np.linalg.inv(place)
        expected = vee(logm(move @ expm(hat(label[:6])) @ np.linalg.inv(move)).real)
        np.testing.assert_allclose(found[:6], expected, atol=2e-5)
        np.testing.assert_allclose(found[6:], move[:3, :3] @ label[6:], atol=1e-5)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_frame_of_an_edge_goes_along_with_the_turn(mirrored):
    """X_sf' = S X_sf, and a mirrored frame is right-handed by an x-axis the other way."""
    start, direction = (1.5, -2.0, 0.02, -0.03), 0.4
    axis = SymmetryAxis(start, 6, 1, direction, directed=True)
    rng = np.random.default_rng(0)
    labels = rng.normal(size=(6, 6)) * [2, 2, 1, 0.2, 0.2, 1.5]
    turns = np.arange(6) + 6 * mirrored
    with torch.no_grad():
        answer = axis(torch.tensor(labels, dtype=torch.float32), torch.from_numpy(turns)).numpy()
    place = expm(hat(np.array([*start[:2], 0, 0, 0, 0]))) @ expm(hat(np.array([0, 0, 0, *start[2:], 0])))
    mirror, frame = (reflected(direction), np.diag([-1.0, 1, 1, 1])) if mirrored else (np.eye(4),) * 2
    for label, turn, found in zip(labels, turns, answer, strict=True):
        about_z = expm(hat(np.array([0, 0, 0, 0, 0, (turn % 6) * np.pi / 3])))
        move = place @ mirror @ about_z @ np.linalg.inv(place)
        expected = frame @ se3.pose_from_euler(label) @ np.linalg.inv(move)
        np.testing.assert_allclose(se3.pose_from_euler(found.astype(float)), expected, atol=2e-5)


def test_what_an_edge_lacks_labels_of_stays_unknown():
    axis = SymmetryAxis((0.0,) * 4, 6, 1, directed=True)
    unknown = float("nan")
    label = torch.tensor([[unknown, 1.0, 2.0, unknown, unknown, 0.5]])
    moved = axis(label, torch.tensor([1])).detach().numpy()[0]
    np.testing.assert_allclose(moved, [np.nan, 1.0, 2.0, np.nan, np.nan, 0.5 - np.pi / 3], atol=1e-6)


def test_a_mirror_is_found_in_rings_that_have_one():
    """Straight rings are the same in a mirror at their own direction, twisted ones in none."""
    depth, turned_by = np.arange(2.0), 0.2
    (pattern, *_) = patterns_at_rest(np.stack([square(rings(twist=0.0, by=turned_by))] * 2), depth)
    direction, correlation = find_mirror(pattern, GEOMETRY, CENTER, 6, 200.0)
    assert correlation > 0.95
    np.testing.assert_allclose((direction - turned_by + np.pi / 12) % (np.pi / 6), np.pi / 12, atol=0.01)
    twisted = np.stack([square(rings())] * 2)
    with pytest.raises(AugmentationError, match="the same in any mirror"):
        augmenter(twisted, symmetry_center=CENTER.tolist(), mirror=True)


def test_images_tell_in_which_direction_they_are_mirrored():
    """A camera that stands turned by 0.5 rad sees shear in its own direction."""
    rng, camera = np.random.default_rng(1), 0.5
    shear = rng.uniform(-4.0, 4.0, (60, 2))
    c, s = np.cos(camera), np.sin(camera)
    seen = 2.0 * shear @ np.array([[c, s], [-s, c]]).T  # by a camera whose x lies at 0.5 in {s}
    images = np.stack([square(rings(push=tuple(each), twist=0.0)) for each in seen])
    labels = np.zeros((60, 6))
    labels[:, :2] = shear
    labels[:, 2:] = 1e-3 * rng.normal(size=(60, 4))
    given = augmenter(images, symmetry_center=CENTER.tolist(), mirror=True)
    (c, s), _ = given.copies[6]
    mirror = 0.5 * np.arctan2(s, c)
    direction = given.axis(images, labels, directed=False).parameters_of_axis()[4]
    np.testing.assert_allclose((direction - camera - mirror + 1.0) % np.pi, 1.0, atol=0.05)


def test_labels_of_images_that_did_not_turn_stay_the_same_bits():
    labels = torch.randn(5, 6)
    axis = SymmetryAxis((1.0, 2.0, 0.1, 0.1), 6, 1)
    torch.testing.assert_close(axis(labels, torch.zeros(5, dtype=torch.int64)), labels, rtol=0, atol=0)


def test_axis_is_learned_from_labels_that_turn_about_another_one():
    truth, axis = SymmetryAxis((2.5, -1.0, 0.01, 0.02), 6, 1), SymmetryAxis((0.0,) * 4, 6, 1)
    torch.manual_seed(0)
    optimizer = torch.optim.Adam(axis.parameters(), lr=0.05)
    labels = torch.randn(200, 6) * torch.tensor([2.0, 2, 1, 0.2, 0.2, 0.05])
    turns = torch.arange(200) % 6
    expected = truth(labels, turns).detach()
    for _ in range(300):
        loss = (((axis(labels, turns) - expected) / labels.std(dim=0)) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    np.testing.assert_allclose(axis.parameters_of_axis(), (2.5, -1.0, 0.01, 0.02), atol=2e-3)


def test_batches_hold_the_turns_of_their_samples_and_repeat_with_the_seed():
    images = np.stack([square(rings(push=(2.0 * n, 0.0))) for n in range(4)])
    make = augmenter(images, symmetry_center=CENTER.tolist())
    chosen = np.array([3, 0, 0, 2])
    batch, turns = make(images[chosen], np.random.default_rng(1))
    assert batch.shape == (4, 128, 128) and turns.shape == (4,)
    for image, index, k in zip(batch, chosen, turns, strict=True):
        np.testing.assert_array_equal(image, square(make.turned(images[index], k), 128))
    again, _ = make(images[chosen], np.random.default_rng(1))
    np.testing.assert_array_equal(batch, again)


def test_marker_dropout_paints_over_whole_markers():
    image = square(rings())
    count = cv2.connectedComponents((image > 127).astype(np.uint8))[0] - 1
    left = without_markers(image, 0.2, np.random.default_rng(0))
    remaining = cv2.connectedComponents((left > 127).astype(np.uint8))[0] - 1
    assert 0.7 * count < remaining < 0.9 * count
    assert set(np.unique(left[left != image])) <= {0}


def test_small_changes_shift_and_grow_the_markers():
    image = square(rings())[np.newaxis]
    shifted, _ = augmenter(image, symmetry=1, shift=6.0)(image, np.random.default_rng(2))
    assert abs(int(shifted.astype(int).sum()) - int(square(image[0], 128).astype(int).sum())) < 2e4
    assert np.abs(shifted[0].astype(int) - square(image[0], 128)).mean() > 5.0
    make = augmenter(image, symmetry=1, growth=1.0)
    sums = [make(image, np.random.default_rng(seed))[0].mean() for seed in range(6)]
    plain = square(image[0], 128).mean()
    assert min(sums) < 0.8 * plain and max(sums) > 1.2 * plain


def test_a_center_is_two_numbers_or_none():
    with pytest.raises(SettingError, match=r"must be \[\] or \[x, y\]"):
        AugmentationSettings(symmetry_center=(1.0, 2.0, 3.0))
    assert not AugmentationSettings().active and AugmentationSettings(symmetry=6).active


@pytest.mark.parametrize("dark", [0.0, 128.0])
def test_brightness_is_changed_by_a_factor_about_what_no_light_changes(dark):
    """In color, too: each image by one factor, whose logarithm deviates as is said."""
    image = np.full((1, 64, 64, 3), (dark + 20, dark + 40, dark + 60), np.uint8)
    given = AugmentationSettings(gain=0.2)
    make = Augmenter(image, np.zeros(1), (64, 64), given, dark)
    batch, _ = make(image.repeat(400, axis=0), np.random.default_rng(0))
    assert batch.shape == (400, 32, 32, 3)
    factors = (batch[:, 5, 5].astype(float) - dark) / [20.0, 40.0, 60.0]
    assert np.abs(factors[:, 2] - factors[:, 1]).max() < 0.05
    assert np.log(factors[:, 2]).std() == pytest.approx(0.2, rel=0.1)
    assert given.active
