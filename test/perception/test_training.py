"""Training runs: schedule, folder, resuming, command line. Needs PyTorch."""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from folders import write_folder

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")

from tactile_base.settings import SettingError  # noqa: E402
from tactile_bringup.commands import train as train_command  # noqa: E402
from tactile_perception.datasets.dataset import DatasetError, TactileDataset, read_dataset  # noqa: E402
from tactile_perception.datasets.layout import DatasetReport  # noqa: E402
from tactile_perception.estimating.estimator import Estimator  # noqa: E402
from tactile_perception.estimating.labels import EULER_COMPONENTS, labels_from_euler, network_from_pose  # noqa: E402
from tactile_perception.estimating.preprocessing import PreprocessingSettings  # noqa: E402
from tactile_perception.evaluation.calibration import CalibrationError  # noqa: E402
from tactile_perception.training.augmentation import AugmentationError, Augmenter  # noqa: E402
from tactile_perception.training.data import Samples, arrange, load_data, split_holdback  # noqa: E402
from tactile_perception.training.network import PoseNetwork  # noqa: E402
from tactile_perception.training.progress import TrainingDisplay, TrainingProgress  # noqa: E402
from tactile_perception.training.run_folder import Epoch, RunFolder  # noqa: E402
from tactile_perception.training.settings import (  # noqa: E402
    AugmentationSettings,
    NetworkSettings,
    TrainingSettings,
    learning_rate,
)
from tactile_perception.training.train import TrainConfig, in_low_precision, train  # noqa: E402

QUICK = TrainConfig(
    NetworkSettings(image_size=64, channels=(8, 16, 32, 32), batch_norm_momentum=0.2, head_gain=1.0),
    TrainingSettings(batch_size=8, rise_epochs=1, hold_epochs=5, decay_epochs=8, seed=3, threads=1),
)
CONFIGS = Path(__file__).parents[2] / "config" / "perception"


def short(network: dict | None = None, **training) -> TrainConfig:
    """A run of two epochs."""
    settings = QUICK.training.replaced(rise_epochs=0, hold_epochs=1, decay_epochs=1, **training)
    return TrainConfig(QUICK.network.replaced(**(network or {})), settings)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def run(training_data, tmp_path_factory):
    """One short training."""
    out = tmp_path_factory.mktemp("run") / "a"
    return train(training_data, out, QUICK), out


def test_learning_rate_rises_holds_and_decays_as_in_the_paper():
    settings = TrainingSettings()
    expected = {0: 1e-5, 1.5: (1e-5 + 1e-3) / 2, 3: 1e-3, 3.5: 1e-3, 4: 1e-3, 54: 1e-7, 100: 1e-7}
    for epoch, rate in expected.items():
        assert learning_rate(epoch, settings) == pytest.approx(rate, rel=1e-12)
    assert learning_rate(4 + 37.5, settings) == pytest.approx(1e-7 + (1e-3 - 1e-7) * 0.5)
    assert settings.epochs == 54


def test_a_short_training_reduces_loss_and_errors(run, training_data):
    result, _ = run
    assert result.epochs[-1].train_loss < result.epochs[0].train_loss - 1.0
    assert result.best.validation_loss < result.epochs[0].validation_loss - 1.0
    assert np.all(result.best.mae[:2] < 1.5)  # uniform in +-4 mm: guessing the mean gives 2.0


def test_the_run_folder_tells_what_was_done(run):
    result, out = run
    assert {path.name for path in out.iterdir()} == {
        "config.yaml", "data.txt", "data.json", "epochs.csv", "curves.png", "best.pt", "model.onnx",
        "result.json",
    }  # fmt: skip
    assert TrainConfig.from_file(out / "config.yaml") == QUICK
    assert len((out / "epochs.csv").read_text().splitlines()) == 1 + len(result.epochs)
    assert "96 usable samples of 96 rows" in (out / "data.txt").read_text()


def test_exported_model_estimates_new_images(run, dots):
    estimator = Estimator(run[1] / "model.onnx")
    rng = np.random.default_rng(6)
    errors = []
    for _ in range(20):
        euler = rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1])
        estimate = estimator.estimate(dots(euler, rng))
        errors.append(network_from_pose(estimate.mean) - labels_from_euler(euler)[0])
    assert np.all(np.abs(errors).mean(axis=0)[:2] < 1.5)


