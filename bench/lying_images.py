"""What images that lie lead to, against the cell's truth: when it is known, rest, way, depth, what is read.

    python bench/lying_images.py [LIE ...] [--scene plane] [--arm NAME] [--at 6.0] [--seed 1] [--json FILE]

Rendered images, the shipped network, no ROS. The lie begins at `--at` seconds of the cell's time (the cell's
clock begins at 1 s): on the plane 12.0 is along the surface, and 0 before the image without contact is
taken. `--false-alarms` counts what is refused of honest images in all packaged tasks instead.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_drivers.doubles.lies import Lies
from tactile_drivers.doubles.lying_camera import LYING_CAMERAS, ImageLies

TASKS = {
    "plane": "surface_following",
    "ramp": "surface_following",
    "dome": "surface_following",
    "two_arms": "surface_following",
    "pushing": "pushing",
    "dual_pushing": "dual_pushing",
    "dual_pushing_tall": "dual_pushing",
    "tracking_flat": "object_tracking",
    "tracking_ball": "object_tracking",
    "tracking_cube": "object_tracking",
}


def run(scene: str, lie: str, at: float, arm: str, seed: int) -> dict[str, Any]:
    """One row of the table by arm."""
    lies = ImageLies(lie, at, arm, seed=seed) if lie else Lies()
    options = OfflineOptions(fidelity="image", seed=seed, lies=lies, time_limit=60.0)
    records = run_arms_offline(scene, TASKS[scene], options)
    result: dict[str, Any] = {"scene": scene, "lie": lie, "at": at}
    for name, record in records.items():
        witness, phase = lies.witness[name], ""
        commanded = record.command.stamp_ns <= at * SECOND_NS
        if commanded.any():
            phase = str(record.command.phase[commanded][-1])
        believed = record.presence.stamp_ns if len(record.presence) else []
        last = max((int(stamp) for stamp in believed), default=0) / SECOND_NS
        result[name] = {
            "phase": phase,
            "believed_until": round(last - at, 3),
            "rests": round(witness.rests_since, 3),
            "way_mm": round(1e3 * witness.way, 2),
            "deepest_mm": round(1e3 * witness.deepest, 2),
            "fastest_mm_s": round(1e3 * witness.fastest, 1),
            "succeeded": record.result["succeeded"],
            "reason": record.result["reason"],
            "refused": record.result.get("refused", {}),
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lies", nargs="*", default=list(LYING_CAMERAS))
    parser.add_argument("--scene", default="plane", choices=TASKS)
    parser.add_argument("--arm", default="", help="whose camera lies; default: all")
    parser.add_argument("--at", type=float, default=6.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--false-alarms", action="store_true")
    args = parser.parse_args()
    rows = []
    cases = (
        [(scene, "") for scene in TASKS] if args.false_alarms else [(args.scene, lie) for lie in args.lies]
    )
    for scene, lie in cases:
        row = run(scene, lie, args.at if lie else 0.0, args.arm, args.seed)
        rows.append(row)
        for name, values in row.items():
            if isinstance(values, dict):
                print(f"{scene:12s} {lie or 'honest':13s} {name:9s} {values}", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
