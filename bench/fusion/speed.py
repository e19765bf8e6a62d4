"""What a fusion costs: ours, our NumPy and GTSAM, in turn in one run.

    python bench/fusion/speed.py [--rounds 200] [--without-gtsam]

Each time is the best of so many rounds. GTSAM's whole call builds its graph in Python; its optimizer alone is
its own C++. Needs GTSAM (`pip install gtsam`), or --without-gtsam.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.extend(
    str(Path(__file__).resolve().parents[2] / name) for name in ("bench", "test/filter", "test/geometry")
)

from fusion_reference import fuse_exact, fuse_fixed
from shared import Array, Table, best, contact_pair, needs, parser

from tactile_filter.fusion import MODES, fuse
from tactile_geometry import se3

CALL_US = 2.0  # target of one call from Python
WHOLE, ALONE = "GTSAM, graph built in Python", "GTSAM, its optimizer alone"


def gtsam_calls(pair: tuple[Array, Array, Array, Array]) -> dict[str, Callable[[], Any]]:
    """The same in GTSAM: two priors, 5 Gauss-Newton iterations, the marginal covariance; its answer checked.

    GTSAM perturbs on the right and puts rotation first: a prior on the inverse pose has our covariance.
    """
    import gtsam

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
    return {WHOLE: with_covariance, ALONE: lambda: optimizer().optimize()}


def main() -> int:
    """Measure and print; fails where a call misses its target."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--rounds", type=int, default=200)
    arguments.add_argument("--without-gtsam", action="store_true", help="compare with NumPy alone")
    given = arguments.parse_args()
    if not given.without_gtsam:
        needs("pip install gtsam, or --without-gtsam", "gtsam")
    pair = contact_pair(np.random.default_rng(0))
    calls: dict[str, Callable[[], Any]] = {f"C, {mode}": partial(fuse, *pair, mode) for mode in MODES}
    calls["NumPy, paper"] = lambda: fuse_fixed(*pair)
    calls["NumPy, fast"] = lambda: fuse_fixed(*pair, 3, "exact")
    calls["NumPy, exact"] = lambda: fuse_exact(*pair)
    if not given.without_gtsam:
        calls |= gtsam_calls(pair)
    times = best(calls, given.rounds, lambda name: {"NumPy": 5, "GTSAM": 20}.get(name.split(",")[0], 200))
    others = ["NumPy", *([] if given.without_gtsam else [WHOLE, ALONE])]
    heads = ("one call from Python", "us", *(f"times {name}" for name in others))
    table = Table(heads, f"best of {given.rounds} rounds", timed=True)
    for name, value in times.items():
        ratios = [times.get(other, times.get(name.replace("C", other))) for other in others]
        ours = name.startswith("C, ")
        table.row(name, f"{value:.2f}", *(f"{ratio / value:.0f}" if ours else "" for ratio in ratios))
    met = times["C, paper"] < CALL_US
    print(f"\n{'met' if met else 'MISSED'}: a call in mode paper under {CALL_US:g} us")
    return int(not met)


if __name__ == "__main__":
    raise SystemExit(main())