def test_exported_model_carries_the_facts_of_its_training(run):
    result, out = run
    metadata = Estimator(out / "model.onnx").metadata
    assert metadata.preprocessing.size == 64
    assert 0.0 < metadata.plain_depth.rms < 2e-3
    assert np.isinf(metadata.novelty.light), "behind a threshold"
    assert metadata.training_data["samples"] == 96 and len(metadata.training_data["sha256"]) == 64
    assert metadata.training["training"]["seed"] == 3
    # Epochs are compared in bf16; what the file says was measured in full precision.
    np.testing.assert_allclose(list(metadata.validation["mae"].values()), result.best.mae, rtol=0.05)


def test_the_line_of_an_epoch_names_its_errors_and_their_units(capsys):
    mae = np.array([0.55, 0.5362, 0.133, 0.0068, 0.0071, 0.02344])
    with TrainingDisplay() as display:
        display.start(2, 10, "mean NLL", 0)
        display.epoch(Epoch(0, 1e-3, -3.0, -3.5, mae, 7.0, True, 61.0))
    assert capsys.readouterr().err == (
        "epoch   1  lr 1.0e-03  mean NLL train  -3.000 val  -3.500  val MAE rho x/y/z 0.550/0.536/0.133 mm, "
        "phi x/y/z 0.0068/0.0071/0.0234 rad  7 s, 1 min 01 s left  best\n"
    )


def test_the_same_seed_gives_the_same_model(training_data, tmp_path):
    config = TrainConfig(QUICK.network, QUICK.training.replaced(hold_epochs=0, decay_epochs=1))
    losses = [
        train(training_data, tmp_path / name, config, limit=32).epochs[-1].validation_loss for name in "ab"
    ]
    assert losses[0] == losses[1]


class Killed(Exception):
    pass


class KilledIn(TrainingProgress):
    """Ends the run in the middle of an epoch, as a kill would."""

    def __init__(self, epoch: int) -> None:
        self.last = epoch

    def step(self, epoch, step, loss, seconds_left):
        if epoch == self.last and step == 2:
            raise Killed


class KilledAfter(TrainingProgress):
    """Ends the run between two epochs."""

    def __init__(self, epoch: int) -> None:
        self.last = epoch

    def epoch(self, epoch):
        if epoch.number == self.last:
            raise Killed


def test_a_run_that_was_killed_ends_as_if_it_had_not_been(training_data, tmp_path):
    """With everything that has a state: optimizer, dropout, averaged weights, augmentation, learned axis."""
    config = TrainConfig(
        QUICK.network,
        QUICK.training.replaced(hold_epochs=1, decay_epochs=2, average_decay=0.9),
        AugmentationSettings(symmetry=2, symmetry_center=[220.0, 220.0], shift=2.0, growth=0.5),
    )
    whole = train(training_data, tmp_path / "whole", config, limit=48)
    for epoch in (0, 2):
        with pytest.raises(Killed):
            train(training_data, tmp_path / "cut", config, limit=48, progress=KilledIn(epoch))
    resumed = train(training_data, tmp_path / "cut", config, limit=48)
    assert len(resumed.epochs) == len(whole.epochs) == 4
    for one, other in zip(whole.epochs, resumed.epochs, strict=True):
        assert (one.train_loss, one.validation_loss) == (other.train_loss, other.validation_loss)
    models = [load_weights(tmp_path / name / "model.onnx") for name in ("whole", "cut")]
    assert models[0].keys() == models[1].keys()
    for name, value in models[0].items():
        np.testing.assert_array_equal(value, models[1][name])


def load_weights(path: Path) -> dict[str, np.ndarray]:
    import onnx

    return {item.name: onnx.numpy_helper.to_array(item) for item in onnx.load(path).graph.initializer}


@pytest.mark.parametrize(
    "change, message", [("batch_size", "training.batch_size = 8, not 4"), ("", "data.samples")]
)
def test_an_unfinished_run_is_not_resumed_as_another(training_data, tmp_path, change, message):
    with pytest.raises(Killed):
        train(training_data, tmp_path / "run", QUICK, limit=48, progress=KilledIn(1))
    config = QUICK.replaced(training__batch_size=4) if change else QUICK
    with pytest.raises(FileExistsError, match=message):
        train(training_data, tmp_path / "run", config, limit=48 if change else 40)


