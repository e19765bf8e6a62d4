"""Contact models: what is told, masked, and only known by its prior; from the loss to the model file."""

import csv
import json
import shutil

import numpy as np
import onnxruntime
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from tactile_base.settings import SettingError
from tactile_perception.datasets.dataset import DatasetError, read_dataset
from tactile_perception.estimating.contact_model import (
    CONTACT_MODELS,
    EDGE,
    SURFACE,
    SURFACE_FORCE,
    ContactModel,
    euler_gaussian,
    gaussian_from_euler,
)
from tactile_perception.estimating.estimator import Estimator, shipped_model
from tactile_perception.estimating.labels import gaussian_from_root
from tactile_perception.estimating.model_metadata import MetadataError, ModelMetadata
from tactile_perception.estimating.preprocessing import Preprocessor, as_input

POSE_ONLY = ("z", "alpha", "beta")
MASKED = SURFACE_FORCE.narrowed((*POSE_ONLY, "Fz"), "here")


def pose_fs(euler: np.ndarray) -> np.ndarray:
    """X_fs by SciPy, of mm and rad."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", euler[3:]).as_matrix()
    T[:3, 3] = euler[:3] * 1e-3
    return T


def test_the_models_are_plug_ins_with_bounds():
    assert CONTACT_MODELS.names() == ("surface", "edge", "surface_force")
    assert SURFACE.units == ("mm", "mm", "mm", "rad", "rad", "rad")
    mean, sigma = SURFACE_FORCE.prior
    assert sigma[5] == pytest.approx(np.radians(20.0) / np.sqrt(12.0))
    assert sigma[6] == pytest.approx(100.0 / np.sqrt(12.0))
    assert mean[2] == 4.0  # depth is not negative


def test_a_model_that_lacks_what_it_needs_says_what():
    with pytest.raises(
        SettingError, match="'edge' needs y, gamma, which is not labelled; labelled: z, alpha"
    ):
        EDGE.narrowed(POSE_ONLY, "data")
    with pytest.raises(SettingError, match="tells forces, and none of Fx, Fy, Fz is labelled"):
        SURFACE_FORCE.narrowed(SURFACE.labelled, "data")
    broken = ContactModel("broken", SURFACE.quantities[:5])
    assert "quantities are x, y, z, alpha, beta: must be" in next(broken.objections())


def test_a_gaussian_over_euler_components_is_that_over_the_pose():
    """Against samples: Euler poses drawn from it, and the logarithms of what they leave of the mean."""
    rng = np.random.default_rng(3)
    mean, sigma = np.array([1.0, -2.0, 3.0, 0.2, -0.3, 2.5]), np.array([2.0, 1.0, 0.1, 0.02, 0.03, 0.05])
    found = gaussian_from_euler(mean, np.diag(sigma**2))
    np.testing.assert_allclose(found.mean, np.linalg.inv(pose_fs(mean)), atol=1e-12)
    left = []
    for euler in mean + 1e-3 * sigma * rng.normal(size=(20000, 6)):
        change = np.linalg.inv(pose_fs(euler)) @ pose_fs(mean)
        left.append([*change[:3, 3], *Rotation.from_matrix(change[:3, :3]).as_rotvec()])
    sampled = 1e6 * np.cov(np.array(left).T)
    scale = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(
        found.cov / np.outer(scale, scale), sampled / np.outer(scale, scale), atol=0.03
    )
    back, cov = euler_gaussian(found)
    np.testing.assert_allclose(back, mean, atol=1e-9)
    np.testing.assert_allclose(cov, np.diag(sigma**2), atol=1e-9)


def test_a_shipped_model_from_before_is_a_surface_with_the_same_numbers():
    session = onnxruntime.InferenceSession(str(shipped_model()), providers=["CPUExecutionProvider"])
    assert "contact_model" not in session.get_modelmeta().custom_metadata_map
    estimator = Estimator()
    assert estimator.metadata.contact_model == SURFACE
    image = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    prepared = Preprocessor(estimator.metadata.preprocessing)(image)
    mu, inverse_sigma = (
        x[0].astype(np.float64) for x in session.run(["mu", "inverse_sigma"], {"image": prepared})
    )
    assert estimator.metadata.calibration.is_identity
    expected = gaussian_from_root(mu, 1.0 / inverse_sigma)
    found = estimator.estimate(image)
    assert np.array_equal(found.mean, expected.mean) and np.array_equal(found.cov, expected.cov)
    hat = np.zeros((4, 4))
    x, y, z = mu[3:]
    hat[:3, :3], hat[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], mu[:3] * 1e-3
    np.testing.assert_allclose(found.mean, expm(hat), atol=1e-9)
    assert estimator.force is None


def test_the_metadata_carries_the_model(model_metadata):
    import dataclasses

    metadata = dataclasses.replace(model_metadata(), contact_model=MASKED)
    properties = metadata.to_properties()
    assert ModelMetadata.from_properties(properties).contact_model == dataclasses.replace(
        MASKED, required=("z",)
    )
    assert json.loads(properties["components"]) == ["x", "y", "z", "alpha", "beta", "gamma", "Fx", "Fy", "Fz"]
    values = json.loads(properties["contact_model"])
    values["quantities"][0]["low"] = 9.0
    properties["contact_model"] = json.dumps(values)
    with pytest.raises(MetadataError, match="must be in mm, with low < high"):
        ModelMetadata.from_properties(properties)


# ---- training; needs PyTorch ----


@pytest.fixture(scope="module")
def torch():
    pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")
    return pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")


def network(model: ContactModel, head: str, seed: int = 0):
    """A small network with random weights in its last layer."""
    import torch

    from tactile_perception.training.network import PoseNetwork
    from tactile_perception.training.settings import NetworkSettings

    torch.manual_seed(seed)
    found = PoseNetwork(NetworkSettings(image_size=32, channels=(4, 8, 8), head=head), model)
    with torch.no_grad():
        found.head.weight.normal_(0.0, 0.05)
        found.head.bias.normal_(0.5, 0.3)
    return found


@pytest.mark.parametrize("head", ["mse", "gaussian", "full_gaussian", "mixture"])
def test_what_is_not_labelled_has_a_gradient_of_exactly_zero(torch, head):
    distribution = network(MASKED, head).distribution
    raw = torch.randn(7, distribution.outputs, requires_grad=True)
    labels = torch.randn(7, MASKED.size)
    labels[:, torch.from_numpy(~MASKED.known)] = torch.nan
    distribution.loss(labels, raw).backward()
    assert torch.isfinite(raw.grad).all()
    unknown = [k for k in range(MASKED.size) if not MASKED.known[k]]
    blocks = {"mse": 1, "mixture": 4}.get(head, 2)  # of K outputs: means, deviations
    for block in range(blocks):
        part = raw.grad[:, block * MASKED.size : (block + 1) * MASKED.size]
        assert (part[:, unknown] == 0.0).all()
        assert (part[:, MASKED.known] != 0.0).all()
    if head == "full_gaussian":
        for place, pair in enumerate(distribution.lower):
            of_known = all(MASKED.known[k] for k in pair)
            assert bool((raw.grad[:, 2 * MASKED.size + place] != 0.0).any()) is of_known


@pytest.mark.parametrize("head", ["mse", "gaussian", "full_gaussian"])
def test_the_loss_of_what_is_labelled_is_that_of_a_network_of_it_alone(torch, head):
    """The mask has no part in the value either: the loss does not see what stands in masked outputs."""
    distribution = network(MASKED, head).distribution
    raw, labels = torch.randn(7, distribution.outputs), torch.randn(7, MASKED.size)
    labels[:, torch.from_numpy(~MASKED.known)] = torch.nan
    other = raw.clone()
    for block in range(1 if head == "mse" else 2):
        other[:, block * MASKED.size + np.flatnonzero(~MASKED.known)] += 3.0
    assert distribution.loss(labels, raw) == distribution.loss(labels, other)


@pytest.mark.parametrize("head", ["mse", "gaussian", "full_gaussian", "mixture"])
@pytest.mark.parametrize(
    "model", [MASKED, EDGE.narrowed(("y", "z", "gamma"), ""), SURFACE_FORCE], ids=lambda m: m.name
)
def test_the_file_answers_as_the_network_and_with_the_prior(torch, tmp_path, model_metadata, model, head):
    import dataclasses

    from tactile_perception.training.export import export_onnx

    if head == "mixture" and model.turning:
        with pytest.raises(SettingError, match="the mean of two angles is none"):
            network(model, head)
        return
    trained = network(model, head).eval()
    images = np.random.default_rng(1).integers(0, 255, (40, 32, 32)).astype(np.uint8)
    metadata = dataclasses.replace(model_metadata(size=32), contact_model=model)
    sigma = np.linspace(0.5, 1.0, model.size)
    path = export_onnx(trained, tmp_path / "model.onnx", metadata, sigma if head == "mse" else None)
    estimator = Estimator(path)
    mean, cov = estimator.predict_uncalibrated(as_input(images))
    with torch.no_grad():
        raw = trained(torch.from_numpy(as_input(images)))
        wanted = trained.distribution.mean(raw).numpy()
    known = model.known
    np.testing.assert_allclose(mean[:, known], wanted[:, known], rtol=1e-4, atol=1e-4)
    if head != "mse":
        wanted_cov = trained.distribution.covariance(raw).numpy()[:, known][:, :, known]
        np.testing.assert_allclose(cov[:, known][:, :, known], wanted_cov, rtol=1e-3, atol=1e-4)
    prior_mean, prior_sigma = model.prior
    assert np.allclose(mean[:, ~known], prior_mean[~known], atol=1e-6)
    unknown = np.flatnonzero(~known)
    np.testing.assert_allclose(
        cov[:, unknown, unknown], np.tile(prior_sigma[~known] ** 2, (40, 1)), rtol=1e-5
    )
    assert (cov[np.ix_(range(40), unknown, np.flatnonzero(known))] == 0.0).all()
    pose, row = estimator.estimate_prepared(as_input(images[0])), mean[0]
    if not model.tangent:  # the prior's covariance lies along the components that no label fixed
        euler, euler_cov = euler_gaussian(pose)
        np.testing.assert_allclose(euler, row[:6], atol=1e-5)
        at = [k for k in unknown if k < 6]
        np.testing.assert_allclose(np.sqrt(euler_cov[at, at]), prior_sigma[at], rtol=1e-5)
    if model.forces:
        np.testing.assert_allclose(estimator.force.mean, row[6:], atol=1e-5)


@pytest.mark.parametrize("angle", [*np.radians(range(-179, 181, 45)), 0.0, np.pi, np.pi / 2, -np.pi / 2])
def test_an_angle_that_goes_all_round_is_told_by_sine_and_cosine(torch, tmp_path, model_metadata, angle):
    import dataclasses

    from tactile_perception.training.export import export_onnx

    trained = network(EDGE, "gaussian").eval()
    with torch.no_grad():
        trained.head.weight[[5, 6]] = 0.0
        trained.head.bias[[5, 6]] = 0.7 * torch.tensor([np.sin(angle), np.cos(angle)], dtype=torch.float32)
    metadata = dataclasses.replace(model_metadata(size=32), contact_model=EDGE)
    path = export_onnx(trained, tmp_path / "model.onnx", metadata)
    mean, _ = Estimator(path).predict_uncalibrated(np.zeros((1, 1, 32, 32), np.float32))
    assert abs(np.exp(1j * mean[0, 5]) - np.exp(1j * angle)) < 1e-5
    labels = torch.zeros(1, EDGE.size) + torch.nan
    labels[0, 5] = angle - 2.0 * np.pi + 0.1  # its error is 0.1, the short way round
    raw = torch.zeros(1, trained.distribution.outputs)
    raw[0, 5], raw[0, 6] = np.sin(angle), np.cos(angle)
    error, _ = trained.distribution.error(labels, trained.distribution.mean(raw))
    assert float(error[0, 5]) == pytest.approx(0.1, abs=1e-5)


def labelled_folder(path, count: int, seed: int, dots) -> None:
    """Dots that move with the contact; labelled are z, alpha, beta and a force of 2 N/mm."""
    rng = np.random.default_rng(seed)
    (path / "processed_images").mkdir(parents=True)
    import cv2

    with (path / "targets_images.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["sensor_image", "pose_z", "pose_Rx", "pose_Ry", "Fz"])
        for number in range(1, count + 1):
            euler = np.array([0, 0, *rng.uniform([0.5, -10, -10], [6, 10, 10]), 0])
            moved = np.array([euler[4] * 0.4, -euler[3] * 0.4, euler[2], 0, 0, 0])  # as a tilt moves markers
            image = cv2.resize(dots(moved, rng), (64, 64), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(path / "processed_images" / f"image_{number}.png"), image)
            force = "" if number % 10 == 0 else 2.0 * euler[2]  # some were not measured
            writer.writerow([f"image_{number}.png", *euler[2:5], force])


def test_a_data_set_with_missing_components_trains_and_its_model_says_so(torch, tmp_path, dots):
    from test_training import QUICK

    from tactile_perception.evaluation.evaluate import evaluate, load_data
    from tactile_perception.evaluation.models import open_models
    from tactile_perception.training.quantization import quantize
    from tactile_perception.training.recalibration import recalibrate
    from tactile_perception.training.train import train

    for part, count, seed in (("train", 160, 0), ("val", 60, 1)):
        labelled_folder(tmp_path / part, count, seed, dots)
    settings = QUICK.training.replaced(
        model="surface_force", holdback=0.125, rise_epochs=0, hold_epochs=4, decay_epochs=4
    )
    calibration = QUICK.calibration.replaced(min_samples=20)
    config = type(QUICK)(
        QUICK.network.replaced(head="full_gaussian"), settings, QUICK.augmentation, calibration
    )
    result = train(tmp_path, tmp_path / "run", config)
    assert result.epochs[-1].train_loss < result.epochs[0].train_loss - 0.5
    metadata = Estimator(result.model_path).metadata
    assert metadata.contact_model.labelled == ("z", "alpha", "beta", "Fz")
    assert set(metadata.validation["mae"]) == {"z", "alpha", "beta", "Fz"}
    assert (
        "not labelled, so that only bounds are known: x (-5 to 5 mm)"
        in (tmp_path / "run/data.txt").read_text()
    )

    models = open_models([result.model_path])
    data = load_data(tmp_path / "val", models)
    assert "not compared, since not labelled here or in training: x, y, gamma, Fx, Fy" in data.notes
    (found,) = evaluate(data, models)
    assert found.names == ("z", "alpha", "beta", "Fz")
    assert np.isnan(found.accuracy.euler_mae[[0, 1, 5]]).all()
    assert found.accuracy.mae[0] < 1.2 and found.accuracy.mae[3] < 2.5  # guessing the mean: 1.4 mm, 2.8 N
    assert found.calibrated is not None and found.calibrated.consistency.coverage.shape == (4, 4)

    shutil.copytree(tmp_path / "val", tmp_path / "unmeasured")
    table = tmp_path / "unmeasured" / "targets_images.csv"
    head, *rows = table.read_text().splitlines()
    place = head.split(",").index("Fz")
    cells = [row.split(",") for row in rows]
    emptied = [",".join([*row[:place], "", *row[place + 1 :]]) for row in cells]
    table.write_text("\n".join([head, *emptied]) + "\n")
    with pytest.raises(DatasetError, match="no sample has all of the labels z, alpha, beta, Fz"):
        load_data(tmp_path / "unmeasured", models)

    images = read_dataset(tmp_path / "train", metadata.preprocessing, complete=False).images
    small = quantize(result.model_path, images, tmp_path / "small.onnx")
    assert Estimator(small).metadata.contact_model == metadata.contact_model
    fitted, own = recalibrate(
        result.model_path, tmp_path / "val", tmp_path / "again.onnx", {"min_samples": 20}
    )
    assert not own and fitted.size == 9


def test_turning_a_contact_needs_all_of_its_label(torch, tmp_path, dots):
    from test_training import QUICK

    from tactile_perception.training.train import train

    for part, count, seed in (("train", 12, 0), ("val", 8, 1)):
        labelled_folder(tmp_path / part, count, seed, dots)
    config = QUICK.replaced(augmentation__symmetry=6)
    with pytest.raises(SettingError, match=r"symmetry = 6: .*x, y, gamma not labelled.*symmetry=1"):
        train(tmp_path, tmp_path / "run", config)
