"""What a step of the filter costs, and millions of steps in a row.

    python bench/filter_step.py [--steps N] [--json FILE]

First: median and 99th percentile of one call of `ContactFilter.step`, by settings, and of what is around it.
Second: N steps (10 million take 90 s) over a sensor that moves back and forth, in each mode; then how far the
belief is from a pose, from a symmetric positive definite covariance, and from the truth.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.consistency import ConsistencyMonitor, nees
from tactile_filter.smoother import smooth
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]

PERIOD_NS = 8_000_000
SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])  # m, rad
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


def times_us(call: Any, count: int) -> tuple[float, float]:
    """Median and 99th percentile of one call, us."""
    taken = []
    for k in range(count):
        start = time.perf_counter_ns()
        call(k)
        taken.append(time.perf_counter_ns() - start)
    return float(np.median(taken)) / 1e3, float(np.percentile(taken, 99)) / 1e3


def cost() -> dict[str, tuple[float, float]]:
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
    found["smooth, per step"] = (whole[0] / size, whole[1] / size)
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


def main() -> int:
    """Measure and print tables in Markdown; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_000_000, help="steps of the long run (1 million)")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    arguments = parser.parse_args()
    costs = cost()
    print("| call | median, us | 99 %, us |\n| --- | --- | --- |")
    for name, (median, tail) in costs.items():
        print(f"| {name} | {median:.1f} | {tail:.1f} |")
    runs = {mode: long_run(mode, arguments.steps) for mode in ("paper", "fast", "exact")}
    print("\n| after many steps | " + " | ".join(runs) + " |")
    print("| --- " * (len(runs) + 1) + "|")
    for name in runs["paper"]:
        print(f"| {name} | " + " | ".join(f"{run[name]:.3g}" for run in runs.values()) + " |")
    if arguments.json:
        arguments.json.write_text(json.dumps({"cost_us": costs, "long": runs}, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
