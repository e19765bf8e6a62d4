"""Images without markers or in color: chain of steps, data folders, training, and what looks at images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_perception.datasets.dataset import DatasetError, DatasetWriter, open_folder, read_dataset
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.image_check import SIDE
from tactile_perception.estimating.layout import Layout
from tactile_perception.estimating.model_metadata import MetadataError, ModelMetadata
from tactile_perception.estimating.novelty import Novelty
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.plain_depth import PlainDepth
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor, as_input
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings

PLAIN = PreprocessingSettings(
    raw_width=64, raw_height=48, bbox=(8, 4, 56, 44), median=0, threshold_method="none", circle_mask_radius=0,
    size=16,
)  # fmt: skip
COLOR = PLAIN.replaced(color=True)
BT601 = np.array([0.114, 0.587, 0.299])  # of blue, green and red
RANDOM = np.random.default_rng(0)
PICTURE = RANDOM.integers(0, 256, (48, 64, 3), dtype=np.uint8)
CROP = PICTURE[4:44, 8:56]


def averages(image: np.ndarray) -> np.ndarray:
    """Means (16, 16, ...) of the fields of an image of 40 rows and 48 columns, each of 2.5 x 3 pixels."""
    fine = np.repeat(image.astype(float), 2, axis=0)
    return fine.reshape(16, 5, 16, 3, -1).mean(axis=(1, 3)).squeeze()


def test_without_a_threshold_the_input_is_the_crop_made_smaller():
    gray = PICTURE[:, :, 1]
    found = Preprocessor(PLAIN)(gray)
    assert found.shape == (1, 1, 16, 16)
    np.testing.assert_allclose(255.0 * found[0, 0], averages(CROP[:, :, 1]), atol=0.51)
    assert np.array_equal(Preprocessor(PLAIN).processed(gray), CROP[:, :, 1])


def test_colors_become_channels_in_their_order_and_a_gray_image_is_refused():
    preprocessor = Preprocessor(COLOR)
    found = preprocessor(PICTURE)
    assert found.shape == (1, 3, 16, 16)
    np.testing.assert_allclose(255.0 * np.moveaxis(found[0], 0, -1), averages(CROP), atol=0.51)
    assert np.array_equal(preprocessor.again(), found)
    view = preprocessor.view(16)
    np.testing.assert_allclose(view, averages(CROP) @ BT601, atol=1.6)
    assert preprocessor.view(SIDE).shape == (SIDE, SIDE)
    with pytest.raises(ImageError, match="must be a color image"):
        preprocessor(PICTURE[:, :, 0])
    with pytest.raises(ImageError, match="must be a gray image"):
        Preprocessor(PLAIN)(PICTURE)


def test_a_difference_is_taken_about_mid_gray_and_held_to_the_range():
    settings = COLOR.replaced(difference=3.0)
    preprocessor = Preprocessor(settings)
    with pytest.raises(ImageError, match="there is none without contact"):
        preprocessor(PICTURE)
    reference = np.full_like(CROP, 100)
    preprocessor.reference = reference
    expected = np.clip(128.0 + 3.0 * (CROP.astype(float) - reference), 0, 255)
    np.testing.assert_allclose(
        255.0 * np.moveaxis(preprocessor(PICTURE)[0], 0, -1), averages(expected), atol=1.01
    )
    assert np.array_equal(preprocessor.processed(PICTURE), CROP)  # which a folder keeps, with the reference
    with pytest.raises(ImageError, match="the one without contact"):
        preprocessor.resized(CROP[:10])


def test_a_circle_masks_every_color():
    found = Preprocessor(COLOR.replaced(circle_mask_radius=10))(np.full_like(PICTURE, 200))
    assert found[0, :, 0, 0].max() == 0.0 and found[0, :, 8, 8].min() > 0.7


def test_an_image_is_made_straight_as_opencv_does_whole_or_cropped_by_its_camera():
    camera = (60.0, 62.0, 30.0, 25.0, -0.3, 0.1, 0.001, -0.002, 0.05)
    smooth = cv2.GaussianBlur(PICTURE, (0, 0), 2.0)
    matrix = np.array([[60.0, 0.0, 30.0], [0.0, 62.0, 25.0], [0.0, 0.0, 1.0]])
    expected = cv2.undistort(smooth, matrix, np.array(camera[4:]))[4:44, 8:56]
    preprocessor = Preprocessor(COLOR.replaced(undistort=camera))
    np.testing.assert_allclose(preprocessor.processed(smooth).astype(int), expected, atol=2)
    cropped = preprocessor.processed(np.ascontiguousarray(smooth[4:44, 8:56]))
    np.testing.assert_allclose(cropped[10:30, 12:36].astype(int), expected[10:30, 12:36], atol=2)


@pytest.mark.parametrize(
    "changes, complaint",
    [
        ({"undistort": (1.0, 2.0)}, "must be \\[\\], or nine numbers"),
        ({"undistort": (0.0,) * 9}, "fx and fy above 0"),
        ({"threshold_method": "mean", "color": True}, "black and white has neither"),
        ({"threshold_method": "mean", "difference": 1.0}, "black and white has neither"),
        ({"redraw_radius": 4.0}, "markers are found after a threshold"),
    ],
)
def test_steps_that_exclude_each_other_are_refused(changes, complaint):
    with pytest.raises(SettingError, match=complaint):
        PLAIN.replaced(**changes)


def test_the_chain_is_told_in_words():
    assert COLOR.replaced(difference=2.0).steps == (
        "48x40 of 64x48, color, 2 times the difference to no contact, resize to 16x16"
    )
    assert PreprocessingSettings().steps == (
        "445x440 of 640x480, gray, median 5, threshold (mean of 61, 5), circle 230, resize to 128x128"
    )


# ---- what looks at images ----


def test_presence_sees_a_change_of_color_alone():
    """Green that rises as red falls leaves the luma as it is."""
    random = np.random.default_rng(1)
    noisy = (120.0 + random.normal(0, 1, (16, 16, 3)) for _ in range(6))
    still = [as_input(image.astype(np.uint8)) for image in noisy]
    presence = ContactPresence(PresenceSettings(window=9))
    presence.set_reference(np.array(still[:5]))
    assert presence.update(still[5]).in_contact is False
    changed = still[5].copy()
    changed[:, 1, 4:12, 4:12] += 0.1
    changed[:, 2, 4:12, 4:12] -= 0.1 * 0.587 / 0.299
    assert presence.update(changed).in_contact is True


def test_novelty_plain_depth_and_layout_take_colors():
    random = np.random.default_rng(2)
    depths = random.uniform(0.0, 5e-3, 60)
    light = 80.0 + 2e4 * depths[:, None, None, None] * np.array([1.0, 0.2, 0.0])
    images = (light + random.normal(0, 2, (60, 16, 16, 3))).astype(np.uint8)
    novelty = Novelty.from_text(Novelty.fit(images).to_text(), COLOR)
    assert max(novelty(as_input(image)) for image in images) < 1.0
    assert novelty(as_input(images[0][:, :, ::-1])) > 1.0  # red for blue
    with pytest.raises(ValueError, match="must be"):
        Novelty.from_text(Novelty.fit(images).to_text(), COLOR.replaced(size=32))
    plain = PlainDepth.fit(images, depths)
    errors = [plain(as_input(image)) - depth for image, depth in zip(images, depths, strict=True)]
    assert np.abs(errors).max() < 1e-3
    blocks = np.random.default_rng(4).integers(0, 2, (4, 4))
    picture = np.kron(blocks, np.ones((4, 4)))[..., None] * np.array([90, 40, 200])
    layout = Layout.of(picture[None].astype(np.uint8))
    assert layout.objection(as_input(picture.astype(np.uint8)), COLOR) == ""
    assert "mirrored" in layout.objection(as_input(picture[:, ::-1].astype(np.uint8)), COLOR)


class Answers:
    """Stands for an estimator that never fails and sees no contact."""

    force = None

    def __init__(self, settings: PreprocessingSettings, reference: np.ndarray) -> None:
        self.preprocessor = Preprocessor(settings, reference)
        self.metadata = ModelMetadata(settings, {}, {}, reference=reference)

    def estimate_prepared(self, prepared):
        from tactile_geometry.gaussian import PoseGaussian

        return PoseGaussian(np.eye(4), np.eye(6))


def test_a_reference_taken_today_replaces_that_of_the_training():
    """Light that has grown since the training is no contact, and differences are to today's image."""
    random = np.random.default_rng(3)

    def exposure(level: float, pressed: float = 0.0) -> np.ndarray:
        image = level + np.linspace(-30, 30, 64)[:, None] + random.normal(0, 1, (48, 64, 3))
        image[20:30, 28:38] += pressed
        return np.clip(image, 0, 255).astype(np.uint8)

    settings = COLOR.replaced(difference=2.0)
    old = Preprocessor(COLOR).processed(exposure(90.0))
    presence = ContactPresence(PresenceSettings(reference_frames=4))
    perceiver = Perceiver(Answers(settings, old), presence)
    for _ in range(4):
        assert perceiver(exposure(105.0)).in_contact is None
    assert perceiver.estimator.preprocessor.reference.mean() == pytest.approx(105.0, abs=1.0)
    assert perceiver(exposure(105.0)).in_contact is False
    assert 255.0 * perceiver.estimator.preprocessor.again().mean() == pytest.approx(128.0, abs=3.0)
    assert perceiver(exposure(105.0, pressed=40.0)).in_contact is True