def test_training_stops_when_validation_stops_improving(training_data, tmp_path, monkeypatch):
    losses = iter([5.0, 3.0, 4.0, float("nan"), 2.0, 2.5])
    monkeypatch.setattr(
        "tactile_perception.training.train._Run.evaluate", lambda *_: (next(losses), np.ones(6))
    )
    config = TrainConfig(QUICK.network, QUICK.training.replaced(patience=2))
    result = train(training_data, tmp_path / "run", config, limit=16)
    assert result.stopped == "no better validation loss in 2 epochs"
    assert (len(result.epochs), result.best.number) == (4, 1)


def test_the_last_epoch_may_be_taken(training_data, tmp_path, monkeypatch):
    losses = iter([3.0, 5.0, 9.0, float("nan"), 9.0])  # and one of the finished run
    monkeypatch.setattr(
        "tactile_perception.training.train._Run.evaluate", lambda *_: (next(losses), np.ones(6))
    )
    settings = QUICK.training.replaced(
        choose="last", rise_epochs=0, hold_epochs=1, decay_epochs=3, patience=2
    )
    config = TrainConfig(QUICK.network, settings)
    result = train(training_data, tmp_path / "run", config, limit=16)
    assert [epoch.best for epoch in result.epochs] == [True, True, True, False], "as far as it is finite"
    assert (result.stopped, result.best.number) == ("end of the schedule", 2)


def test_a_run_starts_from_the_network_of_another_and_tells_so(run, training_data, tmp_path):
    first, folder = run
    schedule = {"rise_epochs": 0, "hold_epochs": 1, "decay_epochs": 0, "learning_rate_peak": 1e-9}
    slow = QUICK.merged({"training": schedule})
    plain = train(training_data, tmp_path / "plain", slow)
    started = train(training_data, tmp_path / "started", slow.replaced(training__start=str(folder)))
    assert started.best.validation_loss < plain.best.validation_loss - 1.0
    assert started.best.validation_loss < first.best.validation_loss + 1.0  # another batch's statistics
    data = Estimator(started.model_path).metadata.training_data
    assert data["start"]["samples"] == data["samples"] and len(data["start"]["weights_sha256"]) == 64


def test_a_start_with_another_head_gives_all_but_the_head(run, training_data, tmp_path):
    config = QUICK.replaced(network__head="full_gaussian").replaced(training__start=str(run[1]))
    start = load_data(training_data, None, config).start
    network = PoseNetwork(config.network)
    before = network.head.weight.clone()
    start.give(network)
    best = RunFolder(run[1]).load_best()
    torch.testing.assert_close(network.base[0][0].weight, best["base.0.0.weight"])
    torch.testing.assert_close(network.head.weight, before)


@pytest.mark.parametrize(
    "start, message",
    [
        ("nowhere", "is not the folder of a finished run"),
        ("other", r"channels = \(8, 16, 32, 32\), this one"),
    ],
)
def test_a_start_that_does_not_fit_is_refused(run, training_data, tmp_path, start, message):
    config = QUICK.replaced(training__start=str(run[1] if start == "other" else tmp_path / start))
    with pytest.raises(SettingError, match=message):
        train(training_data, tmp_path / "b", config.replaced(network__channels=(8, 16, 16, 16)))


@pytest.mark.parametrize("frozen", ["convolutions", "base"])
def test_what_is_frozen_stays_as_in_the_start_and_the_rest_learns(frozen, run, training_data, tmp_path):
    config = short(start=str(run[1]), frozen=frozen)
    train(training_data, tmp_path / "run", config)
    before, after = RunFolder(run[1]).load_best(), RunFolder(tmp_path / "run").load_best()
    same = {name for name in before if torch.equal(before[name], after[name])}
    assert {"base.0.0.weight", "base.1.0.weight", "base.2.0.weight", "base.3.0.weight"} <= same
    assert ({"base.0.1.weight", "base.0.1.running_mean"} <= same) is (frozen == "base")
    assert "head.weight" not in same


def test_nothing_is_frozen_of_random_weights():
    with pytest.raises(SettingError, match="frozen = base: needs the network of another run"):
        TrainingSettings(frozen="base")


