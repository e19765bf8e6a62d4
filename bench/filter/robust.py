"""What the robust settings of the filter gain and lose on errors of known kind.

    python bench/filter/robust.py [--seeds 2]

Simulated estimates with normal errors, Student t errors and outliers, all of the same covariance, of a
contact that moves as the filter assumes. Root mean square error relative to that without a robust setting,
and NEES / 6 (1: the covariance means what it claims).
On a network's errors: `tactile evaluate filter --set robust=...`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import SIGMA, Array, Table, parser

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.consistency import nees
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD_NS = 8_000_000
CONTACT = se3.exp([1e-3, 0.0, -3e-3, 0.1, -0.05, 0.0])
VARIANTS: dict[str, dict[str, Any]] = {
    "none": {},
    "student_t, 3": {"robust": "student_t", "student_t_dof": 3.0},
    "student_t, 6": {"robust": "student_t", "student_t_dof": 6.0},
    "student_t, 10": {"robust": "student_t", "student_t_dof": 10.0},
    "huber, 2.5": {"robust": "huber", "huber_threshold": 2.5},
    "huber, 3.55": {"robust": "huber", "huber_threshold": 3.55},
    "gate at 0.999": {"gate_probability": 0.999},
}


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


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--seeds", type=int, default=2, help="sequences that are averaged (2)")
    given = arguments.parse_args()
    kinds = {"normal errors": normal, "Student t, 4 dof": student_t, "5 % outliers of 5 sigma": outliers}
    table, plain = Table(("error, NEES / 6", *kinds), f"over seeds 0 to {given.seeds - 1}"), {}
    for name, variant in VARIANTS.items():
        found = {kind: simulated(draw, variant, given.seeds) for kind, draw in kinds.items()}
        plain = plain or found
        table.row(name, *(f"{v[0] / plain[kind][0]:.3f}, {v[1]:.2f}" for kind, v in found.items()))


if __name__ == "__main__":
    main()
