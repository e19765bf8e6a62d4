"""What each option of pushing does to the final error: the same trials for all, in the plane.

    python bench/pushing_options.py            # 25 trials of each row: docs/results/pushing_options.md
python bench/pushing_options.py --trials 5 --options paper steering
    python bench/pushing_options.py --check 2  # against the loop without ROS, trial by trial
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from pushing_plane import Outcome, Physics, Plant, Variant, push

from tactile_bringup.experiment import Common, Trial, load_tables, task_of, trial_row
from tactile_sim.pushing_scene import PushVariation

#: As an experiment draws it, and more than three times that: friction by a half, centre of friction and
#: placement by a centimetre, angle by ten degrees.
USUAL = PushVariation()
WIDE = PushVariation(friction=0.5, center_of_friction=0.010, placement=0.010, angle_deg=10.0)
STEERING = ("steering.enabled=true",)


@dataclass(frozen=True)
class Option:
    """Settings of the arm that pushes on top of the paper's, and what is no setting."""

    changes: tuple[str, ...] = ()
    variant: Variant = field(default_factory=Variant)
    variation: PushVariation = USUAL
    physics: Physics = field(default_factory=Physics)


SINGLE = {
    "paper": Option(),
    "paper, errors of the network": Option(physics=Physics(network=True)),
    "paper, wide": Option(variation=WIDE),
    "never switched off": Option(("alignment.cutoff_distance=0",)),
    "never switched off, sign of the learnt model": Option(variant=Variant(signed=True)),
    "Ki 0": Option(("alignment.ki=0",)),
    "Ki 1": Option(("alignment.ki=1",)),
    "Ki 0.3 without anti-windup": Option(variant=Variant(anti_windup=False)),
    "Ki 1 without anti-windup": Option(("alignment.ki=1",), Variant(anti_windup=False)),
    "steering": Option(STEERING),
    "steering, slower beyond 0.5 mm of shear": Option(STEERING, Variant(safe_shear=0.0005)),
    "steering, slower beyond 0.25 mm of shear": Option(STEERING, Variant(safe_shear=0.00025)),
    "steering, wide": Option(STEERING, variation=WIDE),
    "steering, errors of the network": Option(STEERING, physics=Physics(network=True)),
    "steering, noise x 3": Option(STEERING, physics=Physics(noise=3.0)),
    "steering, a and b not learnt": Option(
        (*STEERING, "steering.turning_deviation=0.01", "steering.drift_deviation=0.001")
    ),
    "steering, b not learnt": Option((*STEERING, "steering.drift_deviation=0.001")),
    "steering, a not learnt": Option((*STEERING, "steering.turning_deviation=0.01")),
    "steering, cautious": Option(STEERING, Variant(cautious=True)),
    "steering, cautious, wide": Option(STEERING, Variant(cautious=True), WIDE),
    "steering, cautious, noise x 3": Option(STEERING, Variant(cautious=True), physics=Physics(noise=3.0)),
}
DUAL = {
    "paper": Option(),
    "paper, errors of the network": Option(physics=Physics(network=True)),
    "paper, active follower": Option(variant=Variant(feedforward=1.0)),
    "steering": Option(STEERING),
    "steering, normals known": Option(STEERING, physics=Physics(noise=0.0)),
    "steering, slower beyond 0.5 mm of shear": Option(STEERING, Variant(safe_shear=0.0005)),
    "steering, active follower": Option(STEERING, Variant(feedforward=1.0)),
}
OPTIONS = {"single": SINGLE, "dual": DUAL}
COLUMNS = (
    "error mm", "95 %", "largest", "worst row", "missed", "lost", "depth mm", "shear mm", "time s",
    "x real time",
)  # fmt: skip
LEADER = {"single": "pusher", "dual": "leader"}


def common(table: str, option: Option) -> Common:
    """What the trials of an option have in common."""
    return Common(table, changes=tuple(f"{LEADER[table]}.{change}" for change in option.changes))