def test_few_samples_are_shown_as_often_as_a_schedule_needs(training_data, tmp_path):
    class Steps(TrainingProgress):
        count = 0

        def step(self, *_) -> None:
            self.count += 1

    counts = []
    for least in (0, 3, 11):
        progress = Steps()
        config = short(least_steps=least, batch_size=16)
        train(training_data, tmp_path / str(least), config, limit=40, progress=progress)
        counts.append(progress.count)
    assert counts == [4, 4, 12]  # two epochs of two batches, and thrice as many


def test_what_is_held_back_validates_where_nothing_else_does(training_data, tmp_path):
    config = short(holdback=0.25, precision="fp32").merged({"calibration": {"min_samples": 20}})
    folder = training_data / "train"
    result = train(folder, tmp_path / "run", config)
    facts = json.loads((tmp_path / "run" / "data.json").read_text())
    assert facts["held_out"] >= 20 and "validation_samples" not in facts
    assert "choose the epoch as well" in (tmp_path / "run" / "data.txt").read_text()
    held_out = load_data(folder, None, config).held_out
    estimator = Estimator(result.model_path)
    assert not estimator.metadata.calibration.is_identity
    mean, _ = estimator.predict_uncalibrated(held_out.images[:, None].astype(np.float32) / 255.0)
    np.testing.assert_allclose(np.abs(mean - held_out.labels).mean(axis=0), result.best.mae, rtol=1e-2)
    with pytest.raises(DatasetError, match="hold some back"):
        train(folder, tmp_path / "other", short())


def test_a_hundred_contacts_are_enough_for_their_configuration(dots, tmp_path):
    rng = np.random.default_rng(1)
    eulers = [rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1]) for _ in range(100)]
    write_folder(tmp_path / "contacts", ((dots(euler, rng), euler) for euler in eulers))
    config = TrainConfig.from_file(CONFIGS / "few_contacts.yaml")
    small = config.changed(
        [
            "network.channels=[4,4,4,8,8]",
            "augmentation.symmetry_center=[222,219]",
            "augmentation.mirror=false",
        ]
    )
    quick = small.changed(
        ["training.decay_epochs=1", "training.least_steps=30", "augmentation.plain_epochs=0"]
    )
    result = train(tmp_path / "contacts", tmp_path / "run", quick)
    assert Estimator(result.model_path).metadata.calibration.samples == 20


@pytest.mark.parametrize(
    "start, real",
    [("gdn_simulated_start", "gdn_symmetry"), ("few_contacts_start", "few_contacts")],
)
def test_a_shipped_start_fits_the_configuration_that_it_is_for(start, real):
    started, used = (TrainConfig.from_file(CONFIGS / f"{name}.yaml") for name in (start, real))
    assert started.network.replaced(head=used.network.head) == used.network


@pytest.mark.parametrize(
    "config, limit, error, message",
    [
        (QUICK, 1, DatasetError, "1 samples, needs at least 2"),
        (QUICK.replaced(training__holdback=0.3), None, CalibrationError, "leaves 29 samples .* least 100"),
        (
            QUICK.replaced(augmentation__symmetry=6),
            None,
            AugmentationError,
            "markers do not look the same after a turn",
        ),
        (
            QUICK.replaced(network__image_size=16, network__unpooled_blocks=0, network__channels=(4,) * 5),
            None,
            SettingError,
            "to nothing",
        ),
    ],
    ids=["one sample", "nothing to calibrate on", "no symmetry", "no image left"],
)
def test_what_cannot_be_trained_is_refused_and_leaves_nothing_in_the_way(
    training_data, tmp_path, config, limit, error, message
):
    out = tmp_path / "run"
    with pytest.raises(error, match=message):
        train(training_data, out, config, limit=limit)
    assert not out.exists()


def test_fewer_samples_than_a_batch_are_one_batch(training_data, tmp_path):
    config = short(batch_size=16)
    result = train(training_data, tmp_path / "run", config, limit=3)
    assert len(result.epochs) == 2 and np.isfinite(result.best.validation_loss)


def test_a_network_that_runs_away_is_given_up_and_its_best_epoch_kept(training_data, tmp_path, monkeypatch):
    from tactile_perception.training.train import _Run

    original = _Run._train_epoch

    def run_away(self, number, *rest):
        loss = original(self, number, *rest)
        if number == 1:
            next(self.network.parameters()).data.fill_(float("nan"))
        return loss

    monkeypatch.setattr(_Run, "_train_epoch", run_away)
    result = train(training_data, tmp_path / "run", QUICK, limit=16)
    assert (len(result.epochs), result.best.number) == (2, 0)
    assert "not finite" in result.stopped
    assert np.isfinite(RunFolder(tmp_path / "run").result()["validation_loss"])


