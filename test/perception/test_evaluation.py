"""`tactile evaluate` on models and data whose errors and deviations are known."""

import argparse
import csv
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_folder
from scipy.stats import multivariate_normal

from tactile_bringup.commands import evaluate as evaluate_command
from tactile_perception.datasets.dataset import DatasetReport, open_folder
from tactile_perception.estimating.contact_model import SURFACE
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import euler_from_label, network_from_pose
from tactile_perception.estimating.model_metadata import split_holdback, unseen_rows
from tactile_perception.evaluation.evaluate import EvaluationData, assess, evaluate, load_data
from tactile_perception.evaluation.metrics import (
    Predictions,
    accuracy,
    binned,
    by_predicted_sigma,
    consistency,
    coverage,
    euler_error,
    mean_interval,
    moment_matched,
)
from tactile_perception.evaluation.models import open_models
from tactile_perception.evaluation.report import summary

MU = np.array([0.5, -1.0, -3.0, 0.1, -0.2, 0.03])
SIGMA = np.array([0.5, 0.5, 0.1, 0.01, 0.01, 0.02])
SAMPLES = 240
BLACK = np.zeros((480, 640), np.uint8)


def labels_around(mean: np.ndarray, sigma: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    return mean + np.random.default_rng(seed).normal(size=(count, 6)) * sigma


def data_of(labels: np.ndarray) -> EvaluationData:
    euler = np.array([euler_from_label(label) for label in labels])
    names = [f"image_{number}.png" for number in range(len(labels))]
    return EvaluationData(Path("data"), names, labels, euler, {}, "", DatasetReport(Path("data")))


def predictions_of(count: int = 4000, claimed: float = 1.0, seed: int = 0) -> tuple[np.ndarray, Predictions]:
    """Labels and predictions whose errors are 1 / `claimed` times what they say."""
    rng = np.random.default_rng(seed)
    mean = MU + rng.normal(size=(count, 6)) * [2, 2, 1, 0.2, 0.2, 0.05]
    sigma = SIGMA * np.exp(rng.normal(0.0, 0.3, (count, 6)))
    labels = mean + rng.normal(size=(count, 6)) * sigma
    return labels, Predictions(mean, (claimed * sigma)[:, :, np.newaxis] ** 2 * np.eye(6))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Labels around what the constant model answers to every image."""
    path = tmp_path_factory.mktemp("evaluation") / "val"
    squares = np.random.default_rng(3).integers(0, 2, (SAMPLES, 12, 16)) * 255
    images = (np.kron(square, np.ones((40, 40))).astype(np.uint8) for square in squares)
    eulers = map(euler_from_label, labels_around(MU, SIGMA, SAMPLES, seed=1))
    return write_folder(path, zip(images, eulers, strict=True))


def run(data: object, *models: object, out: Path, more: tuple[str, ...] = ()) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    evaluate_command.register(parser.add_subparsers())
    arguments = ["evaluate", *more, "--data", str(data), "--model", *map(str, models), "--out", str(out)]
    parsed = parser.parse_args(arguments)
    return int(parsed.run(parsed))


def test_honest_gaussians_have_nees_one_and_nominal_coverage():
    labels, predictions = predictions_of()
    found = consistency(labels, predictions)
    assert found.joint_interval[0] < found.joint < found.joint_interval[1]
    np.testing.assert_allclose(found.nees, 1.0, atol=0.08)
    np.testing.assert_allclose(found.coverage.mean(axis=1), [0.5, 0.9, 0.95, 0.99], atol=0.008)


def test_overconfidence_shows_with_its_size():
    """Claimed deviations of half the true ones: NEES 4, and 95 % intervals that hold 67 %."""
    labels, predictions = predictions_of(claimed=0.5)
    found = consistency(labels, predictions)
    np.testing.assert_allclose(found.nees, 4.0, rtol=0.08)
    assert found.joint == pytest.approx(4.0, rel=0.04)
    np.testing.assert_allclose(found.coverage[2], 0.673, atol=0.025)


def test_likelihood_and_joint_nees_agree_with_scipy_for_full_covariances():
    rng = np.random.default_rng(0)
    labels = rng.normal(size=(5, 6))
    factors = rng.normal(size=(5, 6, 6)) + 2.0 * np.eye(6)
    covs = factors @ factors.transpose(0, 2, 1)
    found = consistency(labels, Predictions(np.zeros((5, 6)), covs))
    expected = [-multivariate_normal(np.zeros(6), cov).logpdf(x) for x, cov in zip(labels, covs, strict=True)]
    assert found.nll == pytest.approx(np.mean(expected))
    squared = [x @ np.linalg.solve(cov, x) for x, cov in zip(labels, covs, strict=True)]
    assert found.joint == pytest.approx(np.mean(squared) / 6)


def test_errors_agree_with_an_independent_computation():
    labels, predictions = predictions_of(50)
    data = data_of(labels)
    found = accuracy(
        labels,
        euler_error(data.euler_mm_deg, SURFACE.euler(predictions.mean)),
        predictions,
        SURFACE.units,
    )
    mse, mae, euler = 0.0, np.zeros(6), np.zeros(6)
    for label, mean, pose in zip(labels, predictions.mean, data.euler_mm_deg, strict=True):
        mse += (
            sum(w * (a - b) ** 2 for w, a, b in zip([1, 1, 1, 100, 100, 100], label, mean, strict=True)) / 50
        )
        mae += np.abs(label - mean) / 50
        euler += np.abs(euler_from_label(mean) - pose) / 50
    assert found.mse == pytest.approx(mse)
    np.testing.assert_allclose(found.mae, mae)
    np.testing.assert_allclose(found.euler_mae, euler, rtol=1e-9)
    np.testing.assert_allclose(found.bias, (predictions.mean - labels).mean(axis=0))


def test_euler_poses_of_many_are_those_of_each():
    rng = np.random.default_rng(0)
    means = rng.normal(size=(40, 6)) * [3, 3, 3, 0.4, 0.4, 0.1]
    means[:3, 3:] *= [[0.0], [1e-9], [1e-3]]
    expected = np.array([euler_from_label(mean) for mean in means])
    np.testing.assert_allclose(SURFACE.euler(means), expected, rtol=1e-12, atol=1e-12)


def test_coverage_counts_the_central_interval():
    z = np.abs(np.tile([[0.5], [1.0], [1.5], [2.0]], 6))
    np.testing.assert_array_equal(
        coverage(z, np.array([0.5, 0.6827, 0.9])), [[0.25] * 6, [0.5] * 6, [0.75] * 6]
    )


def test_interval_of_the_mean_holds_95_percent_of_such_means():
    means = np.random.default_rng(0).chisquare(6, (4000, 100)).mean(axis=1) / 6
    low, high = mean_interval(100, 6)
    assert ((means > low) & (means < high)).mean() == pytest.approx(0.95, abs=0.012)


def test_bins_hold_every_sample_once_and_their_own_errors():
    labels, predictions = predictions_of(500)
    depth = -labels[:, 2]
    edges = np.linspace(depth.min(), depth.max(), 6)
    bins = binned(labels, predictions, depth, edges)
    assert bins.count.sum() == 500
    inside = (depth >= edges[2]) & (depth < edges[3])
    assert bins.count[2] == inside.sum()
    expected = np.abs(predictions.mean - labels)[inside].mean(axis=0)
    np.testing.assert_allclose(bins.mae[2], expected)
    weighted = (bins.mae * bins.count[:, None]).sum(axis=0) / 500
    np.testing.assert_allclose(weighted, np.abs(predictions.mean - labels).mean(axis=0))


def test_errors_grow_with_the_predicted_deviation_as_predicted():
    labels, predictions = predictions_of(20_000)
    for component, bins in enumerate(by_predicted_sigma(labels, predictions)):
        assert bins.count.sum() == 20_000 and len(bins.count) == 10
        np.testing.assert_allclose(bins.rmse[:, component], bins.sigma[:, component], rtol=0.06)


def test_an_ensemble_has_mean_and_covariance_of_its_mixture():
    members = [predictions_of(3, seed=seed)[1] for seed in range(3)]
    mixture = moment_matched(members)
    rng = np.random.default_rng(0)
    drawn = np.concatenate([rng.multivariate_normal(m.mean[1], m.cov[1], 200_000) for m in members])
    np.testing.assert_allclose(mixture.mean[1], drawn.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(mixture.sigma[1], drawn.std(axis=0), rtol=0.01)
    assert moment_matched([Predictions(member.mean) for member in members]).cov is None


def test_results_are_those_of_the_estimator_image_by_image(folder, constant_model):
    model = constant_model(MU, 1.0 / SIGMA)
    [opened] = open_models([model], threads=1)
    data = load_data(folder, [opened])
    [result] = evaluate(data, [opened])
    estimator, source = Estimator(model), open_folder(folder)
    means = np.array(
        [network_from_pose(estimator.estimate_processed(source.image(k)).mean) for k in range(SAMPLES)]
    )
    np.testing.assert_allclose(result.raw.predictions.mean, means, atol=1e-5)
    np.testing.assert_allclose(result.accuracy.mae, np.abs(means - data.labels).mean(axis=0), atol=1e-5)
    assert result.raw.consistency.joint == pytest.approx(1.0, abs=0.2)


def test_processed_images_of_another_size_are_evaluated(folder, constant_model, tmp_path, capsys):
    shutil.copytree(folder, tmp_path / "other")
    for path in (tmp_path / "other" / "processed_images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:420, :420])
    model = constant_model(MU, 1.0 / SIGMA)
    assert run(tmp_path / "other", model, out=tmp_path / "out", more=("--no-figures",)) == 0
    assert "processed images are 420x420, not 445x440" in capsys.readouterr().err


def test_command_writes_tables_and_figures(folder, constant_model, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(folder, constant_model(MU, 1.0 / SIGMA), out=out, more=("--paper",)) == 0
    printed = capsys.readouterr().out
    for text in ("mean NLL", "rho_x (mm)", "gamma (deg)", "within 95%", "joint", "paper, GDN", "0.4259"):
        assert text in printed
    plain = json.loads((out / "results.json").read_text())
    assert plain["data"]["samples"] == SAMPLES
    mae = np.array(plain["models"][0]["accuracy"]["mae"])
    np.testing.assert_allclose(mae, SIGMA * np.sqrt(2 / np.pi), rtol=0.4)
    with (out / "results.csv").open() as file:
        rows = {(r["quantity"], r["component"]): float(r["value"]) for r in csv.DictReader(file)}
    np.testing.assert_allclose(rows["MAE", "rho_x"], mae[0], rtol=1e-5)
    assert rows["joint NEES / 6", ""] == pytest.approx(
        plain["models"][0]["raw"]["consistency"]["joint"], 1e-5
    )
    for name in (
        "predicted_against_actual",
        "reliability",
        "error_by_sigma",
        "error_by_depth_and_shear",
        "slip",
    ):
        assert (out / f"{name}.png").stat().st_size > 10_000
    assert len((out / "predictions_constant.csv").read_text().splitlines()) == SAMPLES + 1


def test_calibration_data_turn_an_overconfident_model_honest(folder, constant_model, tmp_path, capsys):
    labels = labels_around(MU, SIGMA, 150, seed=9)
    write_folder(tmp_path / "held_out", ((BLACK, euler_from_label(label)) for label in labels))
    model = constant_model(MU, 3.0 / SIGMA)
    more = ("--json", "--no-figures", "--calibrate", str(tmp_path / "held_out"))
    assert run(folder, model, out=tmp_path / "out", more=more) == 0
    [result] = json.loads(capsys.readouterr().out)["models"]
    assert result["raw"]["consistency"]["joint"] == pytest.approx(9.0, rel=0.2)
    assert result["calibrated"]["consistency"]["joint"] == pytest.approx(1.0, abs=0.2)
    assert result["calibration"].startswith("fitted on 150 samples")


def test_data_that_calibrate_themselves_do_so_half_by_half(folder, constant_model):
    models = open_models([constant_model(MU, 3.0 / SIGMA)], threads=1)
    data = load_data(folder, models)
    [result] = evaluate(data, models, calibration_data=data)
    assert len(np.unique(result.calibrated.predictions.sigma[:, 0].round(6))) == 2
    for sigma in np.unique(result.calibrated.predictions.sigma[:, 0]):
        other = result.calibrated.predictions.sigma[:, 0] != sigma
        rms = np.sqrt(((data.labels[other, 0] - MU[0]) ** 2).mean())
        assert sigma == pytest.approx(rms, rel=1e-4)


def test_means_and_deviations_over_models_are_the_samples_own(constant_model, folder, tmp_path):
    for seed, shift in enumerate((0.0, 0.3)):
        (tmp_path / f"run_{seed}").mkdir()
        constant_model(MU + shift * SIGMA, 1.0 / SIGMA).rename(tmp_path / f"run_{seed}" / "model.onnx")
    models = open_models([tmp_path], threads=1)
    assert [model.name for model in models] == ["run_0", "run_1"]
    data = load_data(folder, models)
    results = evaluate(data, models, ensemble=True)
    plain = summary(data, results)["groups"]
    maes = np.array([result.accuracy.mae for result in results[:2]])
    np.testing.assert_allclose(plain["GDN"]["mae"]["mean"], maes.mean(axis=0))
    np.testing.assert_allclose(plain["GDN"]["mae"]["deviation"], np.abs(maes[0] - maes[1]) / np.sqrt(2))
    ensemble = results[2].raw.predictions
    np.testing.assert_allclose(ensemble.mean[0], MU + 0.15 * SIGMA, rtol=1e-4)
    np.testing.assert_allclose(ensemble.sigma[0], SIGMA * np.sqrt(1.0 + 0.15**2), rtol=1e-4)


def test_models_trained_in_another_way_are_another_column(constant_model, model_metadata, tmp_path):
    def metadata(seed: int, channels: int) -> dict[str, str]:
        found = {"axis_found": {"x": seed}}  # what training found is no setting
        training = json.dumps({"network": {"channels": [channels]}, "training": {"seed": seed}, **found})
        return {**model_metadata().to_properties(), "training": training}

    paths = []
    for seed, channels in ((0, 8), (1, 8), (0, 16)):
        path = tmp_path / f"{seed}_{channels}.onnx"
        constant_model(properties=metadata(seed, channels)).rename(path)
        paths.append(path)
    kinds = [model.kind for model in open_models(paths, threads=1)]
    assert kinds == ["GDN (channels [8])", "GDN (channels [8])", "GDN (channels [16])"]


def test_a_network_without_uncertainty_gets_errors_but_no_reliability():
    labels, predictions = predictions_of(200)
    result = assess("cnn", "CNN", data_of(labels), Predictions(predictions.mean))
    assert result.raw.consistency is None and result.raw.by_sigma is None
    assert np.isfinite(result.accuracy.mae).all() and np.isnan(result.raw.by_depth.sigma).all()
    with pytest.raises(ValueError, match="have no uncertainty"):
        consistency(labels, Predictions(predictions.mean))


def test_the_papers_cnn_has_a_column_without_likelihood(
    folder, constant_model, model_metadata, tmp_path, capsys
):
    training = json.dumps({"network": {"head": "mse"}})
    cnn = constant_model(MU, properties={**model_metadata().to_properties(), "training": training})
    cnn = cnn.rename(tmp_path / "cnn.onnx")
    more = ("--json", "--no-figures", "--ensemble")
    assert run(folder, cnn, constant_model(MU, 1.0 / SIGMA), out=tmp_path / "out", more=more) == 0
    first, second = json.loads(capsys.readouterr().out)["models"]
    assert (first["kind"], second["kind"]) == ("CNN", "GDN")
    assert "consistency" not in first["raw"] and "consistency" in second["raw"]
    assert first["accuracy"] == second["accuracy"]


@pytest.mark.parametrize("option", ["--data", "--calibrate"])
def test_training_data_are_not_taken_for_a_test(
    folder, constant_model, model_metadata, tmp_path, capsys, option
):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    (other / "targets_images.csv").write_text((folder / "targets_images.csv").read_text().replace("0", "1"))
    sha = load_data(folder, open_models([constant_model()], threads=1)).sha256
    properties = {**model_metadata().to_properties(), "training_data": json.dumps({"sha256": sha})}
    model = constant_model(MU, properties=properties)
    data, more = (folder, ()) if option == "--data" else (other, ("--calibrate", str(folder)))
    assert run(data, model, out=tmp_path / "out", more=("--no-figures", *more)) == 1
    assert "was trained on all of these data" in capsys.readouterr().err


def test_of_training_data_only_what_was_held_out_is_evaluated(
    folder, constant_model, model_metadata, tmp_path
):
    sha = load_data(folder, open_models([constant_model()], threads=1)).sha256
    properties = {
        **model_metadata().to_properties(),
        "training_data": json.dumps({"sha256": sha}),
        "training": json.dumps({"training": {"holdback": 0.25}}),
    }
    data = load_data(folder, open_models([constant_model(MU, properties=properties)], threads=1))
    [note] = data.notes
    assert note.startswith(f"only the {SAMPLES // 4} samples held out from training")
    whole = load_data(folder, open_models([constant_model()], threads=1))
    np.testing.assert_array_equal(data.labels, whole.labels[split_holdback(SAMPLES, 0.25)[1]])


@pytest.mark.parametrize("own, part", [("same", 0.1), ("other", 0.3)])
def test_data_of_the_network_that_training_started_from_count_as_seen(model_metadata, own, part):
    start = {"sha256": "same", "holdback": 0.3}
    metadata = dataclasses.replace(
        model_metadata(),
        training_data={"sha256": own, "start": start},
        training={"training": {"holdback": 0.1}},
    )
    np.testing.assert_array_equal(unseen_rows(metadata, "same", 100), split_holdback(100, part)[1])
    assert len(unseen_rows(metadata, "new", 100)) == 100


@pytest.mark.parametrize("count", [100, 103])
def test_folds_hold_out_each_row_once(model_metadata, count):
    parts = [split_holdback(count, 0.2, fold) for fold in range(5)]
    np.testing.assert_array_equal(np.sort(np.concatenate([each for _, each in parts])), np.arange(count))
    for fold, (kept, rows) in enumerate(parts):
        np.testing.assert_array_equal(np.sort(np.concatenate([kept, rows])), np.arange(count))
        training = {"training": {"holdback": 0.2, "fold": fold}}
        metadata = dataclasses.replace(model_metadata(), training_data={"sha256": "same"}, training=training)
        np.testing.assert_array_equal(unseen_rows(metadata, "same", count), rows)


def test_a_limit_takes_samples_from_the_whole_table(folder, constant_model):
    data = load_data(folder, open_models([constant_model()], threads=1), limit=10)
    assert len(data) == 10 and data.names[0] == "image_1.png" and data.names[-1] == f"image_{SAMPLES}.png"


def test_a_missing_model_is_told(folder, tmp_path, capsys):
    assert run(folder, tmp_path / "nowhere", out=tmp_path / "out") == 1
    assert "there is no such run folder or model file" in capsys.readouterr().err


def test_a_run_without_a_model_is_told(folder, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    assert run(folder, tmp_path / "run", out=tmp_path / "out") == 1
    assert "holds no model.onnx, nor do its subfolders" in capsys.readouterr().err


def test_data_without_labels_are_told(constant_model, tmp_path, capsys):
    (tmp_path / "data" / "processed_images").mkdir(parents=True)
    assert run(tmp_path / "data", constant_model(), out=tmp_path / "out") == 1
    assert "has no targets_images.csv" in capsys.readouterr().err


def test_a_folder_of_parts_names_them(folder, constant_model, tmp_path, capsys):
    assert run(folder.parent, constant_model(), out=tmp_path / "out") == 1
    assert "holds the parts val; evaluate one of them" in capsys.readouterr().err


def test_a_model_that_fails_on_an_image_is_told(folder, constant_model, tmp_path, capsys):
    assert run(folder, constant_model((np.nan,) * 6), out=tmp_path / "out") == 1
    assert "must be finite" in capsys.readouterr().err
