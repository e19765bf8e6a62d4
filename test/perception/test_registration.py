"""Networks that lay the markers back to where they rest: polynomials, turns, the second look, training."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.special import eval_jacobi

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")

from tactile_bringup.cli import main  # noqa: E402
from tactile_perception.datasets.dataset import DatasetError, open_folder, read_dataset  # noqa: E402
from tactile_perception.estimating.estimator import Estimator  # noqa: E402
from tactile_perception.estimating.model_metadata import ModelMetadata  # noqa: E402
from tactile_perception.estimating.preprocessing import PreprocessingSettings  # noqa: E402
from tactile_perception.markers.detection import detect  # noqa: E402
from tactile_perception.training.config import TrainConfig  # noqa: E402
from tactile_perception.training.data import load_data, load_start  # noqa: E402
from tactile_perception.training.export import export_onnx  # noqa: E402
from tactile_perception.training.marker_field import MarkerFields, mapped, polynomials  # noqa: E402
from tactile_perception.training.network import PoseNetwork  # noqa: E402
from tactile_perception.training.progress import TrainingProgress  # noqa: E402
from tactile_perception.training.registration import FieldTargets, Registration  # noqa: E402
from tactile_perception.training.run_folder import RunFolder  # noqa: E402
from tactile_perception.training.settings import NetworkSettings  # noqa: E402
from tactile_perception.training.symmetry import reflection, turn  # noqa: E402
from tactile_perception.training.train import train_network  # noqa: E402

ORDER = 4
SIDE, CROP = 64, (128, 160)  # pixels of the network's image; rows and columns of the crop
SETTINGS = NetworkSettings(
    image_size=SIDE, first_stride=2, channels=(4, 6), field_order=ORDER, hidden=(16, 8), head_gain=1.0
)
TRAINING = {
    "network": {
        "image_size": 64,
        "first_stride": 2,
        "channels": (8, 16, 16),
        "field_order": ORDER,
        "hidden": (32,),
        "head_gain": 1.0,
        "dropout_mean": (0.0,) * 6,
        "dropout_inverse_sigma": (0.0,) * 6,
    },
    "training": {
        "rise_epochs": 0.0,
        "hold_epochs": 0.0,
        "decay_epochs": 3.0,
        "batch_size": 4,
        "threads": 1,
        "least_steps": 150,
        "learning_rate_peak": 3e-3,
    },
    "calibration": {"min_samples": 20},
    "augmentation": {"symmetry": 6, "mirror": True, "plain_epochs": 1.0},
}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def disc(count: int, seed: int = 0) -> np.ndarray:
    """Points (count, 2) all over the unit disc."""
    rng = np.random.default_rng(seed)
    radius, azimuth = np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    return radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)


def random_fields(count: int, seed: int = 0, size: float = 2.0) -> MarkerFields:
    """Smooth ones: higher polynomials are in them less."""
    rng, number = np.random.default_rng(seed), polynomials(np.zeros((1, 2)), ORDER).shape[1]
    values = size * rng.normal(size=(count, number, 2)) / (1.0 + np.arange(number))[:, None]
    return MarkerFields(np.array([78.0, 66.0]), 60.0, values.astype(np.float32))


ALONE = np.eye(2)[None]
COPIES = np.array([flip @ turn(k * np.pi / 3) for flip in (np.eye(2), reflection(0.7)) for k in range(6)])


def placed(fields: MarkerFields, copies: np.ndarray = ALONE) -> Registration:
    base = Registration(SETTINGS, 1)
    base.place(fields, CROP, copies)
    return base.eval()


def test_polynomials_are_zernikes_by_jacobis_formula():
    points = disc(50)
    radius, azimuth = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    expected = []
    for n in range(7):
        for m in range(n % 2, n + 1, 2):
            k = (n - m) // 2
            radial = (-1) ** k * radius**m * eval_jacobi(k, m, 0, 1 - 2 * radius**2) * np.sqrt(n + 1)
            expected += (
                [radial] if m == 0 else [np.sqrt(2) * radial * f(m * azimuth) for f in (np.cos, np.sin)]
            )
    np.testing.assert_allclose(polynomials(points, 6), np.transpose(expected), atol=1e-9)
    outside = np.array([[3.0, 4.0]])
    np.testing.assert_allclose(polynomials(outside, 6), polynomials(outside / 5.0, 6), atol=1e-12)


def test_polynomials_are_orthonormal_on_the_disc():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    radius, azimuth = np.sqrt((nodes + 1) / 2), 2 * np.pi * np.arange(32) / 32  # uniform in r^2
    points = np.array([[r * np.cos(a), r * np.sin(a)] for r in radius for a in azimuth])
    values = polynomials(points, 8)
    weight = np.repeat(weights / 2, len(azimuth)) / len(azimuth)
    np.testing.assert_allclose(values.T @ (weight[:, None] * values), np.eye(values.shape[1]), atol=1e-10)


@pytest.mark.parametrize("linear", COPIES[[1, 5, 6, 10]])
def test_the_field_of_a_turned_or_mirrored_image_is_the_field_mapped_likewise(linear):
    numbers, points = random_fields(1).values[0].astype(float), disc(200, seed=1)
    back = points @ np.linalg.inv(linear).T
    expected = polynomials(back, ORDER) @ numbers @ linear.T
    found = polynomials(points, ORDER) @ (mapped(ORDER, linear) @ numbers.ravel()).reshape(-1, 2)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_modes_give_fields_back_turned_and_not_and_are_of_decreasing_size():
    fields = random_fields(100)
    base = placed(fields, COPIES)
    targets = FieldTargets(fields, base, COPIES, torch.device("cpu"))
    samples, turns = torch.arange(100), np.arange(100) % 12
    mean, modes = base.mean.double().numpy(), base.modes.double().numpy()
    found = mean + targets(samples, turns).double().numpy() @ modes.T
    expected = [
        mapped(ORDER, COPIES[k]) @ values.ravel() for k, values in zip(turns, fields.values, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=2e-3)
    spread = np.concatenate([targets(samples, np.full(100, k)).numpy() for k in range(12)]).std(axis=0)
    assert np.all(np.diff(spread) < 1e-3) and np.mean(spread**2) == pytest.approx(1.0, rel=0.05)


def test_an_image_whose_field_is_not_known_has_no_target():
    fields = random_fields(10)
    fields.values[3] = np.nan
    targets = FieldTargets(fields, placed(fields), ALONE, torch.device("cpu"))
    assert targets.known.tolist() == [0, 1, 2, *range(4, 10)]
    wanted = targets(torch.arange(10), np.zeros(10, int))
    assert torch.isnan(wanted[3]).all() and torch.isfinite(wanted[4]).all()


def spots(places: np.ndarray) -> np.ndarray:
    """Image (SIDE, SIDE) with bright spots at crop pixels (n, 2)."""
    scale = np.array([SIDE / CROP[1], SIDE / CROP[0]])
    rows, columns = np.mgrid[:SIDE, :SIDE]
    image = np.zeros((SIDE, SIDE))
    for x, y in (places + 0.5) * scale - 0.5:
        image += np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 1.2**2)
    return image.astype(np.float32)


def test_an_image_is_pulled_back_to_where_its_markers_rest():
    fields = random_fields(60, size=4.0)
    base = placed(fields)
    rest = fields.center + fields.radius * np.array([[0, 0], [0.5, 0], [-0.5, 0.2], [0.1, 0.6], [-0.2, -0.6]])
    chosen = 7
    moved = rest + polynomials((rest - fields.center) / fields.radius, ORDER) @ fields.values[chosen]
    assert np.linalg.norm(moved - rest, axis=1).max() > 4.0
    # what the first modes leave out is small here, as it is in fields of markers
    numbers = FieldTargets(fields, base, ALONE, torch.device("cpu"))(torch.tensor([chosen]), np.zeros(1, int))
    images = torch.from_numpy(np.stack([spots(moved)]))[:, None]
    back = base.pulled_back(images, numbers[:, : base.coarse_count])[0, 0].numpy()
    scale = np.array([SIDE / CROP[1], SIDE / CROP[0]])
    for x, y in (rest + 0.5) * scale - 0.5:
        near = np.round(y).astype(int) + np.arange(-3, 4), np.round(x).astype(int) + np.arange(-3, 4)
        part = back[np.ix_(*near)]
        centre = (
            np.array([(part.sum(axis=0) * near[1]).sum(), (part.sum(axis=1) * near[0]).sum()]) / part.sum()
        )
        np.testing.assert_allclose(centre, [x, y], atol=0.4)


def test_exported_model_looks_twice_as_the_network_does(tmp_path):
    torch.manual_seed(3)
    network = PoseNetwork(SETTINGS.replaced(head="full_gaussian"))
    network.base.place(random_fields(60), CROP, COPIES)
    with torch.no_grad():
        for layer in (network.base.coarse, network.base.fine, network.head):
            layer.weight.normal_()
        network(torch.rand(8, 1, SIDE, SIDE))  # running statistics
        network.start_from(torch.randn(100, 6))
    network.eval()
    metadata = ModelMetadata(PreprocessingSettings(size=SIDE), {}, {})
    estimator = Estimator(export_onnx(network, tmp_path / "m.onnx", metadata))
    coarse = np.random.default_rng(0).random((3, 1, 8, 8), dtype=np.float32)
    images = coarse.repeat(SIDE // 8, axis=2).repeat(SIDE // 8, axis=3)
    mean, covariance = estimator.predict(images)
    with torch.inference_mode():
        raw = network(torch.from_numpy(images))
    np.testing.assert_allclose(mean, network.distribution.mean(raw).numpy(), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(covariance, network.distribution.covariance(raw).numpy(), rtol=1e-2, atol=1e-3)
    assert np.ptp(mean, axis=0).min() > 0.01, "the answers depend on the image"


def generated(out, count: int, *options: str):
    """Images of a simulated TacTip, few and shallow, so that their markers can be followed."""
    given = ("--train", str(count), "--val", "0", "--seed", "1", "--jobs", "1", *options)
    narrow = ("--set", "disk_radius=1.5e-3", "--set", "cap_angle=0.15")
    assert main(["data", "generate", str(out), *given, *narrow]) == 0
    return out / "train"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return generated(tmp_path_factory.mktemp("simulated"), 80)


@pytest.fixture(scope="module")
def data(simulated):
    config = TrainConfig().merged(TRAINING).merged({"training": {"holdback": 0.25}})
    return load_data(simulated, None, config), config


def test_a_run_learns_the_field_and_leaves_a_model(data, tmp_path):
    loaded, config = data
    assert loaded.fields.known.sum() > 50
    assert any("the markers of" in line for line in loaded.report)
    losses = []

    class Reports(TrainingProgress):
        def epoch(self, epoch):
            losses.append(epoch.train_loss)

    result = train_network(loaded, RunFolder(tmp_path / "run"), config, Reports())
    assert losses[-1] < 0.7 * losses[0]
    estimator = Estimator(result.model_path)
    mean, covariance = estimator.predict(loaded.validation.images[:3, None].astype(np.float32) / 255.0)
    assert np.isfinite(mean).all() and np.linalg.eigvalsh(covariance).min() > 0.0


def test_a_network_to_start_from_keeps_its_modes_on_another_disc(data, tmp_path):
    loaded, config = data
    train_network(loaded, RunFolder(tmp_path / "first"), config, TrainingProgress())
    again = config.merged({"training": {"start": str(tmp_path / "first")}})
    shifted = dataclasses.replace(loaded.fields, center=loaded.fields.center + 5.0)
    other = dataclasses.replace(loaded, fields=shifted).started(load_start(tmp_path / "first", again.network))
    train_network(other, RunFolder(tmp_path / "second"), again, TrainingProgress())
    first, second = (RunFolder(tmp_path / name).load_best() for name in ("first", "second"))
    torch.testing.assert_close(first["base.modes"], second["base.modes"])
    assert not torch.equal(first["base.shifts"], second["base.shifts"])


def test_markers_are_where_the_simulator_says_each_sensor_from_its_own_rest(tmp_path):
    folder = generated(tmp_path, 60, "--sensors", "2", "--markers", "--sensor", "tactip_franka")
    data, told = read_dataset(folder), []
    origin = np.array(data.preprocessing.bbox[:2])
    fields = MarkerFields.of(folder, origin, 8, data.names, lambda *done: told.append(done))
    assert fields.known.all() and fields.values.shape == (60, 45, 2)
    found = []
    for k, name in enumerate(data.names):
        markers = np.load((folder / "markers" / name).with_suffix(".npy"))
        found.append(markers)
        blobs = cKDTree(detect(open_folder(folder).image(k)).centers + origin)
        inside = np.hypot(*(markers - origin - fields.center).T) < 0.9 * fields.radius
        assert np.median(blobs.query(markers[inside])[0]) < 0.5, "pixels, through the camera's variation, too"
    second = np.array([int(name[6:-4]) % 2 == 0 for name in data.names])  # image_1.png is of the first
    shallow = data.euler_mm_deg[:, 2] < 1.0
    for own in (second, ~second):
        assert np.abs(fields.values[shallow & own, 0].mean(axis=0)).max() < 2.0, "pixels from its own rest"
    lens = np.abs(np.mean([found[k][0] for k in np.flatnonzero(second)], axis=0) - found[0][0]).max()
    assert lens > 4.0, "or the sensors would not differ"


def test_images_without_the_rings_of_markers_are_refused(training_data):
    config = TrainConfig().merged(TRAINING)
    with pytest.raises(DatasetError, match=r"network\.field_order = 4: .*needs most of the 331"):
        load_data(training_data, None, config)
