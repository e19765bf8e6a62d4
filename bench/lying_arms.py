"""What drivers that lie lead to, against the cell's truth: rest after, way, fastest, deepest, what is read.

    python bench/lying_arms.py [LIE ...] [--scene plane] [--arm NAME] [--at 7.0] [--fidelity ideal]
    python bench/lying_arms.py --false-alarms 20

No ROS. The lie begins at `--at` seconds of the cell's time (the cell's clock begins at 1 s): on the plane 2.5
is in the approach, 7.0 along the surface. `--false-alarms N` runs all packaged tasks, honest, with N seeds
each instead, and says which ended otherwise than well.
"""

from __future__ import annotations

import argparse

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


def show_false_alarms(seeds: int, fidelity: str) -> None:
    """How many honest runs there were, and those that failed."""
    failed = []
    for scene, task in TASKS.items():
        for seed in range(seeds):
            records = run_arms_offline(scene, task, OfflineOptions(fidelity=fidelity, seed=seed))
            reasons = {record.result["reason"] for record in records.values()} - {""}
            failed += [f"{scene}, seed {seed}: {reason}" for reason in reasons]
    print(f"{seeds * len(TASKS)} honest runs, {len(failed)} failed", *failed, sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lies", nargs="*", choices=[*ARM_LIES, []], help="(default: all)")
    parser.add_argument("--scene", choices=TASKS, default="plane")
    parser.add_argument("--arm", default="", help="whose driver lies (default: all)")
    parser.add_argument("--at", type=float, default=7.0, help="s of the cell's time (default: 7)")
    parser.add_argument("--fidelity", default="ideal")
    parser.add_argument("--false-alarms", type=int, default=0, metavar="SEEDS")
    arguments = parser.parse_args()
    if arguments.false_alarms:
        show_false_alarms(arguments.false_alarms, arguments.fidelity)
    else:
        show_lies(arguments)


if __name__ == "__main__":
    main()
