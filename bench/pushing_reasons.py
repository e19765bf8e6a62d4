"""Why pushes with the paper's controller end where they do: one assumption at a time, in the plane.

python bench/pushing_reasons.py               # all tables of docs/results/pushing.md, "Why"
python bench/pushing_reasons.py --only turning
python bench/pushing_reasons.py --loop        # the slopes again in the loop without ROS: minutes
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent))

from pushing_options import LEADER, STEERING, Option, common, outcome, trials_of
from pushing_plane import Physics, Plant, Variant, push

from tactile_bringup.experiment import Common, Trial, load_tables, numbers_of, setup_of, task_of
from tactile_bringup.offline import run_arms_offline
from tactile_bringup.variations import varied
from tactile_sim.pushing_scene import PushVariation

Array = NDArray[Any]
Row = tuple[str, str]

NOTHING = PushVariation(friction=0.0, center_of_friction=0.0, placement=0.0, angle_deg=0.0)
QUIET = Physics(noise=0.0)
SPREADS = {
    "nothing": NOTHING,
    "friction by 15 %": replace(NOTHING, friction=0.15),
    "centre of friction by 3 mm": replace(NOTHING, center_of_friction=0.003),
    "place by 3 mm": replace(NOTHING, placement=0.003),
    "place by 0.6 mm": replace(NOTHING, placement=0.0006),
    "angle by 2 degrees": replace(NOTHING, angle_deg=2.0),
}
SKIN = QUIET.skin


def _skin(**factors: float) -> Option:
    """With these of the skin's numbers times a factor."""
    values = {name: getattr(SKIN, name) * factor for name, factor in factors.items()}
    return Option(physics=replace(QUIET, skin=replace(SKIN, **values)))


ASSUMPTIONS = {
    "as assumed": Option(physics=QUIET),
    "friction of the tip x 0.5": _skin(friction_tip=0.5),
    "friction of the tip x 2": _skin(friction_tip=2.0),
    "stiffness of the tip x 0.5": _skin(skin_force=0.5, skin_shear=0.5),
    "stiffness of the tip x 2": _skin(skin_force=2.0, skin_shear=2.0),
    "stiffness to shear x 4": _skin(skin_shear=4.0),
    "tip rolls on its radius": Option(physics=replace(QUIET, pressed=0.0)),
    "tip rolls on its radius less the depth": Option(physics=replace(QUIET, pressed=1.0)),
    "objects x 0.75": Option(physics=replace(QUIET, size=0.75)),
    "objects x 1.25": Option(physics=replace(QUIET, size=1.25)),
    "pressure stays in the middle": Option(physics=replace(QUIET, height=0.0)),
    "50 ms later": Option(physics=replace(QUIET, latency=3)),
    "100 ms later": Option(physics=replace(QUIET, latency=6)),
    "switched off at 140 mm": Option(("alignment.cutoff_distance=0.14",), physics=QUIET),
    "switched off at 80 mm": Option(("alignment.cutoff_distance=0.08",), physics=QUIET),
    "integral clipped, but no anti-windup": Option((), Variant(anti_windup=False), physics=QUIET),
    "without Ki": Option(("alignment.ki=0",), physics=QUIET),
    "without Kd": Option(("alignment.kd=0",), physics=QUIET),
}
FOLLOWERS = {
    "follower 5 mm deep": (("servoing.reference=[0,0,0.005,0,0,0]",), ASSUMPTIONS["as assumed"]),
    "follower's gains x 2": (
        ("pid.kp=[10,0,10,2,0,0]", "pid.ki=[1,0,1,0.2,0,0]", "pid.kd=[1,0,1,0.2,0,0]"),
        ASSUMPTIONS["as assumed"],
    ),
}


def errors(
    table: str,
    rows: Sequence[Row],
    option: Option,
    offset: float = 0.0,
    turn: float = 0.0,
    center: float = 0.0,
    follower: Sequence[str] = (),
) -> Array:
    """Signed errors (rows,) mm with nothing drawn; NaN where the target was passed.

    The object is put to the left (mm) and turned (degrees), the centre of friction along the world's x (mm),
    to the right of the way at the start.
    """
    ours = common(table, option)
    task = task_of(replace(ours, changes=(*ours.changes, *(f"follower.{change}" for change in follower))))
    holder = task.role("follower").settings if table == "dual" else None
    plant = Plant([(*row, 0) for row in rows], 2 if table == "dual" else 1, NOTHING, option.physics)
    plant.center[:, 0] -= 1e-3 * offset
    plant.turn += np.radians(turn)
    plant.off_center[:, 0] += 1e-3 * center
    found = push(plant, task.role(LEADER[table]).settings, holder, option.variant)
    return np.where(found.missed, np.nan, found.error)


def rows_of(table: str) -> list[Row]:
    return load_tables()[table].rows()


def head(first: str, columns: Sequence[str]) -> None:
    print(f"| {first} | {' | '.join(columns)} |\n| --- |" + " ---: |" * len(columns))


def line(name: str, cells: Sequence[str]) -> None:
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def named(rows: Sequence[Row]) -> list[str]:
    return [" ".join(row).replace("_", " ") for row in rows]


