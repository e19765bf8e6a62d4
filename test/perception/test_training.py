"""Training, its schedule and its export. Needs PyTorch."""

import argparse
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")

from tactile_perception import commands  # noqa: E402
from tactile_perception.dataset import DatasetError, DatasetWriter  # noqa: E402
from tactile_perception.estimator import Estimator  # noqa: E402
from tactile_perception.labels import labels_from_euler, network_from_pose  # noqa: E402
from tactile_perception.model_metadata import ModelMetadata  # noqa: E402
from tactile_perception.preprocessing import PreprocessingSettings  # noqa: E402
from tactile_perception.softbound import softbound as softbound_numpy  # noqa: E402
from tactile_perception.training.export import export_onnx  # noqa: E402
from tactile_perception.training.gdn import Gdn, MultiDropoutLinear, mean_nll, softbound  # noqa: E402
from tactile_perception.training.settings import GdnSettings, TrainingSettings, learning_rate  # noqa: E402
from tactile_perception.training.train import TrainConfig, train  # noqa: E402

QUICK = TrainConfig(
    GdnSettings(image_size=64, channels=(8, 16, 32, 32), batch_norm_momentum=0.2, head_gain=1.0),
    TrainingSettings(batch_size=8, rise_epochs=1, hold_epochs=5, decay_epochs=8, seed=3, threads=1),
)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def dot_image(euler: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A camera image whose one large blob tells x, y (place) and z (size)."""
    rows, columns = np.mgrid[:480, :640]
    distance = np.hypot(columns - 327 - 15 * euler[0], rows - 240 - 15 * euler[1])
    image = 40.0 + 160.0 * (distance < 20 + 12 * euler[2])
    grid = (rows % 24 < 6) & (columns % 24 < 6)
    return np.clip(image + 60.0 * grid + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """96 training and 32 validation samples."""
    folder = tmp_path_factory.mktemp("data")
    rng = np.random.default_rng(0)
    for name, count in (("train", 96), ("val", 32)):
        writer = DatasetWriter(folder / name, PreprocessingSettings())
        for number in range(1, count + 1):
            euler = rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1])
            writer.add(number, dot_image(euler, rng), euler)
        writer.finish()
    return folder


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    """One short training."""
    out = tmp_path_factory.mktemp("run") / "a"
    return train(data, out, QUICK), out


def test_learning_rate_rises_holds_and_decays_as_in_the_paper():
    settings = TrainingSettings()
    expected = {0: 1e-5, 1.5: (1e-5 + 1e-3) / 2, 3: 1e-3, 3.5: 1e-3, 4: 1e-3, 54: 1e-7, 100: 1e-7}
    for epoch, rate in expected.items():
        assert learning_rate(epoch, settings) == pytest.approx(rate, rel=1e-12)
    assert learning_rate(4 + 37.5, settings) == pytest.approx(1e-7 + (1e-3 - 1e-7) * 0.5)
    assert settings.epochs == 54


def test_softbound_of_the_network_is_that_of_numpy():
    x = torch.tensor(
        [-1e30, -700.0, -20.0, 0.0, 1e-6, 3.0, 80.0, 1e6, 1e30, float("inf")], dtype=torch.float64
    )
    np.testing.assert_allclose(
        softbound(x, 1e-6, 1e6).numpy(), softbound_numpy(x.numpy(), 1e-6, 1e6), rtol=1e-15
    )


def test_loss_is_the_mean_negative_log_likelihood():
    from scipy.stats import norm

    rng = np.random.default_rng(1)
    labels, mean, sigma = rng.normal(size=(5, 6)), rng.normal(size=(5, 6)), rng.uniform(0.1, 3.0, (5, 6))
    expected = -norm.logpdf(labels, mean, sigma).sum(axis=1).mean()
    loss = mean_nll(torch.tensor(labels), torch.tensor(mean), torch.tensor(1.0 / sigma))
    assert loss.item() == pytest.approx(expected, rel=1e-6)


def test_each_output_has_its_own_dropout():
    torch.manual_seed(0)
    dropouts = (0.7, 0.0, 0.4)
    head = MultiDropoutLinear(2000, dropouts).train()
    with torch.no_grad():
        head.weight[:] = 1.0 / 2000
        head.bias[:] = 0.0
    answers = torch.stack([head(torch.ones(1, 2000))[0] for _ in range(200)]).detach().numpy()
    np.testing.assert_allclose(answers.mean(axis=0), 1.0, atol=0.02)
    expected = [np.sqrt(p / (1 - p) / 2000) for p in dropouts]
    np.testing.assert_allclose(answers.std(axis=0), expected, rtol=0.2, atol=1e-6)


def test_dropout_is_off_in_evaluation():
    head = MultiDropoutLinear(50, (0.7, 0.4)).eval()
    features = torch.rand(3, 50)
    torch.testing.assert_close(head(features), head(features))


def test_an_untrained_network_starts_from_the_labels_statistics():
    network = Gdn(GdnSettings(image_size=64))
    labels = torch.randn(500, 6) * torch.tensor([2.0, 2, 1, 0.1, 0.1, 0.05]) + 3.0
    network.start_from(labels)
    with torch.no_grad():
        network.head.weight.zero_()
    mean, inverse_sigma = network.eval()(torch.rand(2, 1, 64, 64))
    torch.testing.assert_close(mean[0], labels.mean(dim=0))
    torch.testing.assert_close(inverse_sigma[0], 1.0 / labels.std(dim=0), rtol=1e-3, atol=1e-3)


def test_a_short_training_reduces_loss_and_errors(run, data):
    result, _ = run
    assert result.epochs[-1].train_loss < result.epochs[0].train_loss - 1.0
    assert result.best.validation_loss < result.epochs[0].validation_loss - 1.0
    assert np.all(result.best.mae[:2] < 1.5)  # uniform in +-4 mm: guessing the mean gives 2.0


def test_the_run_folder_tells_what_was_done(run):
    result, out = run
    assert {path.name for path in out.iterdir()} == {
        "config.yaml", "data.txt", "epochs.csv", "curves.png", "best.pt", "model.onnx"
    }  # fmt: skip
    assert TrainConfig.from_file(out / "config.yaml") == QUICK
    assert len((out / "epochs.csv").read_text().splitlines()) == 1 + len(result.epochs)
    assert "96 usable samples of 96 rows" in (out / "data.txt").read_text()


def test_exported_model_answers_like_the_network(run, data):
    _, out = run
    network = Gdn(QUICK.network)
    network.load_state_dict(torch.load(out / "best.pt", weights_only=True))
    network.eval()
    estimator = Estimator(out / "model.onnx")
    rng = np.random.default_rng(5)
    for _ in range(5):
        prepared = estimator.preprocessor(dot_image(rng.uniform(0.5, 3.0, 6), rng))
        with torch.inference_mode():
            mean, inverse_sigma = network(torch.from_numpy(prepared))
        answer_mean, answer_inverse_sigma = estimator.infer(prepared)
        np.testing.assert_allclose(answer_mean, mean[0].numpy(), rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(answer_inverse_sigma, inverse_sigma[0].numpy(), rtol=1e-4, atol=1e-5)


def test_exported_model_estimates_new_images(run):
    estimator = Estimator(run[1] / "model.onnx")
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(20):
        euler = rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1])
        estimate = estimator.estimate(dot_image(euler, rng))
        errors.append(network_from_pose(estimate.mean) - labels_from_euler(euler)[0])
    assert np.all(np.abs(errors).mean(axis=0)[:2] < 1.5)


def test_exported_model_carries_the_facts_of_its_training(run):
    result, out = run
    metadata = Estimator(out / "model.onnx").metadata
    assert metadata.preprocessing.size == 64
    assert metadata.training_data["samples"] == 96 and len(metadata.training_data["sha256"]) == 64
    assert metadata.training["training"]["seed"] == 3
    np.testing.assert_allclose(list(metadata.validation["mae"].values()), result.best.mae)


def test_exported_softbound_holds_its_bounds(tmp_path):
    network = Gdn(GdnSettings(image_size=16, channels=(2, 2))).eval()
    for value, bound in ((-1e9, 1e-6), (1e9, 1e6)):
        with torch.no_grad():
            network.head.bias[6:] = value
        metadata = ModelMetadata(PreprocessingSettings(size=16), {}, {})
        estimator = Estimator(export_onnx(network, tmp_path / "m.onnx", metadata))
        np.testing.assert_allclose(estimator.infer(np.zeros((1, 1, 16, 16), np.float32))[1], bound, rtol=1e-6)


def test_the_same_seed_gives_the_same_model(data, tmp_path):
    config = TrainConfig(QUICK.network, QUICK.training.replaced(hold_epochs=0, decay_epochs=1))
    losses = [train(data, tmp_path / name, config, limit=32).epochs[-1].validation_loss for name in "ab"]
    assert losses[0] == losses[1]


def test_training_stops_when_validation_stops_improving(data, tmp_path, monkeypatch):
    losses = iter([5.0, 3.0, 4.0, float("nan"), 2.0, 2.5])
    monkeypatch.setattr(
        "tactile_perception.training.train._Run._evaluate", lambda run: (next(losses), np.ones(6))
    )
    config = TrainConfig(QUICK.network, QUICK.training.replaced(patience=2))
    result = train(data, tmp_path / "run", config, limit=16)
    assert result.stopped == "no better validation loss in 2 epochs"
    assert (len(result.epochs), result.best.number) == (4, 1)


def test_a_folder_that_holds_a_run_is_not_overwritten(run, data):
    with pytest.raises(FileExistsError, match="holds another run"):
        train(data, run[1], QUICK)


def test_validation_data_has_to_be_named(data, tmp_path):
    with pytest.raises(DatasetError, match="name the validation data with --val"):
        train(data / "train", tmp_path / "run", QUICK)


def command(*words: object) -> int:
    """Run `tactile train`."""
    parser = argparse.ArgumentParser()
    commands.register(parser.add_subparsers())
    arguments = parser.parse_args(["train", *map(str, words)])
    return arguments.run(arguments)


def test_train_on_the_command_line_installs_a_working_model(data, tmp_path, capsys):
    small = [
        "network.channels=[4, 4, 4, 4]",
        "network.image_size=64",
        "training.decay_epochs=0",
        "training.threads=1",
    ]
    changes = [word for change in small for word in ("--set", change)]
    changes += ["--set", "training.rise_epochs=1", "--set", "training.hold_epochs=0", "--limit", "32"]
    model = tmp_path / "model.onnx"
    assert command(data, "--out", tmp_path / "run", "--install", model, *changes) == 0
    assert "rho_x" in capsys.readouterr().out
    assert Estimator(model).metadata.training["network"]["channels"] == [4, 4, 4, 4]


@pytest.mark.parametrize(
    "words, message",
    [
        (["--set", "training.bath_size=3"], "did you mean 'batch_size'"),
        (["--set", "trainin.batch_size=3"], "did you mean 'training'"),
        (["--set", "training.batch_size=0"], "batch_size = 0"),
        (["--set", "training.batch_size"], "must have the form"),
        (["--config", "nowhere.yaml"], "nowhere.yaml"),
        (["--val", "nowhere"], "nowhere: is not a folder"),
    ],
)
def test_mistakes_on_the_command_line_are_told(data, tmp_path, capsys, words, message):
    assert command(data, "--out", tmp_path / "run", *words) == 1
    assert message in capsys.readouterr().err


def test_a_mistake_in_a_configuration_file_is_told_with_its_line(data, tmp_path, capsys):
    path = tmp_path / "config.yaml"
    path.write_text("network:\n  image_size: 64\ntraining:\n  patience: 2\n  seeed: 3\n")
    assert command(data, "--out", tmp_path / "run", "--config", path) == 1
    assert "config.yaml:5: " in (error := capsys.readouterr().err) and "did you mean 'seed'" in error


def test_the_configuration_named_after_the_paper_is_the_default():
    folder = Path(__file__).parents[2] / "config" / "perception"
    assert TrainConfig.from_file(folder / "gdn_lloyd_lepora.yaml") == TrainConfig()
    assert TrainConfig.from_file(folder / "tactip_sim.yaml").network == GdnSettings()
