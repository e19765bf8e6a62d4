"""`tactile evaluate filter`: the paper's filter experiment on predictions whose errors are known."""

import argparse
import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from folders import write_folder

from tactile_bringup.commands import evaluate as evaluate_command
from tactile_filter.bayes_filter import FilterSettings
from tactile_perception.datasets.dataset import DatasetReport, open_folder
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import labels_from_euler
from tactile_perception.estimating.run import run_estimates
from tactile_perception.estimating.sources import folder_frames, usable_order
from tactile_perception.evaluation.evaluate import EvaluationData, assess, evaluate, load_data
from tactile_perception.evaluation.filter_experiment import Experiment, run_experiment
from tactile_perception.evaluation.filtering import (
    contact_sequence,
    estimate_process_noise,
    motion_filter,
    pose_gaussians,
    run_filter,
    with_motion_noise,
)
from tactile_perception.evaluation.metrics import Predictions
from tactile_perception.evaluation.models import open_models
from tactile_perception.evaluation.report import paper_tables

SIGMA = np.array([0.5, 0.5, 0.1, 0.01, 0.01, 0.02])


def simulated(count: int, claimed: float = 1.0, seed: int = 0) -> tuple[EvaluationData, Predictions]:
    """Contacts sorted by depth, and predictions whose errors are 1 / `claimed` times what they say."""
    rng = np.random.default_rng(seed)
    low, high = [-4, -4, 0.5, -15, -15, -5], [4, 4, 6, 15, 15, 5]
    euler = rng.uniform(low, high, (count, 6))
    euler = euler[np.argsort(euler[:, 2])]
    labels = labels_from_euler(euler)
    sigma = SIGMA * np.exp(rng.normal(0.0, 0.4, (count, 6)))
    mean = labels + rng.normal(size=(count, 6)) * sigma
    names = [str(number) for number in range(count)]
    data = EvaluationData(Path("data"), names, labels, euler, {}, "", DatasetReport(Path("data")))
    return data, Predictions(mean, (claimed * sigma)[:, :, np.newaxis] ** 2 * np.eye(6))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    data, _ = simulated(40)
    black = np.zeros((480, 640), np.uint8)
    return write_folder(
        tmp_path_factory.mktemp("filter") / "val", ((black, euler) for euler in data.euler_mm_deg)
    )


def run(data: Path, model: Path, out: Path, *more: str) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    evaluate_command.register(parser.add_subparsers())
    arguments = ["evaluate", "filter", "--data", str(data), "--model", str(model), "--out", str(out), *more]
    parsed = parser.parse_args(arguments)
    return int(parsed.run(parsed))


def test_the_better_the_motion_is_known_the_smaller_the_errors():
    data, predictions = simulated(250)
    experiment = Experiment(sigmas=(math.inf, 10.0, 1.0, 0.1, 0.01))
    found = run_experiment(data, [assess("model", "GDN", data, predictions)], experiment)
    maes = np.array([entry.mae for entry in found])
    np.testing.assert_allclose(maes[0], np.abs(predictions.mean - data.labels).mean(axis=0))
    assert np.all(np.diff(maes[[0, 2, 3, 4], :2], axis=0) < 0.0)
    assert np.all(maes[4] < 0.5 * maes[0])


def test_beliefs_of_honest_predictions_are_honest_and_of_overconfident_ones_are_not():
    for claimed, expected in ((1.0, 1.0), (0.5, 4.0)):
        data, predictions = simulated(400, claimed)
        sequence = contact_sequence(data, 0.5, seed=0)
        found = run_filter(sequence, pose_gaussians(predictions), 0.5)
        if claimed == 1.0:
            assert found.nees == pytest.approx(expected, abs=0.12)
            assert found.nis == pytest.approx(expected, abs=0.12)
        else:
            assert found.nees > 1.7 and found.nis > 1.7