def spreads(table: str, count: int) -> None:
    """Mean and deviation of each row, over all trials, with one thing drawn."""
    rows, trials = rows_of(table), trials_of(table, count)
    print(f"\n{table}: what is drawn alone; mean ± deviation [mm] of {count} trials (passed)\n")
    head("drawn", named(rows))
    for name, variation in SPREADS.items():
        found, cells = outcome(table, Option(variation=variation), trials), []
        for row in rows:
            mine = np.array([trial[:2] == row for trial in trials])
            error, missed = found.error[mine & ~found.missed], (mine & found.missed).sum()
            cells.append(f"{error.mean():.2f} ± {error.std(ddof=1):.2f}" + f" ({missed})" * bool(missed))
        line(name, cells)


def slopes(table: str) -> None:
    """How much error comes of what, and how much of it the paper's mean would take."""
    rows, paper = rows_of(table), load_tables()[table].paper
    option = ASSUMPTIONS["as assumed"]
    start = errors(table, rows, option)

    def slope(**one: float) -> Array:
        (name, step), *_ = one.items()
        ends = [errors(table, rows, option, **{name: sign * step}) for sign in (1.0, -1.0)]
        return (ends[0] - ends[1]) / (2.0 * step)

    lines = {
        "nothing varied [mm]": start,
        "of 1 mm of place [mm]": slope(offset=0.5),
        "of 1 mm of centre of friction [mm]": (center := slope(center=0.5)),
        "of 1 degree [mm]": slope(turn=1.0),
        "the paper's mean [mm]": np.array([paper[row][0] for row in rows]),
        "the paper's deviation [mm]": np.array([paper[row][1] for row in rows]),
    }
    if table == "single":
        means = lines["the paper's mean [mm]"]
        with_sign = np.stack([(sign * means - start) / center for sign in (1.0, -1.0)])
        lines["centre of friction that gives it [mm]"] = np.abs(with_sign).min(axis=0)
    print(f"\n{table}: error by cause\n")
    head("", named(rows))
    for name, values in lines.items():
        line(name, [f"{value:.2f}" for value in values])


def assumptions(table: str, rows: Sequence[Row]) -> None:
    """Error with nothing varied, and what 1 mm of place adds."""
    cases = {name: ((), option) for name, option in ASSUMPTIONS.items()}
    cases |= FOLLOWERS if table == "dual" else {}
    print(f"\n{table}: error with nothing varied [mm], and what 1 mm of place adds [mm]\n")
    head("assumed", named(rows))
    for name, (follower, option) in cases.items():
        zero, more = (errors(table, rows, option, offset, follower=follower) for offset in (0.0, 1.0))
        line(name, [f"{a:.2f}, {b - a:+.2f}" for a, b in zip(zero, more, strict=True)])


def offsets() -> None:
    """The error over the object's place, of two arms."""
    rows = [("blue_circle", "foam"), ("blue_circle", "mdf"), ("blue_square", "mdf")]
    print("\ndual: error over the object's place to the left [mm]\n")
    head("place", named(rows))
    for offset in (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0):
        found = errors("dual", rows, ASSUMPTIONS["as assumed"], offset)
        line(f"{offset:g}", [f"{value:.2f}" for value in found])


def turning() -> None:
    """A of the whole push, and the distance from the target at which a sideways motion turns its sign."""
    whole = (*STEERING, "steering.memory=10", "steering.turning_deviation=100")
    print("\nturning of the contact normal with the way sideways, a, and where its sign changes, 1 / a\n")
    head("row", ["one arm: a [1/m]", "1 / a [mm]", "two arms: a [1/m]", "1 / a [mm]"])
    rows, found = rows_of("single"), []
    for table in ("single", "dual"):
        option = Option(whole, variation=NOTHING, physics=QUIET)
        found.append(outcome(table, option, [(*row, 0) for row in rows]).turning)
    for name, one, two in zip(named(rows), *found, strict=True):
        line(name, [f"{value:.1f}" for a in (one, two) for value in (a, 1e3 / a)])


def loop() -> None:
    """Signed errors in the loop without ROS with nothing drawn, by the object's place to the left (mm)."""
    print("\nin the loop without ROS: error over the object's place to the left [mm]\n")
    places = (-1.0, 0.0, 1.0)
    head("row", [f"{place:g}" for place in places])
    for table in ("single", "dual"):
        for row in rows_of(table):
            cells = []
            for place in places:
                setup = replace(setup_of(Trial(Common(table), *row, 0)), variation=NOTHING)
                setup = varied(setup, [("offset", place)])
                found = numbers_of(run_arms_offline(setup.pushing_scene(), setup.task, setup.options))
                cells.append(f"{found['push']['error_mm']:.2f}" if found["succeeded"] else "passed")
            line(f"{table}: {named([row])[0]}", cells)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = ("spreads", "slopes", "assumptions", "offsets", "turning")
    parser.add_argument("--only", nargs="+", default=names, choices=names)
    parser.add_argument("--trials", type=int, default=25, help="of each row, where something is drawn")
    parser.add_argument("--loop", action="store_true", help="in the loop without ROS instead")
    arguments = parser.parse_args()
    if arguments.loop:
        loop()
        return
    wanted = set(arguments.only)
    for table in ("single", "dual"):
        if "spreads" in wanted:
            spreads(table, arguments.trials)
        if "slopes" in wanted:
            slopes(table)
        if "assumptions" in wanted:
            rows = rows_of(table) if table == "single" else [("blue_square", "mdf"), ("blue_circle", "mdf")]
            assumptions(table, rows)
    if "offsets" in wanted:
        offsets()
    if "turning" in wanted:
        turning()


if __name__ == "__main__":
    main()