# ---- data folders and model files ----


def write(
    path, settings: PreprocessingSettings, count: int, reference: bool = True, images: str = "processed",
    gain: float = 30.0,
):  # fmt: skip
    """A folder whose images tell x, y and z by the place and brightness of a blue blob."""
    random = np.random.default_rng(count)
    rows, columns = np.mgrid[:48, :64]
    with DatasetWriter(path, settings, images) as writer:
        if reference:
            writer.add_image(0, np.full((48, 64, 3), 60, np.uint8))
        for number in range(1, count + 1):
            euler = random.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1])
            blob = np.exp(-((columns - 32 - 3 * euler[0]) ** 2 + (rows - 24 - 3 * euler[1]) ** 2) / 40.0)
            image = 60.0 + blob[:, :, None] * gain * euler[2] * np.array([1.0, 0.3, 0.0])
            writer.add(
                number, np.clip(image + random.normal(0, 1, image.shape), 0, 255).astype(np.uint8), euler
            )
        writer.finish()
    return path


@pytest.mark.parametrize("images", ["processed", "raw"])
def test_a_folder_keeps_colors_and_its_reference(tmp_path, images):
    settings = COLOR.replaced(difference=2.0)
    folder = write(tmp_path / "data", settings, 5, images=images)
    stated = None if images == "processed" else settings
    source = open_folder(folder, stated)
    assert source.preprocessing.color and source.preprocessing.difference == 2.0
    data = read_dataset(folder, stated, changes={"size": 16})
    assert data.images.shape == (5, 16, 16, 3)
    assert data.images[:, 0, 0].mean() == pytest.approx(128.0, abs=3.0)  # no change in a corner
    np.testing.assert_array_equal(data.reference, np.full((40, 48, 3), 60))


