"""`tactile calibrate`: a model file's uncertainty fitted to its errors on other data."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from folders import write_folder

from tactile_bringup.commands import calibrate as calibrate_command
from tactile_perception.datasets.dataset import read_dataset
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import euler_from_label
from tactile_perception.estimating.model_metadata import split_holdback

pytest.importorskip("torch", reason="the training package needs PyTorch (the extra 'train')")

MU = np.array([0.5, -1.0, -3.0, 0.1, -0.2, 0.03])
SIGMA = np.array([0.5, 0.5, 0.1, 0.01, 0.01, 0.02])
SAMPLES = 220


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Labels around what the constant model answers to every image."""
    labels = MU + np.random.default_rng(1).normal(size=(SAMPLES, 6)) * SIGMA
    black = np.zeros((480, 640), np.uint8)
    path = tmp_path_factory.mktemp("recalibration") / "data"
    return write_folder(path, ((black, euler_from_label(label)) for label in labels))


def run(model: Path, data: Path, out: Path, *more: str) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    calibrate_command.register(parser.add_subparsers())
    parsed = parser.parse_args(["calibrate", str(model), "--data", str(data), "--out", str(out), *more])
    return int(parsed.run(parsed))


def sigma_of(model: Path) -> np.ndarray:
    _, cov = Estimator(model).predict(np.zeros((1, 1, 128, 128), np.float32))
    return np.sqrt(np.diagonal(cov[0]))


def test_the_copy_states_the_errors_that_the_data_have(folder, constant_model, tmp_path, capsys):
    out = tmp_path / "new" / "calibrated.onnx"
    model = constant_model(MU, 3.0 / SIGMA)
    assert run(model, folder, out) == 0
    rms = np.sqrt(((read_dataset(folder).labels - MU) ** 2).mean(axis=0))
    np.testing.assert_allclose(sigma_of(out), rms, rtol=1e-4)
    np.testing.assert_allclose(sigma_of(model), SIGMA / 3.0, rtol=1e-4)
    assert f"calibrated on {SAMPLES} samples" in capsys.readouterr().out
    first = out.read_bytes()
    assert run(model, folder, out, "--set", "margin=[2, 1, 1, 1, 1, 1.5]") == 0
    assert out.with_name("calibrated-1.onnx").read_bytes() == first != out.read_bytes()
    before = model.read_bytes()
    assert run(model, folder, model) == 1 and model.read_bytes() == before
    assert "is the model itself" in " ".join(capsys.readouterr().err.split())


def test_settings_can_be_changed(folder, constant_model, tmp_path):
    model = constant_model(MU, 1.0 / SIGMA)
    plain, wide = tmp_path / "plain.onnx", tmp_path / "wide.onnx"
    assert run(model, folder, plain) == 0
    assert run(model, folder, wide, "--set", "margin=[2, 1, 1, 1, 1, 1.5]") == 0
    np.testing.assert_allclose(sigma_of(wide) / sigma_of(plain), [2, 1, 1, 1, 1, 1.5], rtol=1e-4)


def test_data_of_another_session_get_neither_margin_nor_floor(
    folder, constant_model, model_metadata, tmp_path, capsys
):
    """They are for what the training session does not show of another one, and these data show it."""
    training = {"training": {"holdback": 0.5}, "calibration": {"margin": [2.0] * 6, "floor": [0.3] * 6}}
    errors = read_dataset(folder).labels - MU
    for sha256, rows, widened in (
        ("of other data", np.arange(SAMPLES), False),
        (read_dataset(folder).sha256, split_holdback(SAMPLES, 0.5)[1], True),
    ):
        facts = {"training_data": json.dumps({"sha256": sha256}), "training": json.dumps(training)}
        model = constant_model(MU, 1.0 / SIGMA, properties={**model_metadata().to_properties(), **facts})
        assert run(model, folder, tmp_path / "out.onnx") == 0
        rms = np.sqrt((errors[rows] ** 2).mean(axis=0))
        expected = np.hypot(2.0 * rms, 0.3) if widened else rms
        np.testing.assert_allclose(sigma_of(tmp_path / "out.onnx"), expected, rtol=1e-4)
        assert ("for other sessions" if widened else "of this session") in capsys.readouterr().out


@pytest.mark.parametrize("holdback", [0.5, 0.0])
def test_of_the_training_data_only_what_was_held_out_is_used(
    folder, constant_model, model_metadata, tmp_path, capsys, holdback
):
    properties = {
        **model_metadata().to_properties(),
        "training_data": json.dumps({"sha256": read_dataset(folder).sha256}),
        "training": json.dumps({"training": {"holdback": holdback}}),
    }
    model = constant_model(MU, 1.0 / SIGMA, properties=properties)
    status = run(model, folder, tmp_path / "out.onnx")
    captured = capsys.readouterr()
    if holdback:
        assert status == 0 and "calibrated on 110 samples" in captured.out
    else:
        assert status == 1 and "trained on all of these data" in captured.err
        assert not (tmp_path / "out.onnx").exists()


def test_a_network_without_uncertainty_is_refused(folder, constant_model, model_metadata, tmp_path, capsys):
    training = json.dumps({"network": {"head": "mse"}})
    model = constant_model(properties={**model_metadata().to_properties(), "training": training})
    assert run(model, folder, tmp_path / "out.onnx") == 1
    assert "has no uncertainty of its own" in capsys.readouterr().err


@pytest.mark.parametrize(
    "change, message", [("knots=3", "unknown name 'knots'"), ("margin=[1]", "6 elements")]
)
def test_unusable_settings_are_told(folder, constant_model, tmp_path, capsys, change, message):
    assert run(constant_model(), folder, tmp_path / "out.onnx", "--set", change) == 1
    assert message in capsys.readouterr().err
