"""Real TacTip images go through pre-processing, a short training and the estimator with no special case.

The published data are not part of the project: they are looked for in the folder named by TACTILE_REAL_DATA,
else in ../shared/data beside the repository.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from tactile_perception.datasets.dataset import open_folder, read_dataset
from tactile_perception.estimating.image_check import ImageCheck, ImageCheckSettings, ImageRefused
from tactile_perception.estimating.labels import depths, labels_from_euler, network_from_pose
from tactile_perception.estimating.layout import Layout
from tactile_perception.estimating.plain_depth import PlainDepth
from tactile_perception.estimating.preprocessing import as_input
from tactile_perception.estimating.presence import ContactPresence

DATA = Path(os.environ.get("TACTILE_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
TACTIP = DATA / "tactip_franka"
pytestmark = pytest.mark.skipif(
    not (TACTIP / "train" / "targets_images.csv").is_file(),
    reason=f"no real TacTip data at {TACTIP} (set TACTILE_REAL_DATA)",
)


@pytest.fixture(scope="module")
def sample():
    return read_dataset(TACTIP / "train", limit=400)


def test_all_rows_are_usable_and_the_malformed_file_is_named():
    source = open_folder(TACTIP / "val")
    assert len(source) == source.report.rows > 0
    assert source.report.problems == {}
    assert any("env_params.json: malformed JSON" in note for note in source.report.notes)


def test_labels_cover_the_ranges_of_the_paper(sample):
    x, y, z, alpha, beta, gamma = sample.euler_mm_deg.T
    assert np.hypot(x, y).max() <= 5.0 and np.abs(gamma).max() <= 5.0
    assert z.min() >= 0.5 and z.max() <= 6.0
    assert np.degrees(np.arccos(np.cos(np.radians(alpha)) * np.cos(np.radians(beta)))).max() <= 25.01


def test_images_are_the_networks_input_size_and_use_its_range(sample):
    assert sample.images.shape == (len(sample), 128, 128)
    assert sample.images.min() == 0 and sample.images.max() == 255
    assert 0.1 < (sample.images / 255.0).mean() < 0.4


def test_deep_contacts_stand_out_from_shallow_ones_for_contact_presence(sample):
    """The data hold no image without contact; the shallowest contacts, which differ in place, stand in."""
    depth = sample.euler_mm_deg[:, 2]
    images = sample.images.astype(np.float32) / 255.0
    presence = ContactPresence()
    presence.set_reference(images[depth < 0.9])
    scores = np.array([presence.update(image).score for image in images])
    assert np.median(scores[depth > 4.0]) > 3.0 * np.median(scores[depth < 0.9])


@pytest.mark.parametrize("name", ["tactip_franka", "cr_tactip"])
def test_the_brightness_of_images_tells_their_depth(name):
    """Fitted to every other contact, and tried on the rest."""
    data = read_dataset(DATA / name / "train", limit=2000)
    depth = depths(data.labels)
    plain = PlainDepth.fit(data.images[::2], depth[::2])
    errors = np.array([plain(as_input(image)) for image in data.images[1::2]]) - depth[1::2]
    rms = np.sqrt(np.mean(errors**2))
    print(f"{name}: {1e3 * rms:.2f} mm (RMS), of {1e3 * depth.std():.2f} mm of spread")
    assert rms == pytest.approx(plain.rms, rel=0.2) and rms < 0.0007


def shallow(images: np.ndarray, depth: np.ndarray, count: int = 20) -> np.ndarray:
    """The data hold no image without contact; the shallowest contacts stand in."""
    return images[np.argsort(depth)[:count]]


def checked(images: np.ndarray, first: np.ndarray) -> int:
    """How many of some images are refused for their markers, against a first one."""
    check = ImageCheck(ImageCheckSettings(least_likeness=-1.0, least_continuity=-1.0))
    check.capture(first)
    check.take(True)
    refused = 0
    for image in images:
        try:
            check.look(image, True)
        except ImageRefused:
            refused += 1
    return refused


def test_none_of_them_is_refused_for_its_markers_or_its_white(sample):
    first = shallow(sample.images, sample.euler_mm_deg[:, 2])[0]
    assert checked(sample.images, first) == 0
    half = sample.images[:50].copy()
    half[:, 40:88, 40:88] = 255  # a seventh of it: what is even comes out white
    assert checked(half, first) == 50


@pytest.mark.parametrize("name", ["tactip_franka/train", "cr_tactip/train"])
def test_their_layout_tells_how_the_camera_is_mounted(name, sample):
    """From the mean of contacts; the shallowest ones are asked for in place of images without contact."""
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    data = read_dataset(folder, limit=400)
    layout, settings = Layout.of(data.images), data.preprocessing
    images = shallow(data.images, data.euler_mm_deg[:, 2])
    assert [layout.objection(image, settings) for image in images] == [""] * len(images)
    for turned in (images[:, :, ::-1], images[:, ::-1], images[:, ::-1, ::-1], np.rot90(images, axes=(1, 2))):
        assert all(layout.objection(image, settings).startswith("the picture is ") for image in turned)


def test_a_short_training_on_them_gives_a_working_estimator(tmp_path):
    pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
    pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")
    from tactile_perception.estimating.estimator import Estimator
    from tactile_perception.training.settings import NetworkSettings, TrainingSettings
    from tactile_perception.training.train import TrainConfig, train

    config = TrainConfig(
        NetworkSettings(image_size=64, channels=(8, 16, 32, 64), batch_norm_momentum=0.1),
        TrainingSettings(batch_size=10, rise_epochs=1, hold_epochs=3, decay_epochs=4, threads=1),
    )
    validation = open_folder(TACTIP / "val")
    result = train(TACTIP / "train", tmp_path / "run", config, TACTIP / "val", limit=500)
    assert result.best.validation_loss < result.epochs[0].validation_loss
    estimator = Estimator(result.model_path)
    chosen = range(0, len(validation), 40)
    labels = labels_from_euler(validation.euler_mm_deg[chosen])
    estimates = [estimator.estimate_processed(validation.image(index)) for index in chosen]
    depth_error = np.array([network_from_pose(estimate.mean)[2] for estimate in estimates]) - labels[:, 2]
    assert np.abs(depth_error).mean() < 0.5 * labels[:, 2].std()
    assert all(np.all(np.linalg.eigvalsh(estimate.cov) > 0.0) for estimate in estimates)
