"""Many runs: over seeds, processes and machines, and joined in an ensemble. Needs PyTorch."""

import argparse
import csv
import dataclasses
import shutil
import sys

import numpy as np
import pytest
from clusters import local_cluster

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
onnx = pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")

from tactile_bringup.commands import train as train_command  # noqa: E402
from tactile_perception.datasets.dataset import read_dataset  # noqa: E402
from tactile_perception.estimating.contact_model import EDGE, SURFACE  # noqa: E402
from tactile_perception.estimating.estimator import Estimator  # noqa: E402
from tactile_perception.estimating.labels import COMPONENTS  # noqa: E402
from tactile_perception.estimating.model_metadata import ModelMetadata, unseen_rows  # noqa: E402
from tactile_perception.estimating.preprocessing import PreprocessingSettings  # noqa: E402
from tactile_perception.training import ensemble  # noqa: E402
from tactile_perception.training.data import split_holdback  # noqa: E402
from tactile_perception.training.ensemble import EnsembleError, write_ensemble  # noqa: E402
from tactile_perception.training.export import export_onnx  # noqa: E402
from tactile_perception.training.jobs import Job, store_files  # noqa: E402
from tactile_perception.training.network import PoseNetwork  # noqa: E402
from tactile_perception.training.run_folder import RunFolder  # noqa: E402
from tactile_perception.training.settings import HEADS, NetworkSettings  # noqa: E402

QUICK = [
    "network.channels=[4, 4, 4, 4]", "network.image_size=32", "training.rise_epochs=0",
    "training.hold_epochs=1", "training.decay_epochs=1", "training.threads=1",
]  # fmt: skip


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def command(*words: object) -> int:
    """Run `tactile train` or `tactile ensemble`."""
    parser = argparse.ArgumentParser(prog="tactile")
    train_command.register(parser.add_subparsers())
    arguments = parser.parse_args([str(word) for word in words])
    return arguments.run(arguments)


def train(data, out, *words: object, changes: tuple[str, ...] = ()) -> int:
    settings = [word for change in (*QUICK, *changes) for word in ("--set", change)]
    return command("train", data, "--out", out, "--limit", 32, *settings, *words)


def rows(out) -> list[list[str]]:
    with (out / "repeat.csv").open(newline="") as file:
        return list(csv.reader(file))


def weights(path) -> list[bytes]:
    return [item.raw_data for item in onnx.load(str(path)).graph.initializer]


@pytest.fixture(scope="module")
def repeated(training_data, tmp_path_factory):
    """Two networks from two seeds, trained one after the other."""
    out = tmp_path_factory.mktemp("repeated")
    assert train(training_data, out, "--repeat", 2) == 0
    return out


def test_repeat_trains_from_different_seeds_and_tables_them(repeated):
    table = rows(repeated)
    assert [row[0] for row in table[1:]] == ["seed_0", "seed_1"] and table[0][1] == "mean NLL"
    assert table[1][1:] != table[2][1:]
    assert Estimator(repeated / "seed_1" / "model.onnx").metadata.training["training"]["seed"] == 1


def test_repeat_goes_on_where_it_was(repeated, training_data, capsys):
    before = (repeated / "seed_0" / "model.onnx").stat().st_mtime_ns
    assert train(training_data, repeated, "--repeat", 3) == 0
    output = capsys.readouterr()
    assert "2 of 3 runs are already there" in output.err and "3 of 3 networks" in output.out
    assert (repeated / "seed_0" / "model.onnx").stat().st_mtime_ns == before and len(rows(repeated)) == 4


def test_finished_runs_of_another_configuration_are_not_mixed_in(repeated, training_data, capsys):
    assert train(training_data, repeated, "--repeat", 2, changes=("training.batch_size=8",)) == 1
    assert "training.batch_size = 16, not 8" in " ".join(capsys.readouterr().err.split())


