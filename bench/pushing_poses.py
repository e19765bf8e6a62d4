"""Pushes that are to end in a direction: how near they come to place and direction, in the plane.

python bench/pushing_poses.py                      # docs/results/pushing_options.md
python bench/pushing_poses.py --loop 2             # some of them in the loop without ROS
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from pushing_options import LEADER, STEERING, Option, outcome, trials_of
from pushing_plane import START, TARGET, TIP, Variant, wrapped

from tactile_bringup.experiment import Common, Trial, numbers_of, setup_of
from tactile_bringup.offline import run_arms_offline
from tactile_control.pose_steering import largest_curvature
from tactile_control.steering import SteeringSettings
from tactile_control.tasks.pushing import PUSH
from tactile_records.runs.pushing import true_contacts

Array = NDArray[Any]

LIMIT = SteeringSettings().turning * SteeringSettings().limit / 0.010  # 1/m, of what is refused


def bend(heading: float) -> float:
    """Largest curvature (1/m) of the way from the paper's start, where the tip looks along y."""
    end = TARGET - TIP * np.array([np.cos(heading), np.sin(heading)]) - START
    settings = SteeringSettings()
    seen = np.array([-end[0], end[1]])  # left and ahead
    return largest_curvature(seen, heading - 0.5 * np.pi, 1.0 / settings.turning, settings.straight)


def headings(count: int) -> Array:
    """All around, rad from the world's x-axis: those that are not refused, and the first beyond."""
    return np.radians(np.random.default_rng(1).uniform(-100.0, 100.0, count))


def line(name: str, found: Any, off: Array, chosen: Array) -> None:
    """Of some of the trials."""
    well = chosen & ~found.missed
    error = np.abs(found.error[well])
    cells = [f"{chosen.sum()}", f"{(chosen & found.missed).sum()}"]
    for values in (error, off[well]):
        numbers = (
            (values.mean(), values.std(), np.percentile(values, 95), values.max())
            if len(values)
            else [np.nan] * 4
        )
        cells.append("{:.2f} ± {:.2f}, {:.2f}, {:.2f}".format(*numbers))
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def plane(table: str, count: int) -> None:
    """Steering as it comes, and to a direction, by how tight the way has to bend."""
    trials = trials_of(table, count)
    wanted = headings(len(trials))
    bends = np.array([bend(heading) for heading in wanted])
    print(f"\n{table}: {len(trials)} trials\n")
    print("| | trials | missed | error [mm]: mean, 95 %, largest | off the direction [deg]: the same |")
    print("| --- | --- | --- | --- | --- |")
    for name, variant in (("as it comes", Variant()), ("to the direction", Variant(direction=wanted))):
        found = outcome(table, Option(STEERING, variant), trials)
        off = np.abs(np.degrees(wrapped(found.heading - wanted)))
        for text, least, most in (
            ("not refused", 0.0, LIMIT),
            ("needs up to 4/3 of the limit", LIMIT, LIMIT * 4 / 3),
            ("more", LIMIT * 4 / 3, np.inf),
        ):
            line(f"{name}: {text}", found, off, (bends > least) & (bends <= most))


def loop(count: int) -> None:
    """Signed errors in the loop without ROS, of directions that are not refused."""
    print("\n| loop without ROS | direction [deg] | error [mm] | off the direction [deg] |")
    print("| --- | --- | --- | --- |")
    for table in ("single", "dual"):
        trials = trials_of(table, count)
        wanted = headings(len(trials))
        for (thing, floor, seed), heading in zip(trials, wanted, strict=True):
            if bend(heading) <= LIMIT:
                report(table, thing, floor, seed, heading)


def report(table: str, thing: str, floor: str, seed: int, heading: float) -> None:
    setup = setup_of(Trial(Common(table, "tuned"), thing, floor, seed))
    role = setup.task.role(LEADER[table])
    goal = role.goals[0].goal.replaced(direction=(float(np.cos(heading)), float(np.sin(heading)), 0.0))
    role = replace(role, goals=(replace(role.goals[0], goal=goal),))
    roles = tuple(role if each.name == role.name else each for each in setup.task.roles)
    run = run_arms_offline(setup.pushing_scene(), replace(setup.task, roles=roles), setup.options)
    normal = true_contacts(next(record for record in run.values() if record.work == PUSH)).normal[-1]
    off = np.degrees(wrapped(np.arctan2(normal[1], normal[0]) - heading))
    error = numbers_of(run)["push"]["error_mm"]
    print(
        f"| {table}: {thing}, {floor}, {seed} | {np.degrees(heading):.0f} | {error:.2f} | {off:.2f} |",
        flush=True,
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=25, help="of each row of a table")
    parser.add_argument("--loop", type=int, default=0, metavar="TRIALS", help="of each row, in the loop")
    chosen = parser.parse_args()
    if chosen.loop:
        loop(chosen.loop)
        return
    for table in ("single", "dual"):
        plane(table, chosen.trials)


if __name__ == "__main__":
    main()
