"""False alarms: all packaged tasks with many seeds and nothing wrong, of which none may be stopped.

    python bench/graph/honest_runs.py [--seeds 10] [--fidelity ideal] [--scenes ...]

In one process each, without ROS.
"""

from __future__ import annotations

import argparse
import itertools

from tactile_bringup.offline import OfflineOptions, run_arms_offline

TASKS = {
    "plane": "surface_following",
    "ramp": "surface_following",
    "dome": "surface_following",
    "two_arms": "surface_following",
    "tracking_flat": "object_tracking",
    "tracking_ball": "object_tracking",
    "tracking_cube": "object_tracking",
    "tracking_mustard": "object_tracking",
    "pushing": "pushing",
    "dual_pushing": "dual_pushing",
    "dual_pushing_tall": "dual_pushing",
}


def reasons(scene: str, options: OfflineOptions) -> str:
    """Why a run did not end well; '' if it did."""
    records = run_arms_offline(scene, TASKS[scene], options)
    return "; ".join({record.result["reason"] for record in records.values()} - {""})


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="of each task (default: 10)")
    parser.add_argument("--scenes", nargs="+", choices=TASKS, default=list(TASKS), help="(default: all)")
    parser.add_argument("--fidelity", default="ideal", help="of sensors (default: ideal)")
    arguments = parser.parse_args()
    failed = 0
    for seed, scene in itertools.product(range(arguments.seeds), arguments.scenes):
        reason = reasons(scene, OfflineOptions(fidelity=arguments.fidelity, seed=seed))
        print(f"{scene}, seed {seed}: {reason or 'done'}", flush=True)
        failed += bool(reason)
    print(f"{arguments.seeds * len(arguments.scenes)} honest runs, {failed} failed")


if __name__ == "__main__":
    main()
