"""A run as tables that other tools read: CSV or Parquet by stream, trajectories in the format of TUM for evo.

Names of columns end in their unit; a stamp is in seconds of Unix time. Poses are position and quaternion
(x, y, z, w) of the child in the parent; of estimates and beliefs X_sf with its left covariance, and the Euler
surface contact pose of X_fs that people read.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_geometry import se3
from tactile_records.runs.euler_poses import euler_poses, inverses
from tactile_records.runs.record import GaussianSeries, RunRecord, Series

Array = NDArray[Any]
Table = dict[str, Array]

STREAMS = (
    "pose",
    "estimate",
    "belief",
    "truth",
    "presence",
    "force_estimate",
    "force",
    "command",
    "arm_twist",
)
TANGENT = ("rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z")
EULER = ("x_m", "y_m", "z_m", "alpha_rad", "beta_rad", "gamma_rad")
TWIST = ("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
_ERROR = ("x_m", "y_m", "z_m", "x_rad", "y_rad", "z_rad")
_OF_SIX = {"error": _ERROR, "reference": EULER}  # other columns of six are twists


def tables(record: RunRecord) -> dict[str, Table]:
    """Name -> columns of each stream that has rows, and of the latency of all stages."""
    found = {name: table_of(getattr(record, name)) for name in STREAMS if len(getattr(record, name))}
    stages = [(stage, series) for stage, series in record.latency.items() if len(series)]
    if stages:
        found["latency"] = {
            "exposure_s": np.concatenate([seconds_of(series.stamp_ns) for _, series in stages]),
            "stage": np.concatenate([np.full(len(series), stage) for stage, series in stages]),
            "latency_s": np.concatenate([series.seconds for _, series in stages]),
        }
    return found


def table_of(series: Series) -> Table:
    """The columns of one stream."""
    table: Table = {"stamp_s": seconds_of(series.stamp_ns)}
    for item in dataclasses.fields(series):
        values = getattr(series, item.name)
        if item.name == "stamp_ns":
            continue
        if values.shape[1:] == (4, 4):
            table |= pose_columns(item.name, values)
        elif values.shape[1:] == (6, 6):
            table |= covariance_columns(values)
        elif values.shape[1:] == (3,):
            table |= {f"{item.name}_{axis}_n": values[:, k] for k, axis in enumerate("xyz")}
        elif values.shape[1:] == (3, 3):
            pairs = [(i, j) for i in range(3) for j in range(i, 3)]
            table |= {f"cov_{'xyz'[i]}_{'xyz'[j]}_n2": values[:, i, j] for i, j in pairs}
        elif values.shape[1:] == (6,):
            names = _OF_SIX.get(item.name, TWIST)
            table |= {f"{item.name}_{name}": values[:, k] for k, name in enumerate(names)}
        elif item.name.endswith("_ns"):
            table[f"{item.name.removesuffix('_ns')}_s"] = seconds_of(values)
        else:
            table[item.name] = values
    if isinstance(series, GaussianSeries):
        euler = euler_poses(inverses(series.mean))
        table |= {f"contact_{name}": euler[:, k] for k, name in enumerate(EULER)}
    return table


def seconds_of(stamp_ns: Array) -> Array:
    """Stamps in seconds; to a microsecond, as far as float64 goes."""
    return np.asarray(stamp_ns * NANOSECOND)


def pose_columns(name: str, poses: Array) -> Table:
    """Position and quaternion of poses (N, 4, 4)."""
    q = np.array([se3.quaternion_from_rotation(T[:3, :3]) for T in poses]).reshape(-1, 4)
    columns = {f"{name}_{axis}_m": poses[:, k, 3] for k, axis in enumerate("xyz")}
    return columns | {f"{name}_q{axis}": q[:, k] for k, axis in enumerate("xyzw")}


def covariance_columns(cov: Array) -> Table:
    """The 21 different elements of left covariances (N, 6, 6)."""
    units = np.array([["m2", "m_rad"], ["m_rad", "rad2"]])
    return {
        f"cov_{TANGENT[i]}_{TANGENT[j]}_{units[i // 3, j // 3]}": cov[:, i, j]
        for i in range(6)
        for j in range(i, 6)
    }


def trajectories(record: RunRecord) -> dict[str, tuple[Array, Array]]:
    """Name -> stamps (N,) and poses (N, 4, 4) in the base: of the sensor, and of the believed feature."""
    found = {"sensor": (record.pose.stamp_ns, record.pose.T_base_sensor)} if len(record.pose) else {}
    if len(record.pose) and len(record.belief):
        index = np.searchsorted(record.pose.stamp_ns, record.belief.stamp_ns, side="right") - 1
        known = index >= 0
        T = record.pose.T_base_sensor[index[known]] @ record.belief.mean[known]
        found["contact"] = record.belief.stamp_ns[known], T
    return found


def write_csv(table: Mapping[str, Array], path: Path) -> None:
    """One table; NaN is an empty cell."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        for row in zip(*(column.tolist() for column in table.values()), strict=True):
            writer.writerow(["" if value != value else value for value in row])


def write_parquet(table: Mapping[str, Array], path: Path) -> None:
    """One table; needs pyarrow."""
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(dict(table)), path)


def write_tum(stamp_ns: Array, poses: Array, path: Path) -> None:
    """A trajectory: `stamp x y z qx qy qz qw` a line, seconds and metres, as evo reads it."""
    columns = pose_columns("", poses)
    with path.open("w") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for ns, *numbers in zip(stamp_ns.tolist(), *(c.tolist() for c in columns.values()), strict=True):
            stamp = f"{ns // 10**9}.{ns % 10**9:09d}"
            file.write(" ".join([stamp, *(f"{number:.9g}" for number in numbers)]) + "\n")
