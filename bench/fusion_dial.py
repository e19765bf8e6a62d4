"""What each shortcut of the fusion costs in accuracy, and what it saves: the dial between speed and accuracy.

    python bench/fusion_dial.py [--quick] [--json FILE] [--plot docs/images/fusion_dial.png]

Numbers of iterations, orders of the inverse Jacobian and precisions against the converged exact answer (mode
"exact", float64), at angles between the means from 1 to 179 degrees, for isotropic and strongly anisotropic
covariances. Errors are medians over random pairs: of the mean in posterior standard deviations, of the
covariance as the largest error of an element relative to the standard deviations of its row and column. Times
are of one fusion in a batch of estimates of contacts, in nanoseconds.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_filter import se3
from tactile_filter.fusion import FusionBatch, FusionStatus, fuse_batch

Array = NDArray[np.float64]
Columns = list[Array]

DEGREES = (1, 2, 5, 10, 20, 45, 90, 135, 179)
SHOWN = (1, 5, 20, 45, 90, 179)
SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])  # m, rad: an estimate of the contact
VAGUE = np.repeat([0.1, 1.0], 3)  # m, rad: so vague that means far apart may belong to one pose


class Plan(NamedTuple):
    """One position of the dial; `iterations` None stands for mode exact."""

    iterations: int | None
    order: int | str = "exact"
    dtype: type[np.floating] = np.float64

    @property
    def name(self) -> str:
        """As in the tables."""
        steps = "exact" if self.iterations is None else f"{self.iterations} x {self.order}"
        return steps + ("" if self.dtype is np.float64 else ", float32")

    def fuse(self, columns: Columns) -> tuple[Array, Array]:
        """Means and covariances, float64."""
        inputs = [column.astype(self.dtype) for column in columns]
        batch = self.run(inputs)
        return batch.mean.astype(np.float64), batch.cov.astype(np.float64)

    def run(self, inputs: Columns, out: FusionBatch | None = None) -> FusionBatch:
        """The fusion itself."""
        if self.iterations is None:
            return fuse_batch(*inputs, "exact", out=out)
        return fuse_batch(*inputs, iterations=self.iterations, jacobian_order=self.order, out=out)


PLANS = [Plan(n, order) for order in (2, 4, "exact") for n in range(1, 11)]
PLANS += [Plan(n, order, np.float32) for order in (2, "exact") for n in (1, 2, 3, 5, 10)]
PLANS += [Plan(None)]
TABLE = [Plan(n, 2) for n in (1, 2, 3, 5, 10)] + [Plan(n, 4) for n in (3, 5, 10)]
TABLE += [Plan(n) for n in (2, 3, 4, 5, 10)]
TABLE += [Plan(5, 2, np.float32), Plan(3, "exact", np.float32), Plan(None)]


def random_covariance(rng: np.random.Generator, sigma: Array, spread: float) -> Array:
    """Standard deviations around sigma within factors of 10**spread, correlated if the spread is not zero."""
    factor = np.eye(6) + (spread > 0) * 0.5 * np.tril(rng.uniform(-1, 1, (6, 6)), -1)
    correlated = factor @ factor.T
    scale = sigma * 10.0 ** rng.uniform(-spread, spread, 6) / np.sqrt(np.diag(correlated))
    result = correlated * np.outer(scale, scale)
    return 0.5 * (result + result.T)


def separated(degrees: float, spread: float, count: int) -> Columns:
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
    return [np.stack(column) for column in zip(*pairs, strict=True)]


def contacts(count: int) -> Columns:
    """Pairs of estimates of one contact, as the filter meets them."""
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(count):
        mean = se3.exp(0.1 * rng.normal(size=6))
        other = se3.exp(SIGMA * rng.normal(size=6)) @ mean
        pairs.append((mean, random_covariance(rng, SIGMA, 0.3), other, random_covariance(rng, SIGMA, 0.3)))
    return [np.stack(column) for column in zip(*pairs, strict=True)]


def errors(columns: Columns) -> dict[str, tuple[float, float]]:
    """Median error of the mean and of the covariance, by plan; pairs that do not converge are left out."""
    exact = fuse_batch(*columns, "exact")
    used = np.flatnonzero(exact.status == FusionStatus.CONVERGED)
    sigma = np.sqrt(np.einsum("nii->ni", exact.cov))
    found = {}
    for plan in PLANS:
        mean, cov = plan.fuse(columns)
        of_mean, of_cov = [], []
        for n in used:
            xi = se3.log(se3.orthonormalized(mean[n]) @ se3.inverse(exact.mean[n]))
            of_mean.append(np.linalg.norm(np.linalg.solve(exact.factor[n], xi)))
            of_cov.append(np.abs((cov[n] - exact.cov[n]) / np.outer(sigma[n], sigma[n])).max())
        found[plan.name] = float(np.median(of_mean)), float(np.median(of_cov))
    return found


def times(rounds: int) -> dict[str, float]:
    """Nanoseconds a fusion, by plan; the rounds go through all in turn, so all see one load."""
    columns = contacts(256)
    inputs = {dtype: [column.astype(dtype) for column in columns] for dtype in (np.float64, np.float32)}
    out = {dtype: fuse_batch(*values) for dtype, values in inputs.items()}
    best = {plan.name: float("inf") for plan in PLANS}
    for _ in range(rounds):
        for plan in PLANS:
            start = time.perf_counter_ns()
            plan.run(inputs[plan.dtype], out[plan.dtype])
            best[plan.name] = min(best[plan.name], (time.perf_counter_ns() - start) / 256)
    return best


def print_table(
    title: str, by_angle: dict[int, dict[str, tuple[float, float]]], ns: dict[str, float], which: int
):
    """Markdown, as in docs/filter.md."""
    print(f"\n{title}\n\n| iterations x order | ns | " + " | ".join(f"{d}°" for d in SHOWN) + " |")
    print("| --- |" + " --- |" * (1 + len(SHOWN)))
    for plan in TABLE:
        cells = " | ".join(f"{by_angle[d][plan.name][which]:.0e}" for d in SHOWN)
        print(f"| {plan.name} | {ns[plan.name]:.0f} | {cells} |")


def plot(
    path: Path, kinds: dict[str, dict[int, dict[str, tuple[float, float]]]], ns: dict[str, float]
) -> None:
    """Error of the mean over time, a line an order, a panel an angle."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    shown, floor = (5, 20, 45, 135), 1e-16
    figure, axes = plt.subplots(2, len(shown), figsize=(11, 5), sharex=True, sharey=True)
    series = [
        ("order 2", 2, np.float64, "o-"),
        ("order 4", 4, np.float64, "s-"),
        ("exact", "exact", np.float64, "^-"),
    ]
    series += [("order 2, float32", 2, np.float32, "o:"), ("exact, float32", "exact", np.float32, "^:")]
    for row, (kind, by_angle) in zip(axes, kinds.items(), strict=True):
        for axis, degrees in zip(row, shown, strict=True):
            for label, order, dtype, style in series:
                plans = [
                    plan for plan in PLANS if plan.iterations and (plan.order, plan.dtype) == (order, dtype)
                ]
                values = [max(by_angle[degrees][plan.name][0], floor) for plan in plans]
                axis.loglog([ns[plan.name] for plan in plans], values, style, label=label, ms=4, lw=1)
            axis.plot(ns["exact"], max(by_angle[degrees]["exact"][0], floor), "k*", label="mode exact", ms=9)
            axis.axhline(0.01, color="0.6", lw=0.8)
            axis.set_title(f"{kind}, {degrees}° apart", fontsize=9)
            axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("ns a fusion, in a batch")
    for row in axes:
        row[0].set_ylabel("error of the mean, sigmas")
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    parser.add_argument("--plot", type=Path, help="draw them")
    parser.add_argument("--quick", action="store_true", help="fewer pairs and repetitions")
    options = parser.parse_args()
    count = 20 if options.quick else 150
    ns = times(20 if options.quick else 300)
    kinds = {
        kind: {degrees: errors(separated(degrees, spread, count)) for degrees in DEGREES}
        for kind, spread in (("isotropic", 0.0), ("anisotropic", 1.0))
    }
    for kind, by_angle in kinds.items():
        print_table(f"{kind}: median error of the mean, posterior standard deviations", by_angle, ns, 0)
        print_table(f"{kind}: median error of the covariance", by_angle, ns, 1)
    if options.json:
        options.json.write_text(json.dumps({"ns": ns, "errors": kinds}, indent=1) + "\n")
    if options.plot:
        plot(options.plot, kinds, ns)


if __name__ == "__main__":
    main()
