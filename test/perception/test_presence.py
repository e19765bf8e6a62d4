"""Contact presence on simulated images and under noise."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings, largest_change
from tactile_scene.shapes.plane import Plane
from tactile_sim.tactip import TacTip


def pressed(sensor: TacTip, depth_mm: float, tilt_deg: float = 0.0) -> None:
    """Press the sensor at rest into a plane, straight down."""
    sensor.reset()
    T = se3.pose_from_euler([0, 0, 0, np.pi + np.radians(tilt_deg), 0, 0])
    for height in (0.0205, 0.020 - depth_mm * 1e-3):
        T = T.copy()
        T[2, 3] = height
        sensor.advance(Plane(), T)


@pytest.fixture(scope="module")
def sensor() -> TacTip:
    return TacTip(seed=3)


@pytest.fixture(scope="module")
def preprocessor() -> Preprocessor:
    return Preprocessor()


@pytest.fixture
def presence(sensor, preprocessor) -> ContactPresence:
    """With its reference captured."""
    presence = ContactPresence()
    sensor.reset(seed=4)
    for _ in range(presence.settings.reference_frames):
        presence.update(preprocessor(sensor.image()))
    return presence


def test_first_frames_make_the_reference(sensor, preprocessor):
    presence = ContactPresence(PresenceSettings(reference_frames=3))
    sensor.reset()
    answers = [presence.update(preprocessor(sensor.image())) for _ in range(4)]
    assert [answer.in_contact for answer in answers] == [None, None, None, False]
    assert np.isnan(answers[0].score) and answers[3].score < 0.01


def test_noise_is_no_contact(presence, sensor, preprocessor):
    sensor.reset(seed=9)
    assert not any(presence.update(preprocessor(sensor.image())).in_contact for _ in range(60))


@pytest.mark.parametrize("depth_mm", [0.3, 0.5, 3.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 12.0, 24.0])
def test_shallow_and_deep_contacts_are_seen_wherever_they_are(
    presence, sensor, preprocessor, depth_mm, tilt_deg
):
    pressed(sensor, depth_mm, tilt_deg)
    assert presence.update(preprocessor(sensor.image())).in_contact


@pytest.mark.parametrize("side", [64, 96, 256])
def test_scores_hardly_depend_on_the_size_of_the_images(sensor, preprocessor, side):
    other = Preprocessor(PreprocessingSettings(size=side))
    judges = [(preprocessor, ContactPresence()), (other, ContactPresence())]
    sensor.reset(seed=4)
    for _ in range(10):
        image = sensor.image()
        for prepare, presence in judges:
            presence.update(prepare(image))
    sensor.reset(seed=9)
    for _ in range(20):
        image = sensor.image()
        assert not any(presence.update(prepare(image)).in_contact for prepare, presence in judges)
    for depth_mm in (0.4, 1.0, 3.0):
        pressed(sensor, depth_mm)
        image = sensor.image()
        expected, answer = (presence.update(prepare(image)) for prepare, presence in judges)
        assert answer.in_contact
        assert answer.score == pytest.approx(expected.score, rel=0.35)


def test_score_grows_with_depth(presence, sensor, preprocessor):
    scores = []
    for depth_mm in (0.1, 0.3, 0.6, 1.2, 2.4):
        pressed(sensor, depth_mm)
        scores.append(presence.update(preprocessor(sensor.image())).score)
    assert np.all(np.diff(scores) > 0.0)


def test_a_change_of_light_is_no_contact(presence, sensor, preprocessor):
    sensor.reset(seed=11)
    brighter = np.clip(sensor.image().astype(int) + 15, 0, 255).astype(np.uint8)
    assert not presence.update(preprocessor(brighter)).in_contact


def test_contact_ends_only_below_the_lower_threshold():
    settings = PresenceSettings(on=0.5, off=0.2, window=1)
    presence = ContactPresence(settings)
    presence.set_reference(np.zeros((3, 8, 8), np.float32))
    levels = [0.4, 0.6, 0.3, 0.1, 0.3]
    answers = [presence.update(np.full((8, 8), level, np.float32)).in_contact for level in levels]
    assert answers == [False, True, True, False, False]


def test_thresholds_stay_clear_of_a_noisy_sensor():
    rng = np.random.default_rng(0)
    presence = ContactPresence(PresenceSettings(on=0.001, off=0.001))
    presence.set_reference(rng.uniform(0.0, 1.0, (20, 128, 128)).astype(np.float32))
    frames = rng.uniform(0.0, 1.0, (100, 128, 128)).astype(np.float32)
    assert sum(bool(presence.update(frame).in_contact) for frame in frames) <= 1


def test_off_above_on_is_refused():
    with pytest.raises(SettingError, match=r"off = 0\.5: must not be above on = 0\.4"):
        PresenceSettings(on=0.4, off=0.5)


def test_one_image_is_no_reference():
    with pytest.raises(ValueError, match="at least two images"):
        ContactPresence().set_reference(np.zeros((1, 128, 128)))


def test_an_image_of_another_size_is_refused():
    presence = ContactPresence()
    presence.set_reference(np.zeros((2, 128, 128)))
    with pytest.raises(ValueError, match="the reference"):
        presence.update(np.zeros((64, 64), np.float32))


def test_a_new_window_needs_a_new_reference_and_new_thresholds_do_not(presence):
    presence.configure(PresenceSettings(on=0.2, off=0.1))
    assert presence.ready
    presence.configure(PresenceSettings(window=9))
    assert not presence.ready


@pytest.mark.parametrize("window", [1, 2, 16, 17, 128, 129])
@pytest.mark.parametrize("shape", [(128, 128), (64, 64), (1, 7), (33, 5)])
def test_change_is_the_largest_mean_over_a_window(window, shape):
    rng = np.random.default_rng(window)
    image, reference = rng.random((2, *shape), dtype=np.float32)
    noise = 0.3 * rng.random(shape, dtype=np.float32)
    excess = np.maximum(np.abs(image - reference) - noise, 0.0).astype(np.float64)
    expected = uniform_filter(excess, window, mode="mirror").max()
    assert largest_change(image, reference, noise, window) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("value", [7.0, -7.0, 1e30, np.inf, np.nan, -np.nan])
def test_what_is_no_image_is_a_full_change(value):
    """Numbers that a prepared image never has must not overflow the sums."""
    image, nothing = np.full((128, 128), value, np.float32), np.zeros((128, 128), np.float32)
    assert largest_change(image, nothing, nothing, 129) == pytest.approx(1.0, abs=1e-5)


def taken(presence, preprocessor, sensor) -> str:
    """Capture a reference; why it was refused."""
    answers = [
        presence.update(preprocessor(sensor.image())) for _ in range(presence.settings.reference_frames)
    ]
    assert all(answer.in_contact is None for answer in answers)
    return answers[-1].refused


def test_a_reference_that_shows_contact_is_refused_and_the_last_one_stays(presence, sensor, preprocessor):
    pressed(sensor, 3.1)
    presence.capture()
    assert not presence.ready
    assert "its change against the last one is " in taken(presence, preprocessor, sensor)
    assert presence.ready and presence.update(preprocessor(sensor.image())).in_contact
    sensor.reset()
    presence.capture()
    assert taken(presence, preprocessor, sensor) == ""
    assert not presence.update(preprocessor(sensor.image())).in_contact


def test_who_asks_for_a_new_reference_gets_it_however_different(presence, sensor, preprocessor):
    pressed(sensor, 3.1)
    presence.capture(compare=False)
    assert taken(presence, preprocessor, sensor) == ""
    assert not presence.update(preprocessor(sensor.image())).in_contact


def test_without_a_reference_before_images_are_captured_until_there_is_no_objection(sensor, preprocessor):
    presence, objections = ContactPresence(), ["touched", "touched", ""]
    presence.objection = lambda prepared: objections.pop(0)
    sensor.reset()
    assert [taken(presence, preprocessor, sensor) for _ in range(3)] == ["touched", "touched", ""]
    assert presence.ready
