"""What a step of the filter costs, and millions of steps in a row.

    python bench/filter/step.py [--steps N]

First: median and 99th percentile of one call of `ContactFilter.step`, by settings, and of what is around it.
Second: N steps (10 million take 90 s) over a sensor that moves back and forth, in each mode; then how far the
belief is from a pose, from a symmetric positive definite covariance, and from the truth.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import SIGMA, Array, Table, parser, percentiles, taken

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.consistency import ConsistencyMonitor, nees
from tactile_filter.smoother import smooth
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD_NS = 8_000_000
CONTACT = se3.exp([1e-3, 0.0, -3e-3, 0.1, -0.05, 0.0])
VARIANTS: dict[str, dict[str, Any]] = {
    "paper": {},
    "fast": {"fusion_mode": "fast"},
    "exact": {"fusion_mode": "exact"},
    "paper, history 0.25 s": {"history": 0.25},
    "paper, student_t": {"robust": "student_t"},
    "paper, huber": {"robust": "huber"},
}


def inputs(count: int) -> tuple[list[PoseGaussian], list[Array]]:
    """Estimates of a contact that stays, and poses of a sensor that moves there and back."""
    rng = np.random.default_rng(0)
    poses = [np.eye(4)]
    for twist in 1e-4 * rng.normal(size=(count - 1, 6)):
        poses.append(se3.orthonormalized(poses[-1] @ se3.exp(twist)))
    estimates = [
        PoseGaussian(se3.exp(SIGMA * rng.normal(size=6)) @ se3.inverse(T) @ CONTACT, np.diag(SIGMA**2))
        for T in poses
    ]
    return [*estimates, *estimates[-2:0:-1]], [*poses, *poses[-2:0:-1]]


def times_us(call: Callable[[int], Any], count: int) -> list[float]:
    """Median and 99th percentile of one call, us."""
    return percentiles(taken(call, count))


def cost() -> dict[str, list[float]]:
    """Times of one step by settings, and of the parts around it."""
    estimates, poses = inputs(1000)
    size = len(estimates)
    found = {}
    for name, changes in VARIANTS.items():
        contact_filter = ContactFilter(FilterSettings(**changes))
        found[f"step, {name}"] = times_us(
            lambda k, f=contact_filter: f.step(k * PERIOD_NS, estimates[k % size], poses[k % size]), 4 * size
        )
    late = [ContactFilter(FilterSettings(history=0.25)) for _ in range(100)]
    for k in range(60):
        for each in late:
            each.step(k * PERIOD_NS, estimates[k], poses[k])
    found["step that comes 96 ms late, and 12 again"] = times_us(
        lambda k: late[k].step(48 * PERIOD_NS - 1, estimates[47], poses[47]), 100
    )
    monitor, belief = ConsistencyMonitor(), contact_filter.step(5 * size * PERIOD_NS, estimates[0], poses[0])
    found["predict_to"] = times_us(
        lambda k: contact_filter.predict_to(belief.stamp_ns + PERIOD_NS, poses[k % size]), 4 * size
    )
    found["monitor, add"] = times_us(lambda k: monitor.add(belief), 4 * size)
    found["monitor, report"] = times_us(lambda k: monitor.report(), 200)
    plain = ContactFilter()
    beliefs = [plain.step(k * PERIOD_NS, estimates[k], poses[k]) for k in range(size)]
    whole = times_us(lambda k: smooth(beliefs, poses), 3)
    found["smooth, per step"] = [us / size for us in whole]
    return found


def long_run(mode: str, steps: int) -> dict[str, float]:
    """Many steps in a row, and what the belief looks like after them."""
    estimates, poses = inputs(10_000)
    size, contact_filter = len(estimates), ContactFilter(FilterSettings(fusion_mode=mode))
    start = time.perf_counter()
    for k in range(steps):
        belief = contact_filter.step(k * PERIOD_NS, estimates[k % size], poses[k % size])
    seconds = time.perf_counter() - start
    R, deviation = belief.mean[:3, :3], np.sqrt(np.diag(belief.cov))
    truth = se3.inverse(poses[(steps - 1) % size]) @ CONTACT
    return {
        "steps": steps,
        "us a step": 1e6 * seconds / steps,
        "R^T R - I": float(np.abs(R.T @ R - np.eye(3)).max()),
        "det R - 1": float(np.linalg.det(R) - 1.0),
        "asymmetry": float(np.abs(belief.cov - belief.cov.T).max()),
        "smallest eigenvalue of the correlation": float(
            np.linalg.eigvalsh(belief.cov / np.outer(deviation, deviation))[0]
        ),
        "NEES / 6": nees(truth, belief.mean, belief.cov) / 6.0,
        "refused": contact_filter.rejected,
    }


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--steps", type=int, default=1_000_000, help="steps of the long run (1 million)")
    given = arguments.parse_args()
    table = Table(("call", "median, us", "99 %, us"), "of all calls in a row", timed=True)
    for name, times in cost().items():
        table.row(name, *(f"{us:.1f}" for us in times))
    runs = {mode: long_run(mode, given.steps) for mode in ("paper", "fast", "exact")}
    table = Table((f"after {given.steps} steps", *runs), "one run each", timed=True)
    for name in runs["paper"]:
        table.row(name, *(f"{run[name]:.3g}" for run in runs.values()))


if __name__ == "__main__":
    main()
