"""What a fusion costs: ours, our NumPy, GTSAM, and what the machine could do at best; all in one run.

    python bench/fusion.py [--json FILE] [--quick]

GTSAM (`pip install gtsam`) is left out, and the table says so, where it is not installed. The machine's limit
is the number of floating-point instructions of a fusion, counted by running its sources with a number that
counts, times the shortest time of one such instruction on independent data. It needs gcc and g++.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "test" / "filter"))

from fusion_reference import fuse_exact, fuse_fixed

from tactile_filter.fusion import MODES, fuse
from tactile_geometry import se3

Array = NDArray[np.float64]
Pair = tuple[Array, Array, Array, Array]

ROOT = Path(__file__).resolve().parent
SOURCES = ROOT.parent / "tactile_filter" / "_csrc"
SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])  # m, rad: an estimate of the contact
CALL_US, LIMIT_RATIO, GTSAM_RATIO = 2.0, 1.5, 50.0  # targets


def random_covariance(rng: np.random.Generator, sigma: Array, spread: float) -> Array:
    """Standard deviations around sigma within factors of 10**spread, correlated if the spread is not zero."""
    factor = np.eye(6) + (spread > 0) * 0.5 * np.tril(rng.uniform(-1, 1, (6, 6)), -1)
    correlated = factor @ factor.T
    scale = sigma * 10.0 ** rng.uniform(-spread, spread, 6) / np.sqrt(np.diag(correlated))
    return correlated * np.outer(scale, scale)


def contact_pair(seed: int = 0) -> Pair:
    """Two estimates of one contact as the filter meets them."""
    rng = np.random.default_rng(seed)
    mean = se3.exp([1e-3, 2e-3, -3e-3, 0.1, 0.2, 0.1])
    cov = random_covariance(rng, SIGMA, 0.3)
    return mean, cov, se3.exp(SIGMA * rng.normal(size=6)) @ mean, random_covariance(rng, SIGMA, 0.3)


def microseconds(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Shortest mean time of a short series of calls; the rounds go through all in turn: all see one load."""
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(rounds):
        for name, call in calls.items():
            count = {"NumPy": 5, "GTSAM": 20}.get(name.split(",")[0], 200)
            start = time.perf_counter_ns()
            for _ in range(count):
                call()
            best[name] = min(best[name], (time.perf_counter_ns() - start) / count / 1000.0)
    return best


def gtsam_calls(pair: Pair) -> dict[str, Callable[[], Any]]:
    """The same fusion in GTSAM, from arrays to the mean and the covariance, with 5 iterations.

    GTSAM perturbs on the right and puts the rotation first: two priors on the inverse of the pose have our
    errors with the other sign.
    """
    try:
        import gtsam
    except ImportError:
        return {}
    order = [3, 4, 5, 0, 1, 2]
    parameters = gtsam.GaussNewtonParams()
    parameters.setMaxIterations(5)
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    reordered = np.ix_(order, order)

    def graph_and_start() -> Any:
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k, (mean, cov) in enumerate((pair[:2], pair[2:])):
            prior = gtsam.Pose3(se3.inverse(mean))
            graph.add(gtsam.PriorFactorPose3(0, prior, gtsam.noiseModel.Gaussian.Covariance(cov[reordered])))
            if k == 0:
                start.insert(0, prior)
        return graph, start

    def with_covariance() -> Any:
        graph, start = graph_and_start()
        result = gtsam.GaussNewtonOptimizer(graph, start, parameters).optimize()
        return result.atPose3(0), gtsam.Marginals(graph, result).marginalCovariance(0)

    graph, start = graph_and_start()
    optimizer = partial(gtsam.GaussNewtonOptimizer, graph, start, parameters)
    found = se3.inverse(with_covariance()[0].matrix())
    ours = fuse(*pair, "exact")
    distance = np.linalg.norm(np.linalg.solve(ours.factor, se3.log(found @ se3.inverse(ours.mean))))
    assert distance < 1e-3, f"GTSAM answers something else: {distance} standard deviations away"
    return {"GTSAM": with_covariance, "GTSAM, its optimizer alone": lambda: optimizer().optimize()}