def test_processes_give_the_same_networks(repeated, training_data, tmp_path):
    assert train(training_data, tmp_path, "--repeat", 2, "--jobs", 2) == 0
    for seed in ("seed_0", "seed_1"):
        models = [weights(out / seed / "model.onnx") for out in (repeated, tmp_path)]
        assert models[0] == models[1]


def test_a_run_that_fails_in_a_process_is_told_with_its_reason(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    val = ("--val", tmp_path / "data")
    assert train(tmp_path / "data", tmp_path / "out", "--repeat", 1, "--jobs", 2, *val) == 1
    assert "targets_images.csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, message",
    [
        (["--jobs", 2], "they need --repeat"),
        (["--repeat", 2, "--install", "m.onnx"], "leave out --repeat"),
        (["--folds", 2], "neither --limit nor"),
    ],
)
def test_options_that_do_not_go_together_are_refused(training_data, tmp_path, capsys, words, message):
    assert train(training_data, tmp_path / "out", *words) == 1
    assert message in capsys.readouterr().err


def test_a_seed_that_fails_does_not_stop_the_others(training_data, tmp_path, capsys, monkeypatch):
    from tactile_perception.training import train as module

    original = module.train

    def fail_once(data, out, config, *rest):
        if config.training.seed == 0:
            raise FloatingPointError("the validation loss was never finite")
        return original(data, out, config, *rest)

    monkeypatch.setattr(module, "train", fail_once)
    assert train(training_data, tmp_path, "--repeat", 2) == 1
    assert "seed_0: the validation loss was never finite" in capsys.readouterr().err
    assert [row[0] for row in rows(tmp_path)[1:]] == ["seed_1"]


