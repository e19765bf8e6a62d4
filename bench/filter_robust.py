"""What the robust settings of the filter gain and lose, on errors of known kind and on those of a network.

    python bench/filter_robust.py [--data FOLDER --model MODEL] [--seeds N] [--json FILE]

Without data: simulated estimates with normal errors, Student t errors and outliers, all of the same
covariance, of a contact that moves as the filter assumes. Root mean square error relative to that without
a robust setting, and NEES / 6 (1: the covariance means what it claims). With data: the paper's filter
experiment (shuffled images, motion known up to sigma mm and degrees), mean absolute errors in mm and rad.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.consistency import nees
from tactile_filter.smoother import smooth
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.labels import label_from_euler
from tactile_perception.evaluation.filtering import Drift, motion_filter

Array = NDArray[np.float64]

PERIOD_NS = 8_000_000
SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])  # m, rad
CONTACT = se3.exp([1e-3, 0.0, -3e-3, 0.1, -0.05, 0.0])
MOTION_SIGMAS = (1.0, 0.1, 0.01)
VARIANTS: dict[str, dict[str, Any]] = {
    "none": {},
    "student_t, 3": {"robust": "student_t", "student_t_dof": 3.0},
    "student_t, 6": {"robust": "student_t", "student_t_dof": 6.0},
    "student_t, 10": {"robust": "student_t", "student_t_dof": 10.0},
    "huber, 2.5": {"robust": "huber", "huber_threshold": 2.5},
    "huber, 3.55": {"robust": "huber", "huber_threshold": 3.55},
    "gate 0.999": {"gate_probability": 0.999},
}
SMOOTHED = ("none", "student_t, 6")


def normal(rng: np.random.Generator) -> Array:
    return rng.normal(size=6)


def student_t(rng: np.random.Generator, dof: float = 4.0) -> Array:
    return rng.normal(size=6) * np.sqrt((dof - 2.0) / rng.chisquare(dof))


def outliers(rng: np.random.Generator, share: float = 0.05, factor: float = 5.0) -> Array:
    scale = factor if rng.random() < share else 1.0
    return scale * rng.normal(size=6) / np.sqrt(1.0 + share * (factor**2 - 1.0))


def simulated(draw: Callable[[np.random.Generator], Array], variant: dict[str, Any], seeds: int) -> Array:
    """Root mean square error in standard deviations of the estimates, and NEES / 6."""
    ratio = 0.2  # of process noise to estimate, as for a slow motion at 60 Hz
    settings = FilterSettings(
        process_noise_translation=ratio * 4e-4, process_noise_rotation=ratio * 1.2e-2,
        **{"gate_probability": 1.0, **variant},
    )  # fmt: skip
    noise = np.repeat((settings.process_noise_translation, settings.process_noise_rotation), 3)
    errors, squares = [], []
    for seed in range(seeds):
        rng, contact_filter, truth = np.random.default_rng(seed), ContactFilter(settings), CONTACT
        for k in range(2000):
            truth = se3.exp(noise * rng.normal(size=6)) @ truth
            estimate = PoseGaussian(se3.exp(SIGMA * draw(rng)) @ truth, np.diag(SIGMA**2))
            belief = contact_filter.step(k * PERIOD_NS, estimate, np.eye(4))
            errors.append(se3.log(truth @ se3.inverse(belief.mean)) / SIGMA)
            squares.append(nees(truth, belief.mean, belief.cov))
    return np.array((np.sqrt(np.mean(np.square(errors))), np.mean(squares) / 6))


def estimates(data: Path, model: Path) -> tuple[list[PoseGaussian], Array, Array]:
    """Estimates, true poses of the sensor and labels of all images of a folder."""
    from tactile_perception.datasets.dataset import open_folder
    from tactile_perception.estimating.estimator import Estimator
    from tactile_perception.estimating.sources import folder_frames, usable_order

    folder, estimator = open_folder(data), Estimator(model, 1)
    found, poses, labels = [], [], []
    for frame in folder_frames(folder, usable_order(folder, 0, None)):
        estimate = estimator.estimate_processed if frame.processed else estimator.estimate
        if frame.T_base_sensor is None or frame.label is None:
            continue
        found.append(estimate(frame.image))
        poses.append(frame.T_base_sensor)
        labels.append(label_from_euler(frame.label))
    return found, np.array(poses), np.array(labels)


def measured(
    inputs: tuple[list[PoseGaussian], Array, Array],
    sigma: float,
    variant: dict[str, Any],
    seeds: int,
    smoothed: bool = False,
) -> Array:
    """Mean absolute errors (6,) in mm and rad, and NEES / 6, over shuffled sequences."""
    found, poses, labels = inputs
    scale = np.repeat((1e3, 1.0), 3)
    truths = [se3.exp(label / scale) for label in labels]
    errors, squares = [], []
    for seed in range(seeds):
        contact_filter = motion_filter(sigma, FilterSettings(**{"gate_probability": 1.0, **variant}))
        drift, order = Drift(sigma, seed), np.random.default_rng(seed).permutation(len(found))
        drifted = [drift(poses[i]) for i in order]
        beliefs = [
            contact_filter.step(k * PERIOD_NS, found[i], T)
            for k, (i, T) in enumerate(zip(order, drifted, strict=True))
        ]
        if smoothed:
            beliefs = smooth(beliefs, drifted, contact_filter.settings)
        for i, belief in zip(order, beliefs, strict=True):
            errors.append(se3.log(belief.mean) * scale - labels[i])
            squares.append(nees(truths[i], belief.mean, belief.cov))
    return np.append(np.abs(errors).mean(axis=0), np.mean(squares) / 6)


def main() -> int:
    """Measure and print tables in Markdown; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, help="labelled folder of images")
    parser.add_argument("--model", type=Path, help="ONNX model")
    parser.add_argument("--seeds", type=int, default=3, help="sequences that are averaged (3)")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    arguments = parser.parse_args()
    results: dict[str, Any] = {"simulated": {}, "measured": {}}
    kinds = {"normal": normal, "Student t, 4": student_t, "5 % outliers": outliers}
    print("| simulated: error, NEES / 6 | " + " | ".join(kinds) + " |")
    print("| --- " * (1 + len(kinds)) + "|")
    for name, variant in VARIANTS.items():
        row = {kind: simulated(draw, variant, arguments.seeds).tolist() for kind, draw in kinds.items()}
        results["simulated"][name] = row
        cells = [f"{v[0] / results['simulated']['none'][k][0]:.3f}, {v[1]:.2f}" for k, v in row.items()]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    if arguments.data and arguments.model:
        inputs = estimates(arguments.data, arguments.model)
        print("\n| sigma | robust | x | y | z | rx | ry | rz | NEES / 6 |")
        print("| --- " * 9 + "|")
        for sigma in MOTION_SIGMAS:
            runs = [(name, variant, False) for name, variant in VARIANTS.items()]
            runs += [(f"{name}, smoothed", VARIANTS[name], True) for name in SMOOTHED]
            for name, variant, smoothed in runs:
                values = measured(inputs, sigma, variant, arguments.seeds, smoothed)
                results["measured"][f"{sigma} {name}"] = values.tolist()
                cells = [f"{v:.3f}" for v in values[:3]] + [f"{v:.4f}" for v in values[3:6]]
                print(f"| {sigma} | {name} | " + " | ".join(cells) + f" | {values[6]:.2f} |", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
