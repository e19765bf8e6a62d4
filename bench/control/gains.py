"""Gains against latency: depth, alignment and oscillation of surface following, in the loop without ROS.

    python bench/control/gains.py [--fidelity ideal] [--seeds 2] [--only TEXT]

Ramp and one path of the dome for each row, against the truth; docs/results/control.md has its tables.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import load_task, task_path
from tactile_records.runs import metrics

SCENES = {"ramp": (), "dome": ("theta_1",)}


def tilt_gains(kp: float, ki: float, kd: float = 0.05) -> dict[str, list[float]]:
    """Settings that put these gains on the two tilt channels."""
    return {
        "pid__kp": [0, 0, 2, kp, kp, 0],
        "pid__ki": [0, 0, 0.1, ki, ki, 0],
        "pid__kd": [0, 0, 0.05, kd, kd, 0],
    }


ROWS: list[tuple[str, float, dict]] = [
    ("Kp 2, Ki 0.1 (paper)", 10, tilt_gains(2, 0.1)),
    ("Kp 4, Ki 0.1", 10, tilt_gains(4, 0.1)),
    ("Kp 2, Ki 2", 10, tilt_gains(2, 2)),
    ("Kp 4, Ki 4 (tuned)", 10, tilt_gains(4, 4)),
    ("Kp 4, Ki 4 (tuned)", 30, tilt_gains(4, 4)),
    ("Kp 4, Ki 4 (tuned)", 100, tilt_gains(4, 4)),
    ("Kp 8, Ki 8", 10, tilt_gains(8, 8)),
    ("Kp 8, Ki 8", 100, tilt_gains(8, 8)),
    ("Kp 8, Ki 32", 10, tilt_gains(8, 32)),
    ("Kp 20, Ki 20", 10, tilt_gains(20, 20)),
    ("Kp 20, Ki 20", 30, tilt_gains(20, 20)),
    ("Kp 20, Ki 20", 100, tilt_gains(20, 20)),
    ("paper, free shear", 10, tilt_gains(2, 0.1) | {"servoing__free_shear": True}),
    ("tuned, free shear", 10, tilt_gains(4, 4) | {"servoing__free_shear": True}),
    ("tuned, global space", 10, tilt_gains(4, 4) | {"servoing__tangent_space": "global"}),
]


def measure(scene: str, latency_ms: float, changes: dict, fidelity: str, seeds: int) -> tuple[float, ...]:
    """Depth RMS (mm), normal RMS (deg), oscillation in depth (mm) and tilt (deg): means over seeds."""
    texts = [f"{name.replace('__', '.')}={value}" for name, value in changes.items()]
    task = load_task(task_path("surface_following"), scene, changes=texts)
    rows = []
    for seed in range(seeds):
        options = OfflineOptions(fidelity=fidelity, seed=seed, latency=latency_ms * 1e-3, goals=SCENES[scene])
        values = metrics.report(run_offline(scene, task, options))
        if not values["succeeded"]:
            return (np.nan,) * 4
        wave = values["oscillation"]
        rows.append((values["depth_rms_mm"], values["normal_rms_deg"], wave["depth_mm"], wave["normal_deg"]))
    return tuple(np.mean(rows, axis=0))


def main() -> None:
    """Print the table."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--fidelity", choices=("ideal", "image"), default="ideal")
    arguments.add_argument("--seeds", type=int, default=2)
    arguments.add_argument("--only", default="", help="rows whose name holds this text")
    given = arguments.parse_args()
    heads = ["tilt gains", "latency"]
    for scene in SCENES:
        heads += [f"{scene}: {name}" for name in ("depth RMS [mm]", "normal RMS [deg]",
                                                  "depth wave [mm]", "tilt wave [deg]")]  # fmt: skip
    table = Table(heads, f"means over seeds 0 to {given.seeds - 1}")
    for name, latency_ms, changes in ROWS:
        if given.only in name:
            cells = [name, f"{latency_ms:g} ms"]
            for scene in SCENES:
                numbers = measure(scene, latency_ms, changes, given.fidelity, given.seeds)
                pairs = zip(numbers, (3, 2, 3, 2), strict=True)
                cells += ["-" if np.isnan(value) else f"{value:.{digits}f}" for value, digits in pairs]
            table.row(*cells)


if __name__ == "__main__":
    main()