def test_a_network_that_never_was_finite_is_an_error_also_when_it_is_resumed(
    training_data, tmp_path, monkeypatch
):
    monkeypatch.setattr("tactile_perception.training.train.learning_rate", lambda *_: 1e30)
    for _ in range(2):
        with pytest.raises(FloatingPointError, match="never finite: lower the learning rate"):
            train(training_data, tmp_path / "run", QUICK, limit=16)
    assert len((tmp_path / "run" / "epochs.csv").read_text().splitlines()) < 4  # given up at once


@pytest.mark.parametrize("name", ["state.pt", "config.yaml"])
def test_a_run_folder_that_was_damaged_is_named(training_data, tmp_path, name):
    with pytest.raises(Killed):
        train(training_data, tmp_path / "run", short(), limit=16, progress=KilledAfter(0))
    (tmp_path / "run" / name).write_bytes(b"\x00: [")
    with pytest.raises((ValueError, OSError), match=r"state\.pt: cannot be read|an unreadable configuration"):
        train(training_data, tmp_path / "run", short(), limit=16)


class Evil:
    """Runs code where it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("unpickled"),)


@pytest.mark.parametrize("name", ["state.pt", "best.pt"])
def test_nothing_in_the_files_of_a_run_is_executed(training_data, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Killed):
        train(training_data, tmp_path / "run", short(), limit=16, progress=KilledAfter(0))
    torch.save({"epochs": Evil()}, tmp_path / "run" / name)
    with pytest.raises(ValueError, match=rf"{name}: cannot be read"):
        RunFolder(tmp_path / "run").load_best() if name == "best.pt" else train(
            training_data, tmp_path / "run", short(), limit=16
        )
    assert not (tmp_path / "unpickled").exists()


def test_an_export_that_was_interrupted_is_made_again(training_data, tmp_path, monkeypatch):
    def half(path, data):
        with path.open("wb") as file:
            file.write(data[:500])
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", half)
        with pytest.raises(Killed):
            train(training_data, tmp_path / "run", short(), limit=16)
    assert not list((tmp_path / "run").glob("model.onnx*"))
    assert Estimator(train(training_data, tmp_path / "run", short(), limit=16).model_path).metadata


@pytest.mark.parametrize("place", ["file", "file/run"])
def test_a_file_in_place_of_the_run_folder_is_told_before_data_are_read(tmp_path, place):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match=r"cannot be a folder, since .*file is a file"):
        train(tmp_path / "no data", tmp_path / place, QUICK)


def test_a_folder_that_holds_a_run_is_not_overwritten(run, training_data):
    with pytest.raises(FileExistsError, match="holds another run"):
        train(training_data, run[1], QUICK)


def test_folders_processed_differently_are_refused_with_the_settings_that_differ(training_data, tmp_path):
    val = tmp_path / "val"
    shutil.copytree(training_data / "val", val)
    params = json.loads((val / "processed_image_params.json").read_text())
    (val / "processed_image_params.json").unlink()
    (val / "process_image_params.json").write_text(json.dumps({**params, "circle_mask_radius": 200}))
    with pytest.raises(DatasetError, match=r"the first has circle_mask_radius = 230, not 200$"):
        train(training_data, tmp_path / "run", QUICK, val)


def test_validation_data_has_to_be_named(training_data, tmp_path):
    with pytest.raises(DatasetError, match="name the validation data with --val"):
        train(training_data / "train", tmp_path / "run", QUICK)
    with pytest.raises(DatasetError, match="none: there is no such folder"):
        train(tmp_path / "none", tmp_path / "run", QUICK)


def command(*words: object) -> int:
    """Run `tactile train`."""
    parser = argparse.ArgumentParser(prog="tactile")
    train_command.register(parser.add_subparsers())
    arguments = parser.parse_args(["train", *map(str, words)])
    return arguments.run(arguments)


def test_train_on_the_command_line_installs_a_working_model(training_data, tmp_path, capsys):
    small = [
        "network.channels=[4, 4, 4, 4]",
        "network.image_size=64",
        "training.decay_epochs=0",
        "training.threads=1",
    ]
    changes = [word for change in small for word in ("--set", change)]
    changes += ["--set", "training.rise_epochs=1", "--set", "training.hold_epochs=0", "--limit", "32"]
    model = tmp_path / "model.onnx"
    assert command(training_data, "--out", tmp_path / "run", "--install", model, *changes) == 0
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
def test_mistakes_on_the_command_line_are_told(training_data, tmp_path, capsys, words, message):
    assert command(training_data, "--out", tmp_path / "run", *words) == 1
    assert message in capsys.readouterr().err


def test_a_mistake_in_a_configuration_file_is_told_with_its_line(training_data, tmp_path, capsys):
    path = tmp_path / "config.yaml"
    path.write_text("network:\n  image_size: 64\ntraining:\n  patience: 2\n  seeed: 3\n")
    assert command(training_data, "--out", tmp_path / "run", "--config", path) == 1
    assert "config.yaml:5: " in (error := capsys.readouterr().err) and "did you mean 'seed'" in error


def test_a_configuration_extends_another_and_says_only_what_differs(tmp_path):
    (tmp_path / "base.yaml").write_text("extends: gdn_lloyd_lepora.yaml\ntraining: {patience: 3, seed: 4}\n")
    (tmp_path / "mine.yaml").write_text("extends: base.yaml\ntraining: {patience: 9}\n")
    config = TrainConfig.from_file(tmp_path / "mine.yaml")
    assert config == TrainConfig().replaced(training__patience=9, training__seed=4)


@pytest.mark.parametrize(
    "text, message",
    [
        ("extends: gdn_symetry.yaml", r"mine\.yaml:1: extends: .*did you mean 'gdn_symmetry\.yaml'"),
        ("extends: mine.yaml", r"mine\.yaml:1: extends: mine\.yaml extends this file"),
        ("training:\n  patience: 0\nextends: gdn_symmetry.yaml", r"mine\.yaml:2: training: patience = 0"),
    ],
)
def test_a_mistake_in_what_extends_another_is_told_with_its_line(tmp_path, text, message):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(SettingError, match=message):
        TrainConfig.from_file(tmp_path / "mine.yaml")


def test_the_configurations_named_after_the_paper_hold_its_values():
    cnn = TrainConfig.from_file(CONFIGS / "cnn_lloyd_lepora.yaml")
    assert cnn.training == TrainingSettings() and not cnn.augmentation.active
    assert cnn.network == NetworkSettings(head="mse", dropout_mean=(0.1,) * 6)
    assert TrainConfig.from_file(CONFIGS / "gdn_lloyd_lepora.yaml") == TrainConfig()
    assert TrainConfig.from_file(CONFIGS / "tactip_sim.yaml").network == NetworkSettings()


def predictions(model: Path, samples) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations (N, 6)."""
    images = samples.images[:, np.newaxis].astype(np.float32) / np.float32(255.0)
    mean, covariance = Estimator(model).predict(images)
    return mean, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def test_samples_held_out_are_not_trained_on_and_calibrate_the_model(training_data, tmp_path):
    config = short(holdback=0.3).replaced(calibration__min_samples=20)
    model = train(training_data, tmp_path / "run", config).model_path
    facts = Estimator(model).metadata.training_data
    assert (facts["samples"], facts["held_out"]) == (67, 29)
    data = read_dataset(training_data / "train", changes={"size": 64})
    kept, held_out = split_holdback(96, 0.3)
    assert sorted([*kept, *held_out]) == list(range(96))
    samples = Samples(data.images, data.labels).taken(held_out)
    mean, sigma = predictions(model, samples)
    np.testing.assert_allclose((((samples.labels - mean) / sigma) ** 2).mean(axis=0), 1.0, atol=0.05)


