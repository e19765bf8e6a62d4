"""Images that cannot show the sensor: cameras that lie are refused, contacts at the edges are not."""

import cv2
import numpy as np
import pytest

from tactile_doubles.lying_camera import LYING_CAMERAS
from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator, shipped_model
from tactile_perception.estimating.image_check import SIDE, ImageCheck, ImageCheckSettings, ImageRefused
from tactile_perception.estimating.layout import Layout, LayoutError
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_perception.estimating.stillness import FRAMES
from tactile_scene.shapes.plane import Plane
from tactile_sim.tactip import TacTip

pytestmark = pytest.mark.skipif(
    not shipped_model().is_file(), reason="the shipped model is not there: `make model` trains it"
)
PERIOD_NS = 16_666_667
#: When a lie that begins in a contact is known: by the first image, and by what is said of it.
KNOWN = {
    "mirrored": "another picture at once",
    "upside_down": "another picture at once",
    "turned_180": "another picture at once",
    "turned_90": "another picture at once",
    "shifted": "no image of the sensor",
    "frozen": "repeated",
    "replayed": "repeated",
    "noise": "no image of the sensor",
    "black": "without contrast",
    "grey": "without contrast",
    "patch": "no image of the sensor",
    "glare": "no image of the sensor",
    "defocused": "no image of the sensor",
}


class Pressed:
    """A sensor over a plane, and what is made of its images, one a period."""

    def __init__(self, check: ImageCheck | None = None) -> None:
        self.sensor, self.stamp_ns = TacTip(seed=5), 0
        self.perceive = Perceiver(Estimator(), ContactPresence(PresenceSettings(reference_frames=4)), check)

    def reference(self, camera=lambda image: image):
        return [self.see(camera) for _ in range(4)][-1]

    def see(self, camera=lambda image: image, after: int = 1):
        self.stamp_ns += after * PERIOD_NS
        return self.perceive(camera(self.sensor.image()), stamp_ns=self.stamp_ns)

    def at(self, depth_mm: float, x_mm: float = 0.0, tilt_deg: float = 0.0) -> None:
        height = 0.020 - depth_mm * 1e-3
        pose = [x_mm * 1e-3, 0.0, height, np.pi + np.radians(tilt_deg), 0.0, 0.0]
        self.sensor.advance(Plane(), se3.pose_from_euler(pose))

    def press(self, depth_mm: float, tilt_deg: float = 0.0) -> None:
        """At 10 mm/s from the air."""
        for depth in np.append(np.arange(-0.5, depth_mm, 1 / 6), depth_mm):
            self.at(depth, tilt_deg=tilt_deg)
            self.see()


@pytest.fixture(scope="module")
def pressed():
    sensor = Pressed()
    sensor.reference()
    sensor.press(3.0)
    return sensor


@pytest.mark.parametrize("kind", KNOWN)
def test_a_camera_that_lies_in_a_contact_is_known_by_its_first_image_and_the_next_true_one_is_taken(
    pressed, kind
):
    camera = LYING_CAMERAS[kind](seed=1)
    truth = pressed.sensor.image()
    pressed.stamp_ns += PERIOD_NS
    pressed.perceive(truth, stamp_ns=pressed.stamp_ns)
    camera.see(truth)
    for _ in range(5):
        with pytest.raises(ImageRefused) as caught:
            pressed.see(camera)
        assert caught.value.kind == KNOWN[kind]
    assert pressed.see().in_contact


@pytest.mark.parametrize(
    "kind", ["mirrored", "upside_down", "turned_180", "turned_90", "shifted", "noise", "patch"]
)
def test_a_camera_that_lies_in_the_air_is_known_by_its_first_image(kind):
    sensor = Pressed()
    sensor.reference()
    assert sensor.see().in_contact is False
    with pytest.raises(ImageRefused):
        sensor.see(LYING_CAMERAS[kind](seed=1))
    assert sensor.see().in_contact is False


@pytest.mark.parametrize("kind", ["mirrored", "upside_down", "turned_180", "turned_90"])
def test_a_camera_that_is_mirrored_or_turned_from_the_start_gives_no_reference(kind):
    camera = LYING_CAMERAS[kind]()
    percept = Pressed().reference(camera)
    assert percept.in_contact is None
    assert percept.fault.startswith("the picture is ") and "what the model was trained on" in percept.fault
    assert Pressed().reference().fault == ""


