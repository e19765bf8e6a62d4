"""What fusing many pairs at once could gain at most: how long filters take whose fusions cost nothing.

    python bench/fusion_share.py [BAG] [--repeat N]

Each run is made once with its fusions kept, then again and again in turn as it is and with the kept ones in
place of fused ones: the same beliefs, without the time of `fuse`. The ratio of the two is the bound on what
any batch of fusions could gain, however quick. Processor time, the least of all repeats. Runs: a filter
alone over simulated estimates (what a Monte Carlo repeats), the paper's filter experiment on simulated
contacts, and, with a bag, one run of `tactile replay --sweep` with its new bag.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from filter_step import PERIOD_NS, SIGMA, inputs

from tactile_filter import bayes_filter
from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.fusion import FusionResult, fuse
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

COUNT = 4000
MODES = ("paper", "fast")


def least_times(work: Callable[[], Any], repeat: int) -> tuple[float, float]:
    """Seconds that the work takes as it is, and with fusions that cost nothing."""
    kept: list[FusionResult] = []

    def keeping(*args: Any, **options: Any) -> FusionResult:
        kept.append(fuse(*args, **options))
        return kept[-1]

    def recalling() -> Callable[..., FusionResult]:
        results: Iterator[FusionResult] = iter(kept)
        return lambda *args, **options: next(results)

    _timed(work, keeping)
    pairs = [(_timed(work, fuse), _timed(work, recalling())) for _ in range(repeat)]
    plain, free = np.array(pairs).min(axis=0).tolist()
    return plain, free


def _timed(work: Callable[[], Any], replacement: Any) -> float:
    bayes_filter.fuse = replacement
    started = time.process_time()
    work()
    bayes_filter.fuse = fuse
    return time.process_time() - started


def filter_alone(mode: str) -> Callable[[], None]:
    """Steps over simulated estimates."""
    estimates, poses = inputs(COUNT // 2)
    settings = FilterSettings(fusion_mode=mode)

    def work() -> None:
        contact_filter = ContactFilter(settings)
        for k, (estimate, pose) in enumerate(zip(estimates, poses, strict=True)):
            contact_filter.step(k * PERIOD_NS, estimate, pose)

    return work


def filter_experiment(mode: str) -> Callable[[], None]:
    """One sequence of the paper's experiment, at sigma_psi = 0.1, over simulated contacts."""
    from tactile_perception.estimating.labels import label_from_euler, surface_contact_pose
    from tactile_perception.evaluation.filtering import ContactSequence, run_filter

    rng = np.random.default_rng(0)
    low, high = np.array([-5, -5, 0.5, -20, -20, -5]), np.array([5, 5, 6, 20, 20, 5])  # mm, degrees
    euler = rng.uniform(low, high, size=(COUNT, 6))
    labels = np.array([label_from_euler(each) for each in euler])
    poses = [surface_contact_pose(each) for each in euler]
    means = [se3.exp(SIGMA * rng.normal(size=6)) @ se3.inverse(T) for T in poses]
    measurements = [PoseGaussian(mean, np.diag(SIGMA**2)) for mean in means]
    sequence = ContactSequence(np.arange(COUNT), labels, np.array(poses))
    settings = FilterSettings(fusion_mode=mode, gate_probability=1.0)
    return lambda: run_filter(sequence, measurements, 0.1, settings)


def sweep_run(bag: Path, mode: str, folder: Path) -> Callable[[], None]:
    """One run of a sweep, the bag being read already."""
    from tactile_records.bags.reader import read_bag
    from tactile_records.replay.inputs import inputs_of
    from tactile_records.replay.sweep import Options, Plan, base_settings, run_plan
    from tactile_records.replay.topics import wanted_topics

    read = inputs_of(read_bag(bag, wanted_topics))
    settings = {arm: each.replaced(fusion_mode=mode) for arm, each in base_settings(read, None).items()}
    numbers = iter(range(10**6))
    return lambda: run_plan(Plan("one", folder / f"{mode} {next(numbers)}", settings), read, Options())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("bag", type=Path, nargs="?")
    parser.add_argument("--repeat", type=int, default=15)
    arguments = parser.parse_args()
    print("| run | as it is, ms | with free fusions, ms | gain at most |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for mode in MODES:
            runs = {
                f"filter alone, {COUNT} steps": filter_alone(mode),
                f"filter experiment, {COUNT} contacts": filter_experiment(mode),
            }
            if arguments.bag is not None:
                runs["one run of a sweep"] = sweep_run(arguments.bag, mode, Path(folder))
            for name, work in runs.items():
                plain, free = least_times(work, arguments.repeat)
                print(f"| {name}, {mode} | {plain * 1e3:.1f} | {free * 1e3:.1f} | {plain / free:.2f} |")


if __name__ == "__main__":
    main()