def measure_calls(rounds: int) -> dict[str, float]:
    """Microseconds a call from Python, by name."""
    pair = contact_pair()
    calls: dict[str, Callable[[], Any]] = {f"C, {mode}": partial(fuse, *pair, mode) for mode in MODES}
    calls["NumPy, paper"] = lambda: fuse_fixed(*pair)
    calls["NumPy, fast"] = lambda: fuse_fixed(*pair, 3, "exact")
    calls["NumPy, exact"] = lambda: fuse_exact(*pair)
    calls.update(gtsam_calls(pair))
    return microseconds(calls, rounds)


def measure_limit() -> dict[str, float]:
    """What bench/fusion_limit/ answers: peaks in ns an instruction, fusions in ns, counts of instructions."""
    flags = ["-O3", "-std=gnu99", "-ffp-contract=off", f"-I{SOURCES}"]
    sources = [ROOT / "fusion_limit" / "machine.c", *SOURCES.glob("routines*.c")]
    with tempfile.TemporaryDirectory() as folder:
        machine, operations = Path(folder) / "machine", Path(folder) / "operations"
        cc, cxx = os.environ.get("CC", "gcc"), os.environ.get("CXX", "g++")
        subprocess.run([cc, *flags, *sources, SOURCES / "se3.c", "-lm", "-o", machine], check=True)
        counted = [ROOT / "fusion_limit" / "operations.cpp", "-x", "c", SOURCES / "se3.c"]
        subprocess.run([cxx, "-w", f"-I{SOURCES}", *counted, "-lm", "-o", operations], check=True)
        text = "".join(subprocess.check_output([program], text=True) for program in (machine, operations))
    return {name: float(value) for name, value in map(str.split, text.splitlines())}


def print_calls(times: dict[str, float]) -> None:
    print(f"{'one call from Python':28}{'us':>9}{'times NumPy':>14}{'times GTSAM':>14}")
    for name, value in times.items():
        numpy_time = times.get(name.replace("C, ", "NumPy, ")) if name.startswith("C, ") else None
        ratios = [numpy_time, times.get("GTSAM") if name.startswith("C, ") else None]
        columns = "".join(f"{ratio / value:14.0f}" if ratio else f"{'':14}" for ratio in ratios)
        print(f"{name:28}{value:9.2f}{columns}")
    if "GTSAM" not in times:
        print("GTSAM is not installed here: not compared")


def print_limit(limit: dict[str, float]) -> float:
    """Print one fusion against the machine's limit for plain numbers; returns their ratio."""
    count = limit["instructions_5"]
    bound = count * limit["peak_1"]
    ratio = limit["fusion_paper"] / bound
    print(f"\nmode paper: {count:.0f} floating-point instructions, a multiply-add counted once")
    print(f"{'':30}{'ns a fusion':>12}{'limit':>9}{'times limit':>13}")
    print(f"{'one fusion, without Python':30}{limit['fusion_paper']:12.0f}{bound:9.0f}{ratio:13.2f}")
    return ratio


def main() -> int:
    """Measure, print, and fail where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    options = parser.parse_args()
    rounds = 20 if options.quick else 200
    times, limit = measure_calls(rounds), measure_limit()
    print_calls(times)
    ratio = print_limit(limit)
    if options.json:
        report = {
            "machine": platform.machine(), "python": platform.python_version(), "us_per_call": times,
            "limit": limit,
        }  # fmt: skip
        options.json.write_text(json.dumps(report, indent=1) + "\n")

    reached = {
        f"a call from Python under {CALL_US:g} us": times["C, paper"] < CALL_US,
        f"one fusion within {LIMIT_RATIO:g} times the limit": ratio <= LIMIT_RATIO,
    }
    if "GTSAM" in times:
        reached[f"{GTSAM_RATIO:g} times GTSAM"] = times["GTSAM"] >= GTSAM_RATIO * times["C, paper"]
    print("\n" + "\n".join(f"{'met' if met else 'MISSED':8}{target}" for target, met in reached.items()))
    return int(not all(reached.values()))


if __name__ == "__main__":
    raise SystemExit(main())