def test_order_is_shuffled_by_the_seed():
    data, _ = simulated(100)
    first, again, other = (contact_sequence(data, 1.0, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.order, again.order)
    np.testing.assert_array_equal(first.T_surface_sensor, again.T_surface_sensor)
    assert sorted(first.order) == list(range(100)) and (first.order != other.order).any()
    assert abs(np.corrcoef(data.euler_mm_deg[first.order, 2], np.arange(100))[0, 1]) < 0.3


def test_process_noise_is_found_back_from_honest_predictions():
    data, predictions = simulated(400)
    for sigma in (1.0, 0.1):
        estimated = estimate_process_noise(contact_sequence(data, sigma, 0), pose_gaussians(predictions))
        assert estimated == pytest.approx(sigma, rel=0.2)


def test_results_are_those_of_the_estimate_command(folder, constant_model):
    """The other way to the same numbers: image by image, through the estimator."""
    model = constant_model((0.3, -0.5, -3.0, 0.05, 0.1, 0.01), 1.0 / SIGMA)
    models = open_models([model], threads=1)
    data = load_data(folder, models)
    [entry] = run_experiment(data, evaluate(data, models), Experiment(sigmas=(0.5,), seeds=(7,)))
    source = open_folder(folder)
    frames = with_motion_noise(folder_frames(source, usable_order(source, 7, None)), 0.5, 7)
    table = run_estimates(Estimator(model), frames, motion_filter(0.5))
    np.testing.assert_allclose(entry.mae, table.mean_absolute_error(table.filtered), rtol=1e-5)


def test_settings_of_the_filter_are_its_own():
    data, predictions = simulated(60)
    sequence = contact_sequence(data, 1.0, 0)
    measurements = pose_gaussians(predictions)
    paper = run_filter(sequence, measurements, 1.0)
    gated = run_filter(sequence, measurements, 1.0, FilterSettings(gate_probability=0.5))
    assert np.abs(paper.mean - gated.mean).max() > 1e-3


def test_results_are_means_over_orders():
    data, predictions = simulated(60)
    result = [assess("model", "GDN", data, predictions)]
    both = run_experiment(data, result, Experiment(sigmas=(1.0,), seeds=(3, 4)))[0]
    single = [run_experiment(data, result, Experiment(sigmas=(1.0,), seeds=(seed,)))[0] for seed in (3, 4)]
    np.testing.assert_allclose(both.mae, np.mean([entry.mae for entry in single], axis=0))
    assert both.nees == pytest.approx(np.mean([entry.nees for entry in single]))


def test_the_papers_table_is_there_to_compare_with():
    tables = paper_tables()
    assert tables.filter[0.01][5] == 0.0019 and tables.filter[math.inf][0] == 0.4259
    np.testing.assert_array_equal(tables.filter[math.inf], tables.networks["GDN"][1])


def test_command_writes_table_and_figure(folder, constant_model, tmp_path, capsys):
    model = constant_model((0.0, 0.0, -3.0, 0.0, 0.0, 0.0), 1.0 / SIGMA)
    out = tmp_path / "out"
    assert run(folder, model, out, "--sigma", "inf", "0.1", "--paper", "--estimate-noise") == 0
    printed = capsys.readouterr().out
    for text in ("phi_z (rad)", "sigma_phi equal", "sigma_phi estimated", "NIS / 6", "0.1603)"):
        assert text in printed
    with (out / "filter.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["sigma_psi"], row["noise"]) for row in rows] == [
        ("inf", "equal"),
        ("0.1", "equal"),
        ("0.1", "estimated"),
    ]
    assert float(rows[1]["mae_rho_x_mm"]) > 0.0 and rows[0]["nis_per_dof"] == ""
    assert (out / "filter_GDN.png").stat().st_size > 10_000


def test_json_holds_every_number(folder, constant_model, tmp_path, capsys):
    model = constant_model((0.0, 0.0, -3.0, 0.0, 0.0, 0.0), 1.0 / SIGMA)
    assert run(folder, model, tmp_path / "out", "--sigma", "inf", "1", "--json", "--no-figures") == 0
    results = json.loads(capsys.readouterr().out)["results"]
    assert [entry["sigma_psi"] for entry in results] == ["inf", 1.0]
    assert results[0]["nis"] is None and len(results[1]["mae"]) == 6


def test_a_network_without_uncertainty_is_nothing_to_filter(
    folder, constant_model, model_metadata, tmp_path, capsys
):
    training = json.dumps({"network": {"head": "mse"}})
    model = constant_model(properties={**model_metadata().to_properties(), "training": training})
    assert run(folder, model, tmp_path / "out") == 1
    assert "none of the models says how uncertain it is" in capsys.readouterr().err


@pytest.mark.parametrize(
    "more, message",
    [
        (("--sigma", "0"), "--sigma 0: must be positive, or inf"),
        (("--sigma", "nan"), "--sigma nan: must be positive, or inf"),
        (("--set", "fusion=exact"), "unknown name 'fusion'"),
    ],
)
def test_unusable_arguments_are_told(folder, constant_model, tmp_path, capsys, more, message):
    assert run(folder, constant_model(), tmp_path / "out", *more) == 1
    assert message in capsys.readouterr().err