def test_a_cluster_without_dask_is_told_what_to_install(training_data, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert train(training_data, tmp_path, "--repeat", 1, "--scheduler", "tcp://127.0.0.1:8786") == 1
    assert "pip install distributed" in capsys.readouterr().err


def test_a_cluster_gives_the_same_networks(repeated, training_data, tmp_path):
    with local_cluster() as address:
        assert train(training_data, tmp_path, "--repeat", 2, "--scheduler", address) == 0
    assert weights(tmp_path / "seed_1" / "model.onnx") == weights(repeated / "seed_1" / "model.onnx")


def test_files_of_a_worker_come_back_where_its_folder_is_not_ours(repeated, tmp_path):
    there = repeated / "seed_0"
    files = {path.name: path.read_bytes() for path in there.iterdir()}
    job = Job("data", str(tmp_path / "seed_0"), {})
    assert not job.folder.finished
    store_files(job, files)
    assert job.folder.result() == RunFolder(there).result()
    store_files(job, {"result.json": b"{}"})  # a finished run stays as it is
    assert job.folder.result() == RunFolder(there).result()


def test_a_scheduler_that_does_not_answer_is_named(training_data, tmp_path, capsys, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs Dask (the extra 'cluster')")

    def no_client(address, timeout):
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", no_client)
    assert train(training_data, tmp_path, "--repeat", 1, "--scheduler", "tcp://127.0.0.1:1") == 1
    assert "tcp://127.0.0.1:1: no Dask scheduler answers there" in capsys.readouterr().err


@pytest.fixture(scope="module")
def folded(training_data, tmp_path_factory):
    """Two networks that each leave out another half of the data, joined in one model."""
    out = tmp_path_factory.mktemp("folded")
    settings = [word for change in (*QUICK, "calibration.min_samples=20") for word in ("--set", change)]
    assert command("train", training_data, "--out", out, "--folds", 2, "--jobs", 2, *settings) == 0
    return out


def test_folds_learn_from_all_contacts_and_all_calibrate(folded, training_data):
    """The mean of the networks' answers; what each says of the part that it never saw has a NEES of 1."""
    data = read_dataset(training_data / "train", changes={"size": 32})
    members = [Estimator(folded / f"fold_{fold}" / "model.onnx") for fold in (0, 1)]
    unseen = [unseen_rows(each.metadata, data.sha256, len(data)) for each in members]
    assert sorted(np.concatenate(unseen)) == list(range(len(data)))
    images = data.images[:, np.newaxis].astype(np.float32) / np.float32(255.0)
    answers = [each.predict_uncalibrated(images) for each in members]
    joined = Estimator(folded / "model.onnx")
    calibration = joined.metadata.calibration
    assert calibration.samples == len(data)
    squared = []
    for (mean, covariance), rows in zip(answers, unseen, strict=True):
        variance = np.diagonal(calibration.covariance(mean, covariance), axis1=1, axis2=2)
        squared.append((data.labels[rows] - mean[rows]) ** 2 / variance[rows])
    np.testing.assert_allclose(np.concatenate(squared).mean(axis=0), 1.0, atol=0.02)
    mean, covariance = (sum(parts) / 2.0 for parts in zip(*answers, strict=True))
    found = joined.predict(images)
    np.testing.assert_allclose(found[0], mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found[1], calibration.covariance(mean, covariance), rtol=1e-3, atol=1e-4)


def test_a_model_of_folds_is_a_finished_run_that_has_seen_all(folded, training_data, tmp_path, capsys):
    result = RunFolder(folded).result()
    assert result["folds"] == 2 and set(result["mae"]) == set(COMPONENTS)
    metadata = Estimator(folded / "model.onnx").metadata
    assert not len(unseen_rows(metadata, metadata.training_data["sha256"], 96))
    assert command("train", training_data, "--out", folded, "--folds", 2) == 1
    assert "holds another run" in capsys.readouterr().err
    assert train(training_data, tmp_path / "next", "--start", folded) == 1
    assert "take one, as" in " ".join(capsys.readouterr().err.split())


def test_folds_go_on_where_they_were(folded, training_data, tmp_path, capsys):
    """One of them is there already."""
    out = tmp_path / "again"
    shutil.copytree(folded / "fold_0", out / "fold_0")
    settings = [word for change in (*QUICK, "calibration.min_samples=20") for word in ("--set", change)]
    model = tmp_path / "installed.onnx"
    assert command("train", training_data, "--out", out, "--folds", 2, *settings, "--install", model) == 0
    output = capsys.readouterr()
    assert "1 of 2 runs are already there" in output.err and "2 networks" in output.out
    assert weights(model) == weights(folded / "model.onnx")


@pytest.mark.parametrize("spread", [True, False])
def test_angles_that_go_all_round_are_joined_the_short_way_round(tmp_path, spread):
    """Of networks with random weights, whose directions are all over the circle."""
    (turning,) = EDGE.turning
    paths = [member(tmp_path / f"{n}.onnx", "gaussian", n, EDGE) for n in range(3)]
    images = np.random.default_rng(0).random((20, 1, 32, 32), dtype=np.float32)
    means, covariances = (
        np.array(part) for part in zip(*(Estimator(path).predict(images) for path in paths), strict=True)
    )
    offset = means - means[0]
    assert np.abs(offset[..., turning]).max() > np.pi, "or it is no test"
    offset[..., turning] = np.angle(np.exp(1j * offset[..., turning]))
    mean = means[0] + offset.mean(axis=0)
    difference = means[0] + offset - mean
    expected = covariances.mean(axis=0)
    if spread:
        expected = expected + np.einsum("kni,knj->nij", difference, difference) / len(paths)
    metadata = dataclasses.replace(Estimator(paths[0]).metadata, training={"members": [{}] * 3})
    ensemble._write(paths, tmp_path / "all.onnx", metadata, spread)
    found = Estimator(tmp_path / "all.onnx").predict(images)
    np.testing.assert_allclose(found[0], mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found[1], expected, rtol=1e-3, atol=1e-3)


def member(path, head: str, seed: int, model=SURFACE, **metadata) -> object:
    """A network with random weights as a model file."""
    torch.manual_seed(seed)
    network = PoseNetwork(NetworkSettings(image_size=32, channels=(4, 6), head=head), model)
    with torch.no_grad():
        network.start_from(torch.randn(50, 6) + 2.0 * (1 + seed) * torch.tensor([*[0.0] * 5, model.directed]))
        network.head.weight.normal_(std=0.2)
    settings = {"preprocessing": PreprocessingSettings(size=32), "training_data": {}, "validation": {}}
    settings["contact_model"] = model
    export_onnx(network.eval(), path, ModelMetadata(**{**settings, **metadata}), np.full(6, 0.3))
    return path


def test_ensemble_is_the_mixture_of_its_members(tmp_path):
    """Of all kinds of heads."""
    paths = [member(tmp_path / f"{n}.onnx", head, n) for n, head in enumerate(HEADS)]
    images = np.random.default_rng(0).random((4, 1, 32, 32), dtype=np.float32)
    answers = [Estimator(path).predict(images) for path in paths]
    means, covariances = (np.array(part) for part in zip(*answers, strict=True))
    mean = means.mean(axis=0)
    spread = means - mean
    expected = covariances.mean(axis=0) + np.einsum("kni,knj->nij", spread, spread) / len(paths)
    found_mean, found_covariance = Estimator(write_ensemble(paths, tmp_path / "all.onnx")).predict(images)
    np.testing.assert_allclose(found_mean, mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found_covariance, expected, rtol=1e-3, atol=1e-4)


def test_ensemble_on_the_command_line_estimates_images(repeated, tmp_path, capsys):
    runs = [repeated / "seed_0", repeated / "seed_1"]
    assert command("ensemble", *runs, "--out", tmp_path / "two.onnx") == 0
    assert "2 networks" in capsys.readouterr().out
    estimator = Estimator(tmp_path / "two.onnx")
    assert estimator.metadata.head == "ensemble" and len(estimator.metadata.training["members"]) == 2
    estimate = estimator.estimate(np.zeros((480, 640), np.uint8))
    assert np.all(np.linalg.eigvalsh(estimate.cov) > 0.0)


def test_ensemble_is_calibrated_on_what_its_members_held_out(training_data, tmp_path):
    """After which each component's NEES is 1 on them."""
    data = read_dataset(training_data / "train", changes={"size": 32})
    facts = {
        "training_data": {"sha256": data.sha256},
        "training": {"training": {"holdback": 0.4}, "calibration": {"min_samples": 20}},
    }
    paths = [member(tmp_path / f"{n}.onnx", "gaussian", n, **facts) for n in range(2)]
    _, held_out = split_holdback(len(data), 0.4)
    path = write_ensemble(paths, tmp_path / "both.onnx", training_data)
    mean, covariance = Estimator(path).predict(
        data.images[held_out][:, np.newaxis].astype(np.float32) / np.float32(255.0)
    )
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    nees = ((data.labels[held_out] - mean) ** 2 / variance).mean(axis=0)
    np.testing.assert_allclose(nees, 1.0, atol=0.02)


@pytest.mark.parametrize(
    "metadata, data, message",
    [
        ({}, None, "at least two networks"),
        ({"preprocessing": PreprocessingSettings(size=32, median=3)}, None, "prepares images otherwise"),
        ({}, "data", "was trained on all of its data"),
    ],
)
def test_networks_that_cannot_be_joined_are_refused(tmp_path, training_data, metadata, data, message):
    paths = [member(tmp_path / "0.onnx", "gaussian", 0)]
    if "two" not in message:
        paths.append(member(tmp_path / "1.onnx", "gaussian", 1, **metadata))
    with pytest.raises(EnsembleError, match=message):
        write_ensemble(paths, tmp_path / "all.onnx", training_data if data else None)


def test_an_ensemble_is_not_calibrated_on_other_data(tmp_path, training_data):
    facts = {"training_data": {"sha256": "0" * 64}, "training": {"training": {"holdback": 0.1}}}
    paths = [member(tmp_path / f"{n}.onnx", "gaussian", n, **facts) for n in range(2)]
    with pytest.raises(EnsembleError, match="is not what the networks were trained on"):
        write_ensemble(paths, tmp_path / "all.onnx", training_data)
