"""What drivers that lie lead to, against the cell's truth: rest after, way, fastest, deepest, what is read.

    python bench/lying_arms.py [LIE ...] [--scene plane] [--arm NAME] [--at 7.0] [--fidelity ideal]
    python bench/lying_arms.py --false-alarms 20 [--live [--priority 20] [--jobs 2]]

No ROS but with `--live`. The lie begins at `--at` seconds of the cell's time (the clock begins at 1 s): on
the plane 2.5 is in the approach, 7.0 along the surface. `--false-alarms N` runs all packaged tasks, honest,
with N seeds each instead, and says which ended otherwise than well; with `--live` as `tactile launch` does.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_drivers.doubles.lying_arm import ARM_LIES, LyingArm

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


def show_lies(arguments: argparse.Namespace) -> None:
    """A row of a Markdown table for each lie and arm."""
    print("| lie | arm | at rest after (s) | way (mm) | fastest (mm/s) | deepest (mm) | what is read |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in arguments.lies or ARM_LIES:
        lies = LyingArm(name, arguments.at, arguments.arm)
        options = OfflineOptions(fidelity=arguments.fidelity, lies=lies, time_limit=60.0)
        records = run_arms_offline(arguments.scene, TASKS[arguments.scene], options)
        for arm, record in records.items():
            truth = lies.witness[arm]
            numbers = truth.rests_since, 1e3 * truth.way, 1e3 * truth.fastest, 1e3 * truth.deepest
            reason = record.result["reason"] or "done"
            print(
                f"| {name} | {arm} | " + " | ".join(f"{number:.2f}" for number in numbers) + f" | {reason} |"
            )


def offline_reasons(scene: str, seed: int, arguments: argparse.Namespace) -> str:
    """Why an honest run in one process did not end well; '' if it did."""
    records = run_arms_offline(scene, TASKS[scene], OfflineOptions(fidelity=arguments.fidelity, seed=seed))
    return "; ".join({record.result["reason"] for record in records.values()} - {""})


def live_reasons(scene: str, seed: int, arguments: argparse.Namespace) -> str:
    """Why an honest run of real nodes did not end well: its exit code and last lines; '' if it did."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tactile_bringup.cli", "launch", TASKS[scene], "--scene", scene]
        command += ["--seed", str(seed), "--headless", "--priority", str(arguments.priority), "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True)
    said = " | ".join((done.stdout + done.stderr).strip().splitlines()[-4:])
    return "" if done.returncode == 0 else f"exit code {done.returncode}: {said}"


def show_false_alarms(arguments: argparse.Namespace) -> None:
    """How many honest runs there were, and those that failed, told at once."""
    reasons = live_reasons if arguments.live else offline_reasons
    runs = list(itertools.product(range(arguments.false_alarms), TASKS))

    def look(run: tuple[int, str]) -> bool:
        seed, scene = run
        reason = reasons(scene, seed, arguments)
        print(f"{scene}, seed {seed}: {reason or 'done'}", flush=True)
        return bool(reason)

    with ThreadPoolExecutor(arguments.jobs) as pool:
        failed = sum(pool.map(look, runs))
    print(f"{len(runs)} honest runs, {failed} failed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lies", nargs="*", choices=[*ARM_LIES, []], help="(default: all)")
    parser.add_argument("--scene", choices=TASKS, default="plane")
    parser.add_argument("--arm", default="", help="whose driver lies (default: all)")
    parser.add_argument("--at", type=float, default=7.0, help="s of the cell's time (default: 7)")
    parser.add_argument("--fidelity", default="ideal")
    parser.add_argument("--false-alarms", type=int, default=0, metavar="SEEDS")
    parser.add_argument("--live", action="store_true", help="false alarms of real nodes")
    parser.add_argument("--priority", type=int, default=0, help="of the live nodes (default: 0, none)")
    parser.add_argument("--jobs", type=int, default=1, help="honest runs side by side (default: 1)")
    arguments = parser.parse_args()
    if arguments.false_alarms:
        show_false_alarms(arguments)
    else:
        show_lies(arguments)


if __name__ == "__main__":
    main()
