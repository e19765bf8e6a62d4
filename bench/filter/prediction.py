"""What acting on the contact as predicted for now gains over acting on it as of the exposure.

    python bench/filter/prediction.py [--scene ramp] [--gains 1 4]

The closed loop offline with the ideal sensor (noisy truth), by latency from exposure to command, speed over
the surface and gains: Kp of the shipped controller times the factor, and Ki times its square, which keeps the
damping. Prediction is off, with the surface taken as still, or with its motion estimated (setting
`prediction`). Angle between sensor and normal of the surface, degrees: root mean square, and in parentheses
its strongest oscillation.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import load_task, task_path
from tactile_records.runs import metrics
from tactile_scene.scene_file import load_scene

LATENCIES = (0.005, 0.020, 0.050)  # s
SPEEDS = (0.010, 0.025, 0.050)  # m/s
VARIANTS: dict[str, dict[str, Any]] = {
    "off": {},
    "still": {"prediction__enabled": True, "prediction__motion_time": 0.0},
    "motion": {"prediction__enabled": True, "prediction__motion_time": 0.3},
}


def followed(scene_name: str, latency: float, speed: float, gain: float, changes: dict[str, Any]) -> str:
    """The cell of one run."""
    scene = load_scene(scene_name).with_fidelity("ideal")
    task = load_task(task_path("surface_following"), scene.name)
    role = task.role("follower")
    pid = role.settings.pid
    gains = {"pid__kp": [gain * k for k in pid.kp], "pid__ki": [gain**2 * k for k in pid.ki]}
    settings = role.settings.replaced(task__speed=speed, **gains, **changes)
    task = dataclasses.replace(task, roles=(dataclasses.replace(role, settings=settings),))
    values = metrics.report(
        run_offline(scene, task, OfflineOptions(fidelity="ideal", seed=1, latency=latency))
    )
    if not values["succeeded"]:
        return "failed"
    return f"{values['normal_rms_deg']:.2f} ({values['oscillation']['normal_deg']:.2f})"


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--scene", default="ramp", help="scene to follow (ramp)")
    arguments.add_argument("--gains", type=float, nargs="+", default=[1.0, 4.0], help="factors (1 4)")
    given = arguments.parse_args()
    cases = list(itertools.product(given.gains, VARIANTS))
    heads = (f"Kp x {gain:g}, Ki x {gain**2:g}: {name}" for gain, name in cases)
    table = Table(("latency", "speed", *heads), "one run each, seed 1")
    for latency, speed in itertools.product(LATENCIES, SPEEDS):
        cells = (followed(given.scene, latency, speed, gain, VARIANTS[name]) for gain, name in cases)
        table.row(f"{1e3 * latency:.0f} ms", f"{1e3 * speed:.0f} mm/s", *cells)


if __name__ == "__main__":
    main()