@pytest.mark.parametrize("degrees", [-12.0, -5.0, -1.0, 1.0, 5.0, 12.0])
def test_a_camera_that_has_come_loose_gives_no_reference_and_is_told_by_how_much_it_turned(degrees):
    """OpenCV turns counter-clockwise by positive angles. A turn of one degree is as good as none."""

    def camera(image):
        rows, columns = image.shape
        x0, y0, x1, y1 = PreprocessingSettings().bbox
        matrix = cv2.getRotationMatrix2D(((x0 + x1 - 1) / 2, (y0 + y1 - 1) / 2), degrees, 1.0)
        return cv2.warpAffine(image, matrix, (columns, rows))

    fault = Pressed().reference(camera).fault
    if abs(degrees) < 3.0:
        assert fault == ""
    else:
        sense = "counter-clockwise" if degrees > 0.0 else "clockwise"
        assert f"the picture is turned {sense} by {abs(degrees):g} degrees: as such" in fault


@pytest.mark.parametrize("kind", ["mirrored", "upside_down", "turned_180"])
def test_so_is_one_that_sends_a_mirrored_crop(kind):
    x0, y0, x1, y1 = PreprocessingSettings().bbox
    camera = LYING_CAMERAS[kind]()
    assert Pressed().reference(lambda image: camera(image[y0:y1, x0:x1])).fault.startswith("the picture is ")
    assert Pressed().reference(lambda image: image[y0:y1, x0:x1]).fault == ""


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_presses_to_6_mm_and_shears_of_5_mm_and_the_way_back_are_taken(tilt_deg):
    sensor = Pressed()
    sensor.reference()
    sensor.press(6.0, tilt_deg)
    for x in np.append(np.arange(0.0, 5.0, 1 / 6), 5.0):  # 10 mm/s
        sensor.at(6.0, x, tilt_deg)
        assert sensor.see().in_contact
    for depth in np.arange(6.0, -1.0, -0.5):  # 30 mm/s
        sensor.at(depth, 5.0, tilt_deg)
        sensor.see()
    assert sensor.see().in_contact is False


def test_the_retreat_before_a_camera_of_30_hz_is_taken():
    sensor = Pressed()
    sensor.reference()
    sensor.press(3.0)
    for depth in np.arange(3.0, -2.0, -1.0):  # 30 mm/s
        sensor.at(depth)
        sensor.see(after=2)
    assert sensor.see().in_contact is False


def test_a_scene_that_stands_still_before_a_camera_that_works_is_taken_and_said_to_stand_still(pressed):
    """What is wrong about it the arm's own motion says (`surface_check`)."""
    camera = LYING_CAMERAS["frozen_noisy"](seed=1)
    camera.see(pressed.sensor.image())
    settings = pressed.perceive.check.settings
    percepts = [pressed.see(camera) for _ in range(settings.still_images + FRAMES)]
    assert all(percept.in_contact for percept in percepts)
    assert not percepts[0].still and percepts[-1].still
    pressed.perceive.check.configure(ImageCheckSettings(still_change=0.0))
    assert not any(pressed.see(camera).still for _ in range(settings.still_images + FRAMES))
    pressed.perceive.check.configure(settings)


def test_each_check_can_be_switched_off():
    any_image = ImageCheckSettings(
        repeats=True, least_contrast=0.0, fewest_markers=0.0, most_markers=100.0, least_white=0.0,
        most_white=100.0, least_likeness=-1.0, least_continuity=-1.0, most_novelty=0.0,
    )  # fmt: skip
    sensor = Pressed(ImageCheck(any_image))
    sensor.reference()
    for kind in KNOWN:
        sensor.see(LYING_CAMERAS[kind](seed=1))


@pytest.mark.parametrize("size", [64, 128, 200])
def test_markers_are_counted_in_the_same_picture_whatever_the_size_of_the_networks_input(size):
    image = TacTip(seed=5).image()
    view, same = Preprocessor(PreprocessingSettings(size=size)), Preprocessor()
    view(image), same(image)
    assert np.array_equal(view.view(SIDE), same.view(SIDE))


def test_the_layout_of_a_model_is_kept_in_its_file_and_one_of_another_size_is_refused():
    layout = Estimator().metadata.layout
    assert layout is not None and layout.mean.shape == (128, 128)
    assert np.array_equal(Layout.from_text(layout.to_text(), 128).mean, layout.mean)
    for text, size in ((layout.to_text(), 64), ("no image", 128), ("", 128)):
        with pytest.raises(LayoutError, match="layout: "):
            Layout.from_text(text, size)


def test_a_layout_of_shuffled_images_is_their_mean():
    images = np.random.default_rng(0).integers(0, 256, (50, 16, 16), dtype=np.uint8)
    assert np.abs(Layout.of(images).mean - images.mean(axis=0)).max() <= 0.5