def outcome(table: str, option: Option, trials: Sequence[tuple[str, str, int]]) -> Outcome:
    """The pushes of an option."""
    task = task_of(common(table, option))
    follower = task.role("follower").settings if table == "dual" else None
    plant = Plant(trials, 2 if table == "dual" else 1, option.variation, option.physics)
    return push(plant, task.role(LEADER[table]).settings, follower, option.variant)


def trials_of(table: str, count: int) -> list[tuple[str, str, int]]:
    """Object, floor and seed."""
    return [(*row, seed) for seed in range(1, count + 1) for row in load_tables()[table].rows()]


def line(name: str, found: Outcome, trials: Sequence[tuple[str, str, int]], cpu_s: float) -> str:
    """Of one option: errors of the pushes that arrived, how many missed the target, and how fast all were."""
    arrived = ~found.missed & np.isfinite(found.error)
    error, rest = np.abs(found.error[arrived]), [t for t, well in zip(trials, arrived, strict=True) if well]
    if not rest:
        return f"| {name} | | | | | {len(trials)} | | | | | |"
    rows = {trial[:2]: row_mean(error, rest, trial[:2]) for trial in rest}
    worst = max(rows, key=lambda row: rows[row])
    numbers = [
        f"{error.mean():.2f} ± {error.std():.2f}",
        f"{np.percentile(error, 95):.2f}",
        f"{error.max():.2f}",
        f"{rows[worst]:.2f} ({', '.join(worst)})",
        f"{len(trials) - len(rest)}",
        f"{found.lost.sum()}",
        " / ".join(f"{1e3 * depth.mean():.1f}" for depth in found.depth),
        f"{1e3 * found.shear.mean():.2f}",
        f"{found.seconds.mean():.1f}",
        f"{found.seconds.sum() / cpu_s:.0f}",
    ]
    return f"| {name} | {' | '.join(numbers)} |"


def row_mean(error: NDArray[Any], trials: Sequence[tuple[str, str, int]], row: tuple[str, ...]) -> float:
    """Mean error of an object on a floor, mm."""
    return float(np.mean([value for value, trial in zip(error, trials, strict=True) if trial[:2] == row]))


def compare(table: str, names: Sequence[str], count: int) -> None:
    """Print the table of the options, as they come."""
    trials = trials_of(table, count)
    print(f"\n{table}: {len(trials)} trials of each option\n")
    print(f"| option | {' | '.join(COLUMNS)} |")
    print("| --- |" + " --- |" * len(COLUMNS))
    for name, option in OPTIONS[table].items():
        if names and name not in names:
            continue
        started = time.process_time()
        found = outcome(table, option, trials)
        print(line(name, found, trials, time.process_time() - started), flush=True)


def check(tables: Sequence[str], names: Sequence[str], count: int) -> None:
    """Signed errors here and in the loop without ROS, mm."""
    for table in tables:
        trials = trials_of(table, count)
        for name in names or ("paper", "steering"):
            option = OPTIONS[table][name]
            here = outcome(table, option, trials).error
            for value, (thing, floor, seed) in zip(here, trials, strict=True):
                there = trial_row(Trial(common(table, option), thing, floor, seed))["error_mm"]
                print(
                    f"| {table} | {name} | {thing}, {floor}, {seed} | {value:.2f} | {there:.2f} |", flush=True
                )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tables", nargs="+", default=list(OPTIONS), choices=OPTIONS)
    parser.add_argument("--options", nargs="+", default=[])
    parser.add_argument("--trials", type=int, default=25, help="of each row of a table")
    parser.add_argument("--check", type=int, default=0, metavar="TRIALS", help="compare the two simulations")
    arguments = parser.parse_args()
    if arguments.check:
        check(arguments.tables, arguments.options, arguments.check)
        return
    for table in arguments.tables:
        compare(table, arguments.options, arguments.trials)


if __name__ == "__main__":
    main()