def test_a_folder_without_an_image_without_contact_says_so(tmp_path):
    folder = write(tmp_path / "data", COLOR.replaced(difference=2.0), 3, reference=False)
    with pytest.raises(DatasetError, match=r"has no processed_images/image_0\.png"):
        read_dataset(folder)


def test_a_model_file_needs_the_reference_that_it_compares_with():
    settings = COLOR.replaced(difference=2.0)
    whole = ModelMetadata(settings, {}, {}, reference=CROP)
    again = ModelMetadata.from_properties(whole.to_properties())
    np.testing.assert_array_equal(again.reference, CROP)
    lacking = {name: value for name, value in whole.to_properties().items() if name != "reference"}
    with pytest.raises(MetadataError, match="has no reference"):
        ModelMetadata.from_properties(lacking)
    with pytest.raises(MetadataError, match="unreadable metadata"):
        ModelMetadata.from_properties({**lacking, "reference": "no image"})


def test_a_network_is_trained_on_colors_quantized_and_asked(tmp_path):
    """From a folder in color to the file that an estimator opens: depth is the brightness of a blob."""
    pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
    from tactile_perception.estimating.estimator import Estimator
    from tactile_perception.training.config import TrainConfig
    from tactile_perception.training.quantization import quantize, training_images
    from tactile_perception.training.settings import AugmentationSettings, NetworkSettings, TrainingSettings
    from tactile_perception.training.train import train

    settings = COLOR.replaced(difference=2.0)
    for part, count in (("train", 120), ("val", 30)):
        write(tmp_path / "data" / part, settings, count, gain=8.0)
    config = TrainConfig(
        NetworkSettings(image_size=16, channels=(8, 16), batch_norm_momentum=0.2, head_gain=1.0),
        TrainingSettings(batch_size=8, rise_epochs=1, hold_epochs=10, decay_epochs=60, threads=1),
    )
    turned = replace(config, augmentation=AugmentationSettings(symmetry=6))
    with pytest.raises(SettingError, match="does not look the same after a turn"):
        train(tmp_path / "data", tmp_path / "turned", turned)
    train(tmp_path / "data", tmp_path / "run", config)
    model = tmp_path / "run" / "model.onnx"
    estimator = Estimator(model)
    assert estimator.metadata.preprocessing.channels == 3 and estimator.metadata.layout is None
    assert 0.1 <= estimator.metadata.novelty.light < 1.0
    small = quantize(model, training_images(tmp_path / "data", model, 40), tmp_path / "small.onnx")
    data = read_dataset(tmp_path / "data" / "val", estimator.metadata.preprocessing)
    for each in (estimator, Estimator(small)):
        errors = each.predict(as_input(data.images))[0][:, 2] - data.labels[:, 2]
        assert np.abs(errors).mean() < 0.5 * np.abs(data.labels[:, 2] - data.labels[:, 2].mean()).mean()