def test_the_cnn_states_its_errors_on_validation_data_as_its_deviations(training_data, tmp_path):
    result = train(training_data, tmp_path / "run", short({"head": "mse"}))
    data = read_dataset(training_data / "val", changes={"size": 64})
    mean, sigma = predictions(result.model_path, data)
    rms = np.sqrt(((data.labels - mean) ** 2).mean(axis=0))
    np.testing.assert_allclose(sigma, np.tile(rms, (32, 1)), rtol=1e-3)
    weights = np.array([1, 1, 1, 100, 100, 100])
    loss = ((data.labels - mean) ** 2 @ weights).mean()
    assert RunFolder(tmp_path / "run").result()["validation_loss"] == pytest.approx(loss, rel=1e-3)
    assert "validation_weighted_MSE" in (tmp_path / "run" / "epochs.csv").read_text()
    assert Estimator(result.model_path).metadata.head == "mse"


def test_averaged_weights_are_what_is_validated_and_exported(training_data, tmp_path):
    """Training itself goes on as without the average."""
    still = train(training_data, tmp_path / "still", short(average_decay=0.99999), limit=32)
    moved = train(training_data, tmp_path / "moved", short(), limit=32)
    assert still.epochs[0].train_loss == moved.epochs[0].train_loss
    assert still.best.validation_loss != moved.best.validation_loss


