"""What a fusion costs, and what each shortcut costs in accuracy; both measured in one run.

    python bench/fusion.py [--json FILE] [--quick]

First table: time of one call from Python for each mode in C, of the extension alone, and of the reference in
NumPy. Second: error of the mean in standard deviations of the converged answer, for numbers of iterations and
orders of the inverse Jacobian, by the angle between the two means. Errors are medians over random pairs.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_filter import _fusion, se3
from tactile_filter.fusion import MODES, FusionStatus, fuse
from tactile_filter.fusion_reference import fuse_exact, fuse_fixed

Array = NDArray[np.float64]
Pair = tuple[Array, Array, Array, Array]

SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])  # m, rad: an estimate of the contact
DEGREES = (1, 5, 10, 20, 45, 90, 150)
PLANS: tuple[tuple[int, int | str], ...] = (
    (1, 2), (2, 2), (3, 2), (5, 2), (10, 2), (3, 4), (5, 4), (2, "exact"), (3, "exact"), (5, "exact"),
)  # fmt: skip
TARGET_US, TARGET_RATIO = 5.0, 50.0


def contact_pair() -> Pair:
    """Two estimates of one contact as the filter meets them."""
    rng = np.random.default_rng(0)
    mean = se3.exp([1e-3, 2e-3, -3e-3, 0.1, 0.2, 0.1])
    cov = random_covariance(rng, SIGMA, 0.3)
    return mean, cov, se3.exp(SIGMA * rng.normal(size=6)) @ mean, random_covariance(rng, SIGMA, 0.3)


def random_covariance(rng: np.random.Generator, sigma: Array, spread: float) -> Array:
    """Standard deviations around sigma within factors of 10**spread, correlated if the spread is not zero."""
    factor = np.eye(6) + (spread > 0) * 0.5 * np.tril(rng.uniform(-1, 1, (6, 6)), -1)
    correlated = factor @ factor.T
    scale = sigma * 10.0 ** rng.uniform(-spread, spread, 6) / np.sqrt(np.diag(correlated))
    return correlated * np.outer(scale, scale)


def separated_pair(rng: np.random.Generator, degrees: float, spread: float) -> Pair:
    """Two vague Gaussians (1 rad, 0.1 m) whose means are turned against each other by this angle."""
    axis = rng.normal(size=3)
    turn = np.radians(degrees) * axis / np.linalg.norm(axis)
    sigma = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
    mean = se3.exp(0.1 * rng.normal(size=6))
    between = se3.exp(np.concatenate((0.1 * np.radians(degrees) * rng.normal(size=3), turn)))
    return mean, random_covariance(rng, sigma, spread), between @ mean, random_covariance(rng, sigma, spread)


def microseconds(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Shortest mean time of a batch of calls; the rounds go through all in turn, so all see one load."""
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(rounds):
        for name, call in calls.items():
            count = 5 if name.startswith("NumPy") else 200
            start = time.perf_counter_ns()
            for _ in range(count):
                call()
            best[name] = min(best[name], (time.perf_counter_ns() - start) / count / 1000.0)
    return best


def measure_times(rounds: int) -> dict[str, float]:
    """Microseconds a call, by name."""
    pair = contact_pair()
    calls: dict[str, Callable[[], Any]] = {f"C, {mode}": partial(fuse, *pair, mode) for mode in MODES}
    calls["C, paper, extension alone"] = lambda: _fusion.fuse(*pair, 5, 2)
    calls["C, one iteration, extension alone"] = lambda: _fusion.fuse(*pair, 1, 2)
    calls["NumPy, paper"] = lambda: fuse_fixed(*pair)
    calls["NumPy, fast"] = lambda: fuse_fixed(*pair, 3, "exact")
    calls["NumPy, exact"] = lambda: fuse_exact(*pair)
    return microseconds(calls, rounds)


def sigmas(a: Array, b: Array, factor: Array) -> float:
    """Distance of two poses in standard deviations."""
    return float(np.linalg.norm(np.linalg.solve(factor, se3.log(a @ se3.inverse(b)))))


def measure_errors(spread: float, count: int) -> dict[str, list[float]]:
    """Median error of the mean at each of DEGREES, by plan; pairs without a converged answer are left out."""
    errors: dict[str, list[float]] = {plan_name(*plan): [] for plan in PLANS}
    for degrees in DEGREES:
        rng = np.random.default_rng(degrees)
        found: dict[str, list[float]] = {name: [] for name in errors}
        for _ in range(count):
            pair = separated_pair(rng, degrees, spread)
            exact = fuse(*pair, "exact")
            if exact.status != FusionStatus.CONVERGED:
                continue
            for iterations, order in PLANS:
                mean = fuse(*pair, iterations=iterations, jacobian_order=order).mean
                found[plan_name(iterations, order)].append(sigmas(mean, exact.mean, exact.factor))
        for name, values in found.items():
            errors[name].append(float(np.median(values)))
    return errors


def plan_name(iterations: int, order: int | str) -> str:
    return f"{iterations} x order {order}"


def print_times(times: dict[str, float]) -> None:
    print(f"{'one fusion':36}{'us':>9}{'x faster than NumPy':>22}")
    for name, value in times.items():
        mode = name.split(", ")[1]
        ratio = times.get(f"NumPy, {mode}", 0.0) / value if name.count(",") == 1 and name[0] == "C" else 0.0
        print(f"{name:36}{value:9.2f}{f'{ratio:.0f}' if ratio else '':>22}")


def print_errors(title: str, errors: dict[str, list[float]]) -> None:
    print(f"\n{title}\n{'degrees apart':18}" + "".join(f"{degrees:>10}" for degrees in DEGREES))
    for name, values in errors.items():
        print(f"{name:18}" + "".join(f"{value:10.1e}" for value in values))


def main() -> int:
    """Measure, print, and fail where a target of the documentation is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    options = parser.parse_args()
    times = measure_times(20 if options.quick else 200)
    count = 20 if options.quick else 200
    isotropic, anisotropic = measure_errors(0.0, count), measure_errors(0.5, count)

    print_times(times)
    print_errors("median error of the mean in sigmas, isotropic covariances", isotropic)
    print_errors("the same, sigmas within a factor of 10, correlated", anisotropic)
    if options.json:
        report = {
            "machine": platform.machine(), "python": platform.python_version(), "us_per_call": times,
            "degrees": DEGREES, "error_isotropic": isotropic, "error_anisotropic": anisotropic,
        }  # fmt: skip
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    ratio = times["NumPy, paper"] / times["C, paper"]
    missed = times["C, paper"] > TARGET_US or ratio < TARGET_RATIO
    verdict = "MISSED" if missed else "met"
    print(f"\ntargets: at most {TARGET_US:g} us and {TARGET_RATIO:g} times NumPy: {verdict}")
    return int(missed)


if __name__ == "__main__":
    raise SystemExit(main())
