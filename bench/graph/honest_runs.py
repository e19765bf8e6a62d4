"""False alarms: all packaged tasks with many seeds and nothing wrong, of which none may be stopped.

    python bench/graph/honest_runs.py [--seeds 10] [--fidelity ideal] [--live [--priority 20]] [--scenes ...]

In one process each, without ROS; with `--live` as `tactile launch` runs them.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor

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


def offline_reasons(scene: str, seed: int, arguments: argparse.Namespace) -> str:
    """Why a run in one process did not end well; '' if it did."""
    records = run_arms_offline(scene, TASKS[scene], OfflineOptions(fidelity=arguments.fidelity, seed=seed))
    return "; ".join({record.result["reason"] for record in records.values()} - {""})


def live_reasons(scene: str, seed: int, arguments: argparse.Namespace) -> str:
    """Why a run of real nodes did not end well: its exit code and last lines; '' if it did."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tactile_bringup.cli", "launch", TASKS[scene], "--scene", scene]
        command += ["--seed", str(seed), "--headless", "--priority", str(arguments.priority), "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = " | ".join((done.stdout + done.stderr).strip().splitlines()[-4:])
    return "" if done.returncode == 0 else f"exit code {done.returncode}: {said}"


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="of each task (default: 10)")
    parser.add_argument("--scenes", nargs="+", choices=TASKS, default=list(TASKS), help="(default: all)")
    parser.add_argument("--fidelity", default="ideal", help="of sensors, not live (default: ideal)")
    parser.add_argument("--live", action="store_true", help="real nodes")
    parser.add_argument("--priority", type=int, default=0, help="of the live nodes (default: 0, none)")
    parser.add_argument("--jobs", type=int, default=1, help="runs side by side (default: 1)")
    arguments = parser.parse_args()
    reasons = live_reasons if arguments.live else offline_reasons
    runs = list(itertools.product(range(arguments.seeds), arguments.scenes))

    def look(run: tuple[int, str]) -> bool:
        seed, scene = run
        reason = reasons(scene, seed, arguments)
        print(f"{scene}, seed {seed}: {reason or 'done'}", flush=True)
        return bool(reason)

    with ThreadPoolExecutor(arguments.jobs) as pool:
        failed = sum(pool.map(look, runs))
    print(f"{len(runs)} honest runs, {failed} failed")


if __name__ == "__main__":
    main()
