"""What each option of pushing does to the final error, over the rows of the paper's three tables.

Every option pushes the same trials (object, floor and seed) at the ideal level of fidelity, so that options
are compared trial by trial; for speed with images at 30 Hz, simulated at 60 Hz, and a step of the controller
at each image. Rows are kept as they come: a second call goes on where the first one ended.

    python bench/pushing_options.py --trials 12 --processes 2 --out out/pushing_options
    python bench/pushing_options.py --options paper steering --tables single
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactile_bringup.experiment import Common, Trial, load_tables, numbers_of, table_of, task_of
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_bringup.trials import Row, TrialRows, run_trials
from tactile_drivers.scene import Scene, load_scene
from tactile_drivers.sim.pushing_scene import pushing_scene

LEADER = {"single": "pusher", "dual": "leader", "tall": "leader"}
#: Settings of the arm that pushes on top of the paper's.
OPTIONS: dict[str, tuple[str, ...]] = {
    "paper": (),
    "steering": ("steering.enabled=true",),
}

KEPT = ("succeeded", "reason", "contact_fraction", "slip_fraction", "work_s")  # of a run's numbers


def trials(option: str, table: str, count: int) -> list[Trial]:
    """The trials of an option on a table."""
    changes = tuple(f"{LEADER[table]}.{change}" for change in OPTIONS[option])
    common = Common(table, changes=changes)
    rows = load_tables()[table].rows()
    return [Trial(common, *row, number) for number in range(1, count + 1) for row in rows]


def push(trial: Trial) -> Row:
    """The row of a trial."""
    scene = load_scene(table_of(trial.common.table).scene).with_fidelity("ideal")
    scene = pushing_scene(slower(scene), trial.object, trial.floor, trial.number)
    options = OfflineOptions(seed=trial.number, control_period=0.05)
    values = numbers_of(run_arms_offline(scene, task_of(trial.common), options))
    row = {
        name: values[name] for name in ("succeeded", "reason", "contact_fraction", "slip_fraction", "work_s")
    }
    return {"name": trial.name, "object": trial.object, "floor": trial.floor, **row, **values["push"]}


def slower(scene: Scene) -> Scene:
    """The scene with images at 30 Hz and a simulation at 60 Hz."""
    arms = {}
    for name, arm in scene.arms.items():
        assert arm.sensor is not None
        sensor = replace(arm.sensor, settings=arm.sensor.settings.replaced(camera_rate=30.0))
        arms[name] = replace(arm, sensor=sensor)
    return replace(scene, arms=arms, simulation=replace(scene.simulation, rate=60))


def results(folder: Path, option: str, tables: list[str], count: int, processes: int) -> dict[str, list[Row]]:
    """The rows of an option by table, those that are missing run now."""
    found = {}
    for table in tables:
        wanted, rows = trials(option, table, count), TrialRows(folder / f"{option}.{table}.jsonl")
        for row in run_trials(push, rows.missing(wanted), processes):
            rows.add(row)
        found[table] = rows.of(wanted)
    return found


def errors(rows: list[Row]) -> np.ndarray[Any, Any]:
    """Absolute errors of the pushes that arrived, mm."""
    return np.array([row["error_abs_mm"] for row in rows if row["succeeded"]])


def means(rows: list[Row]) -> dict[str, float]:
    """Mean error by object and floor, mm."""
    names = dict.fromkeys(f"{row['object']}, {row['floor']}" for row in rows)
    return {
        name: float(errors([row for row in rows if f"{row['object']}, {row['floor']}" == name]).mean())
        for name in names
    }


def line(option: str, rows: list[Row], paper: dict[str, Row]) -> str:
    """One line of the comparison."""
    by_row, found = means(rows), errors(rows)
    worst = max(by_row, key=lambda name: by_row[name])
    better = [
        row["error_abs_mm"] < paper[row["name"]]["error_abs_mm"]
        for row in rows
        if row["succeeded"] and paper[row["name"]]["succeeded"]
    ]
    lost = sum((row["contact_fraction"] or 0.0) < 1.0 for row in rows)
    return (
        f"| {option} | {len(found)}/{len(rows)} | {found.mean():.2f} ± {found.std():.2f} | "
        f"{np.percentile(found, 95):.2f} | {found.max():.2f} | {by_row[worst]:.2f} ({worst}) | "
        f"{100 * np.mean(better):.0f} % | {lost} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--options", nargs="+", default=list(OPTIONS), choices=OPTIONS)
    parser.add_argument("--tables", nargs="+", default=list(LEADER), choices=LEADER)
    parser.add_argument("--trials", type=int, default=12, help="of each row of the tables")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/pushing_options"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = {}
    for option in arguments.options:
        found[option] = results(
            arguments.out, option, arguments.tables, arguments.trials, arguments.processes
        )
    print("| option | arrived | error mm | 95 % | largest | worst row's mean | nearer than paper | lost |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for table in [*arguments.tables, "all"]:
        print(f"| **{table}** |")
        chosen = arguments.tables if table == "all" else [table]
        paper = {f"{t}{row['name']}": row for t in chosen for row in found["paper"][t]}
        for option, by_table in found.items():
            rows = [replace_name(row, t) for t in chosen for row in by_table[t]]
            print(line(option, rows, paper))
    print()
    for table in arguments.tables:
        for name in means(found["paper"][table]):
            print(
                f"| {table}: {name} | " + " | ".join(f"{means(by[table])[name]:.2f}" for by in found.values())
            )


def replace_name(row: Row, table: str) -> Row:
    """The row with its table in its name, and in that of its object."""
    return {**row, "name": f"{table}{row['name']}", "object": f"{table} {row['object']}"}


if __name__ == "__main__":
    main()
