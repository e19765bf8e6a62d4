"""What a network sees, drawn at its size: its answers are those to the full image."""

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_bringup.offline_perception import network_view
from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.estimating.presence import ContactPresence
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes.plane import Plane
from tactile_scene.shapes.sphere import Sphere, SphereSettings
from tactile_sim.cell import Cell
from tactile_sim.tactip import TacTip


@pytest.fixture(scope="module")
def estimator():
    return Estimator()


def both(estimator, seed=0):
    """A sensor that draws full images, and one that draws what the network sees of them."""
    return TacTip(seed=seed), TacTip(seed=seed, view=network_view(estimator))


def press(sensor, surface, height, depth, tilts=(0.0, 0.0), shear=(0.0, 0.0)):
    for x, y, z in ((0.0, 0.0, 1e-3), (0.0, 0.0, -depth), (*shear, -depth)):
        sensor.advance(surface, se3.pose_from_euler([x, y, height + z, np.pi + tilts[0], tilts[1], 0.0]))


@pytest.fixture(scope="module")
def answers(estimator):
    """The network's means and deviations for the full image, another one, and its input drawn directly."""
    rng, rows = np.random.default_rng(3), []
    full, drawn = both(estimator)
    for number in range(24):
        sphere = Sphere(SphereSettings(radius=0.06))
        surface, height = (Plane(), 0.020) if number % 2 else (sphere, 0.080)
        contact = rng.uniform(0.5e-3, 6e-3), rng.uniform(-0.3, 0.3, 2), rng.uniform(-4e-3, 4e-3, 2)
        prepared = []
        for sensor in (full, drawn):
            sensor.reset(number)
            press(sensor, surface, height, *contact)
        prepared = [estimator.preprocessor(full.image()), estimator.preprocessor(full.image())]
        prepared.append(estimator.preprocessor.from_processed(drawn.image()))
        rows.append([estimator.predict_uncalibrated(each) for each in prepared])
    means = np.array([[mean[0] for mean, _ in row] for row in rows])
    sigmas = np.array([[np.sqrt(np.diag(cov[0])) for _, cov in row] for row in rows])
    return means, sigmas


def test_the_network_answers_as_to_the_full_image_within_a_fraction_of_what_it_states(answers):
    means, sigmas = answers
    off = (means[:, 2] - means[:, 0]) / sigmas[:, 0]
    assert np.sqrt(np.mean(off**2, axis=0)).max() < 0.35
    assert np.abs(off).max() < 1.2
    assert np.abs(np.log(sigmas[:, 2] / sigmas[:, 0])).max() < 0.1


def test_the_difference_is_like_that_between_two_images_of_one_contact(answers):
    means, _ = answers
    drawn = np.sqrt(np.mean((means[:, 2] - means[:, 0]) ** 2, axis=0))
    noise = np.sqrt(np.mean((means[:, 1] - means[:, 0]) ** 2, axis=0))
    assert (drawn < 5.0 * noise).all()


def test_there_is_no_offset_in_depth_or_angle(answers):
    means, _ = answers
    offset = (means[:, 2] - means[:, 0]).mean(axis=0)
    assert np.abs(offset[:3]).max() < 0.04  # mm
    assert np.abs(offset[3:]).max() < 0.002  # rad


def test_contact_presence_begins_and_ends_within_a_tenth_of_a_millimetre_of_where_it_does_in_full_images(
    estimator,
):
    found = []
    for sensor, prepare in zip(
        both(estimator), (estimator.preprocessor, estimator.preprocessor.from_processed), strict=True
    ):
        presence, seen = ContactPresence(), []
        depths = [-1e-3] * 10 + list(np.arange(-2e-4, 8e-4, 5e-5)) + list(np.arange(8e-4, -3e-4, -5e-5))
        for depth in depths:
            sensor.advance(Plane(), se3.pose_from_euler([0.0, 0.0, 0.020 - depth, np.pi, 0.0, 0.0]))
            seen.append(bool(presence.update(prepare(sensor.image())).in_contact))
        first = seen.index(True)
        found.append((depths[first], depths[first + seen[first:].index(False)]))
    assert np.abs(np.subtract(*found)).max() < 1e-4


def test_the_same_contact_gives_the_same_bits(estimator):
    view = network_view(estimator)
    images = []
    for _ in range(2):
        sensor = TacTip(view=view)
        press(sensor, Plane(), 0.020, 3e-3)
        images.append(sensor.image())
    assert images[0].shape == (128, 128) and (images[0] == images[1]).all()


def test_markers_that_are_not_where_a_camera_looks_leave_the_picture_black_or_as_it_is():
    from tactile_sim import _contact

    ground, mask = np.zeros((16, 16), np.float32), np.ones((16, 16), np.float32)
    view = (0.0, 0.0, 4.0, 4.0, 2.5, 6.6, 20.0, -4.5, 0.5)
    pictures = []
    for extra in ([], [[np.nan, 3.0, 5.0, 200.0], [1e9, -1e9, 5.0, 200.0], [30.0, 30.0, -1.0, 200.0]]):
        picture = np.empty((16, 16), np.uint8)
        discs = np.array([[20.0, 20.0, 6.0, 200.0], [62.0, 1.0, 6.0, 200.0], *extra])
        _contact.draw_input(picture, discs, ground, mask, view)
        pictures.append(picture)
    assert (pictures[0] == pictures[1]).all() and pictures[0].max() == 255


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"ground": np.zeros((16, 15), np.float32)}, "ground"),
        ({"discs": np.zeros((2, 3))}, "discs"),
        ({"view": (0.0, 0.0, 0.0, 4.0, 2.5, 6.6, 20.0, -4.5, 0.5)}, "must be above 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, wrong):
    from tactile_sim import _contact

    given = {
        "input": np.zeros((16, 16), np.uint8),
        "discs": np.zeros((2, 4)),
        "ground": np.zeros((16, 16), np.float32),
        "mask": np.zeros((16, 16), np.float32),
        "view": (0.0, 0.0, 4.0, 4.0, 2.5, 6.6, 20.0, -4.5, 0.5),
    } | change
    with pytest.raises(ValueError, match=wrong):
        _contact.draw_input(*given.values())


def test_a_network_whose_markers_are_drawn_again_is_refused(estimator):
    class Redrawing:
        path = "my.onnx"

        class metadata:
            preprocessing = PreprocessingSettings(redraw_radius=6.0)

    with pytest.raises(SettingError, match=r"my\.onnx: fidelity 'input' .* redraw_radius 0, .* use image"):
        network_view(Redrawing)


def test_a_cell_that_knows_no_network_says_what_to_choose():
    with pytest.raises(ValueError, match=r"arm 'arm': .* 'input' .* with nodes choose 'image'"):
        Cell(load_scene("plane").with_fidelity("input"))
