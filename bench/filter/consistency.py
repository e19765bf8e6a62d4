"""How consistent the filter is in the closed loop: NIS, whiteness and NEES with the shipped settings.

    python bench/filter/consistency.py [--scenes ramp plane] [--fidelity ideal image]

Offline, simulated. NIS and NEES are divided by 6 (1: covariances mean what they claim); the correlation is
that of each whitened innovation with the next. NEES against the truth, while in contact.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_filter.bayes_filter import Belief, ContactFilter
from tactile_filter.consistency import nees
from tactile_filter.filter_settings import load_filter_settings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_geometry.transform_buffer import TransformBuffer
from tactile_records.runs.record import BeliefSeries, GaussianSeries, RunRecord, TruthSeries


def mean_nees(series: GaussianSeries | BeliefSeries, truth: TruthSeries) -> float:
    """NEES / 6 over the exposures in contact."""
    touching = zip(truth.stamp_ns, truth.T_fs, truth.in_contact, strict=True)
    poses = {int(stamp): se3.inverse(T) for stamp, T, in_contact in touching if in_contact}
    rows = zip(series.stamp_ns, series.mean, series.cov, strict=True)
    return float(
        np.mean([nees(poses[int(stamp)], mean, cov) for stamp, mean, cov in rows if int(stamp) in poses]) / 6
    )


def filtered(record: RunRecord) -> list[Belief]:
    """The record's estimates through the filter once more: records do not hold innovations."""
    contact_filter, poses = ContactFilter(load_filter_settings()), TransformBuffer(3600 * SECOND_NS)
    for stamp, T in zip(record.pose.stamp_ns, record.pose.T_base_sensor, strict=True):
        poses.set_transform("base", "sensor", int(stamp), T)
    rows = zip(record.estimate.stamp_ns, record.estimate.mean, record.estimate.cov, strict=True)
    return [
        contact_filter.step(int(stamp), PoseGaussian(mean, cov), poses.lookup("base", "sensor", int(stamp)))
        for stamp, mean, cov in rows
    ]


def row(scene: str, fidelity: str) -> list[str]:
    """One run as a row of the table."""
    record = run_offline(scene, "surface_following", OfflineOptions(fidelity=fidelity, seed=1))
    w = np.array([belief.innovation for belief in filtered(record) if belief.innovation is not None])
    lag_one = (w[1:] * w[:-1]).sum(axis=0) / (w**2).sum(axis=0)
    return [
        f"{scene}, {fidelity}",
        f"{np.square(w).mean():.2f}",
        ", ".join(f"{value:.2f}" for value in lag_one),
        f"{mean_nees(record.estimate, record.truth):.2f}",
        f"{mean_nees(record.belief, record.truth):.2f}",
    ]


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--scenes", nargs="+", default=["ramp", "plane"])
    arguments.add_argument("--fidelity", nargs="+", default=["ideal", "image"])
    given = arguments.parse_args()
    heads = ("", "NIS / 6", "correlation of innovations", "NEES / 6, estimates", "NEES / 6, beliefs")
    table = Table(heads, "one run each, seed 0")
    for fidelity in given.fidelity:
        for scene in given.scenes:
            table.row(*row(scene, fidelity))


if __name__ == "__main__":
    main()
