"""What acting on the contact as predicted for now gains over acting on it as of the exposure.

    python bench/prediction.py [--scene ramp] [--json FILE]

The closed loop offline with the ideal sensor (noisy truth), by latency from exposure to command, speed over
the surface and gains (times those of the shipped controller; Ki by the square). Prediction is off, with the
surface taken as still, or with its motion estimated (setting `prediction`). Angle between sensor and normal
of the surface, root mean square and in its strongest oscillation.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import load_task, task_path
from tactile_records.runs import metrics
from tactile_scene.scene_file import load_scene

LATENCIES = (0.005, 0.020, 0.050)  # s
SPEEDS = (0.010, 0.025, 0.050)  # m/s
GAINS = (1.0, 2.0, 4.0)
VARIANTS: dict[str, dict[str, Any]] = {
    "off": {},
    "still": {"prediction__enabled": True, "prediction__motion_time": 0.0},
    "motion": {"prediction__enabled": True, "prediction__motion_time": 0.3},
}


def followed(scene_name: str, latency: float, speed: float, gain: float, changes: dict[str, Any]) -> Any:
    """Metrics of one run; None where it failed."""
    scene = load_scene(scene_name).with_fidelity("ideal")
    task = load_task(task_path("surface_following"), scene.name)
    role = task.role("follower")
    pid = role.settings.pid
    gains = {"pid__kp": [gain * k for k in pid.kp], "pid__ki": [gain**2 * k for k in pid.ki]}
    settings = role.settings.replaced(task__speed=speed, **gains, **changes)
    task = dataclasses.replace(task, roles=(dataclasses.replace(role, settings=settings),))
    options = OfflineOptions(fidelity="ideal", seed=1, latency=latency)
    values = metrics.report(run_offline(scene, task, options))
    if not values["succeeded"]:
        return None
    return {
        "depth_rms_mm": values["depth_rms_mm"],
        "normal_rms_deg": values["normal_rms_deg"],
        "oscillation_deg": values["oscillation"]["normal_deg"],
    }


def main() -> int:
    """Measure and print a table in Markdown; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scene", default="ramp", help="scene to follow (ramp)")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    arguments = parser.parse_args()
    results = []
    print("| latency, ms | mm/s | gains | " + " | ".join(VARIANTS) + " |")
    print("| --- " * (3 + len(VARIANTS)) + "|")
    for latency in LATENCIES:
        for speed in SPEEDS:
            for gain in GAINS:
                row = {
                    name: followed(arguments.scene, latency, speed, gain, changes)
                    for name, changes in VARIANTS.items()
                }
                results.append({"latency": latency, "speed": speed, "gain": gain, **row})
                cells = [
                    f"{v['normal_rms_deg']:.2f}, {v['oscillation_deg']:.2f}" if v else "failed"
                    for v in row.values()
                ]
                print(f"| {1e3 * latency:.0f} | {1e3 * speed:.0f} | x {gain:g} | " + " | ".join(cells) + " |")
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
