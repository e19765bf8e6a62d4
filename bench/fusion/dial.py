"""What each shortcut of the fusion costs in accuracy, and what it saves: the dial between speed and accuracy.

    python bench/fusion/dial.py [--rounds 300] [--plot docs/images/fusion_dial.png]

Numbers of iterations and orders of the inverse Jacobian against the converged exact answer (mode "exact"),
at angles between the means from 1 to 179 degrees, for isotropic and strongly anisotropic covariances. Errors
are medians over random pairs: of the mean in posterior standard deviations, of the covariance as the largest
error of an element relative to the standard deviations of its row and column. Times (ns) are of one call from
Python with estimates of a contact, the best of so many rounds.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Array, Table, best, contact_pair, parser, random_covariance

from tactile_filter.fusion import FusionResult, FusionStatus, fuse
from tactile_geometry import se3

Pair = tuple[Array, Array, Array, Array]

DEGREES = (1, 2, 5, 10, 20, 45, 90, 135, 179)
SHOWN = (1, 5, 20, 45, 90, 179)
VAGUE = np.repeat([0.1, 1.0], 3)  # m, rad: so vague that means far apart may belong to one pose


class Plan(NamedTuple):
    """One position of the dial; `iterations` None stands for mode exact."""

    iterations: int | None
    order: int | str = "exact"

    @property
    def name(self) -> str:
        """As in the tables."""
        return "exact" if self.iterations is None else f"{self.iterations} x {self.order}"

    def fuse(self, pair: Pair) -> FusionResult:
        """The fusion itself."""
        if self.iterations is None:
            return fuse(*pair, "exact")
        return fuse(*pair, iterations=self.iterations, jacobian_order=self.order)


PLANS = [Plan(n, order) for order in (2, 4, "exact") for n in range(1, 11)]
PLANS += [Plan(None)]
TABLE = [Plan(n, 2) for n in (1, 2, 3, 5, 10)] + [Plan(n, 4) for n in (3, 5, 10)]
TABLE += [Plan(n) for n in (2, 3, 4, 5, 10)]
TABLE += [Plan(None)]


def separated(degrees: float, spread: float, count: int) -> list[Pair]:
    """Pairs whose means are turned against each other by this angle and shifted in proportion."""
    rng = np.random.default_rng(int(degrees))
    pairs = []
    for _ in range(count):
        axis = rng.normal(size=3)
        turn = np.radians(degrees) * axis / np.linalg.norm(axis)
        mean = se3.exp(0.1 * rng.normal(size=6))
        between = se3.exp(np.concatenate((0.1 * np.radians(degrees) * rng.normal(size=3), turn)))
        covs = [random_covariance(rng, VAGUE, spread) for _ in range(2)]
        pairs.append((mean, covs[0], between @ mean, covs[1]))
    return pairs


def errors(pairs: list[Pair]) -> dict[str, tuple[float, float]]:
    """Median error of the mean and of the covariance, by plan; pairs that do not converge are left out."""
    fused = [(pair, fuse(*pair, "exact")) for pair in pairs]
    converged = [(pair, exact) for pair, exact in fused if exact.status == FusionStatus.CONVERGED]
    found = {}
    for plan in PLANS:
        of_mean, of_cov = [], []
        for pair, exact in converged:
            mean, cov = plan.fuse(pair)[:2]
            xi = se3.log(se3.orthonormalized(mean) @ se3.inverse(exact.mean))
            sigma = np.sqrt(np.diag(exact.cov))
            of_mean.append(np.linalg.norm(np.linalg.solve(exact.factor, xi)))
            of_cov.append(np.abs((cov - exact.cov) / np.outer(sigma, sigma)).max())
        found[plan.name] = float(np.median(of_mean)), float(np.median(of_cov))
    return found


def times(rounds: int) -> dict[str, float]:
    """Nanoseconds a fusion of one of 64 pairs of estimates of a contact, by plan."""
    rng = np.random.default_rng(0)
    pairs = [contact_pair(rng) for _ in range(64)]
    calls = {plan.name: partial(_all, plan, pairs) for plan in PLANS}
    return {name: 1e3 * us / len(pairs) for name, us in best(calls, rounds, lambda _: 1).items()}


def _all(plan: Plan, pairs: list[Pair]) -> None:
    for pair in pairs:
        plan.fuse(pair)


def plot(
    path: Path, kinds: dict[str, dict[int, dict[str, tuple[float, float]]]], ns: dict[str, float]
) -> None:
    """Error of the mean over time, a line an order, a panel an angle."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown, floor = (5, 20, 45, 135), 1e-16
    figure, axes = plt.subplots(2, len(shown), figsize=(11, 5), sharex=True, sharey=True)
    series = [("order 2", 2, "o-"), ("order 4", 4, "s-"), ("exact", "exact", "^-")]
    for row, (kind, by_angle) in zip(axes, kinds.items(), strict=True):
        for axis, degrees in zip(row, shown, strict=True):
            for label, order, style in series:
                plans = [plan for plan in PLANS if plan.iterations and plan.order == order]
                values = [max(by_angle[degrees][plan.name][0], floor) for plan in plans]
                axis.loglog([ns[plan.name] for plan in plans], values, style, label=label, ms=4, lw=1)
            axis.plot(ns["exact"], max(by_angle[degrees]["exact"][0], floor), "k*", label="mode exact", ms=9)
            axis.axhline(0.01, color="0.6", lw=0.8)
            axis.set_title(f"{kind}, {degrees}° apart", fontsize=9)
            axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("ns a call from Python")
    for row in axes:
        row[0].set_ylabel("error of the mean, sigmas")
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--rounds", type=int, default=300, help="of the times")
    arguments.add_argument("--pairs", type=int, default=150, help="of means at each angle")
    arguments.add_argument("--plot", type=Path, help="draw them")
    given = arguments.parse_args()
    ns = times(given.rounds)
    kinds = {
        kind: {degrees: errors(separated(degrees, spread, given.pairs)) for degrees in DEGREES}
        for kind, spread in (("isotropic", 0.0), ("anisotropic", 1.0))
    }
    for kind, by_angle in kinds.items():
        for which, what in enumerate(("of the mean", "of the covariance")):
            first = f"{kind}, error {what}"
            table = Table(
                (first, "ns", *(f"{d}°" for d in SHOWN)),
                f"medians of {given.pairs} pairs; ns: best of {given.rounds}",
            )
            for plan in TABLE:
                shown = (f"{by_angle[d][plan.name][which]:.0e}" for d in SHOWN)
                table.row(plan.name, f"{ns[plan.name]:.0f}", *shown)
    if given.plot:
        plot(given.plot, kinds, ns)


if __name__ == "__main__":
    main()