@pytest.mark.parametrize(
    ("cpuinfo", "expected"),
    [
        ("flags\t\t: fpu avx2 avx512f amx_bf16 amx_tile\n", True),
        ("flags\t\t: fpu sse4_2 avx2\n", False),
        ("Features\t: fp asimd i8mm bf16\n", True),
        (None, False),
    ],
)
def test_low_precision_is_for_processors_that_have_it(cpuinfo, expected, monkeypatch):
    def read(path):
        assert str(path) == "/proc/cpuinfo"
        if cpuinfo is None:
            raise FileNotFoundError(path)
        return cpuinfo

    monkeypatch.setattr(Path, "read_text", read)
    assert in_low_precision("auto", torch.device("cpu")) == expected
    assert in_low_precision("bf16", torch.device("cpu")) and not in_low_precision("fp32", torch.device("cpu"))


def test_last_epochs_can_be_plain(training_data, tmp_path, monkeypatch):
    turned: list[int] = []
    original = Augmenter.__call__

    def counted(self, images, rng):
        turned.append(len(images))
        return original(self, images, rng)

    monkeypatch.setattr(Augmenter, "__call__", counted)
    augmentation = AugmentationSettings(shift=1.0, plain_epochs=1.0)
    config = TrainConfig(short().network, short().training, augmentation)
    train(training_data, tmp_path / "run", config, limit=32)
    assert sum(turned) == 32  # of two epochs, one


def test_a_run_is_resumed_with_other_settings_of_the_calibration(training_data, tmp_path):
    """They have no part in training; the result is calibrated by the new ones."""
    config = short(holdback=0.3).replaced(calibration__min_samples=20)
    with pytest.raises(Killed):
        train(training_data, tmp_path / "run", config, progress=KilledIn(1))
    config = config.replaced(calibration__sigma_knots=1)
    model = train(training_data, tmp_path / "run", config).model_path
    assert len(Estimator(model).metadata.calibration.sigma_knots[0]) == 1
    assert TrainConfig.from_file(tmp_path / "run" / "config.yaml") == config


@pytest.mark.parametrize("unit, told", [(1.0, ("y", "z", "gamma")), (1e-3, EULER_COMPONENTS)])
def test_what_an_edge_was_pressed_without_is_not_labelled_by_the_arms_errors(tmp_path, unit, told):
    """Shear along it and tilts are 0 but for those; in labels in m nothing is taken away."""
    rng = np.random.default_rng(0)
    labels = rng.uniform([0.0, -5.0, 0.5, 0.0, 0.0, -170.0], [0.0, 6.0, 6.0, 0.0, 0.0, 170.0], (200, 6))
    labels += rng.normal(size=(200, 6)) * np.repeat([0.03, 0.05], 3)
    data = TactileDataset(
        names=[f"image_{k}.png" for k in range(200)],
        images=np.zeros((200, 16, 16), np.uint8),
        euler_mm_deg=labels * np.repeat([unit, 1.0], 3),
        force=np.zeros((200, 3)),
        labelled=EULER_COMPONENTS,
        preprocessing=PreprocessingSettings(size=16),
        sha256="",
        report=DatasetReport(tmp_path),
    )
    config = TrainConfig(training=TrainingSettings(model="edge"))
    ready = arrange(data, data, config, data.preprocessing)
    assert ready.model.labelled == told
    for samples in (ready.training, ready.validation):
        assert tuple(np.array(EULER_COMPONENTS)[np.isfinite(samples.labels).all(axis=0)]) == told
    assert any("x, alpha, beta never change" in line for line in ready.report) == (told != EULER_COMPONENTS)
    whole = TrainConfig(training=TrainingSettings(model="surface"))
    assert arrange(data, None, whole, data.preprocessing).model.labelled == EULER_COMPONENTS
