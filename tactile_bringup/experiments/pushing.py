"""Experiments in pushing over the loop without ROS: the paper's tables, and maps of where it works.

A trial is named by its table, object, floor and number, which is its seed: the same trial gives the same row
again, wherever it runs. What all trials of a folder have in common is in `Common`::

    tables = load_tables()
    trial = Trial(Common("single"), "blue_square", "mdf", 3)
    row, run = trial_row(trial), trial_run(trial)
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tactile_base.config_paths import config_path
from tactile_base.jobs import Row
from tactile_base.settings import SettingError, unknown_name
from tactile_base.yaml_file import Section, read_yaml
from tactile_bringup.experiments.pushing_variations import VARIABLES, Setup, Value, drawn, varied
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_bringup.run_sequence import arm_plans
from tactile_control.task_file import Task, load_task, task_path
from tactile_control.tasks.pushing import Pushing
from tactile_filter.filter_settings import load_filter_settings
from tactile_records.runs.metrics import without_nan
from tactile_records.runs.report import Run, report_of
from tactile_scene.scene import Scene
from tactile_scene.scene_file import load_scene
from tactile_scene.simulation import FIDELITIES
from tactile_sim.motions import make_motion
from tactile_sim.pushing_scene import PushedProfiles, PushVariation, read_profiles

TABLES, MAPS = "experiments/lloyd_lepora_pushing.yaml", "experiments/pushing_maps.yaml"
#: All trials side by side in the plane of the floor, with ideal sensors: `pushing_plane`.
PLANE = "plane"
IDEAL = "ideal"
NUMBERS = ("succeeded", "reason", "contact_fraction", "slip_fraction", "work_s", "wall_s")  # of a report


@dataclass(frozen=True)
class Table:
    """One of the paper's tables.

    Attributes
    ----------
    title : str
        For people.
    task, scene : str
        What is run.
    controllers : mapping
        Name of a choice -> ROLE=NAME of what takes the place of the task's controller file; empty: nothing.
    paper : mapping
        (object, floor) -> mean and standard deviation of the paper's error, mm.
    """

    name: str
    title: str
    task: str
    scene: str
    controllers: Mapping[str, str]
    paper: Mapping[tuple[str, str], tuple[float, float]]

    def rows(self, objects: Sequence[str] = (), floors: Sequence[str] = ()) -> list[tuple[str, str]]:
        """Objects and floors of the paper's rows, those of some objects or floors alone where given.

        Raises `SettingError` for a name that none of them has, with those there are.
        """
        for kind, index, wanted in (("object", 0, objects), ("floor", 1, floors)):
            known = list(dict.fromkeys(row[index] for row in self.paper))
            for name in wanted:
                if name not in known:
                    raise SettingError(f"table {self.name}: {kind} {unknown_name(name, known)}")
        rows = [row for row in self.paper if (not objects or row[0] in objects)]
        rows = [row for row in rows if not floors or row[1] in floors]
        if not rows:
            raise SettingError(f"table {self.name}: it has none of these objects on any of these floors")
        return rows


@dataclass(frozen=True)
class Map:
    """Where it works: one row of a table with one or two variables set to some values each.

    `fidelity` is that of the sensors where nothing else is asked for.
    """

    name: str
    table: str
    object: str
    floor: str
    variables: Mapping[str, tuple[Value, ...]]
    fidelity: str = IDEAL

    @staticmethod
    def text(variable: str) -> str:
        """What a variable is, for people."""
        return VARIABLES[variable].text

    def places(self) -> list[tuple[tuple[str, Value], ...]]:
        """All combinations of values, as `Trial.varied` has them."""
        values = ([(name, value) for value in values] for name, values in self.variables.items())
        return list(itertools.product(*values))


@dataclass(frozen=True)
class Common:
    """What trials of one folder have in common.

    Attributes
    ----------
    controller : one of the table's choices
    fidelity : of all sensors; None: as the scene says
    filter : one of config/filters, or a path; empty: config/filter.yaml
    latency : from exposure to command, ms
    changes : settings on top of all files, each as ROLE.GROUP.NAME=VALUE
    arm : only this arm runs; empty: all
    """

    table: str
    controller: str = "paper"
    fidelity: str | None = IDEAL
    filter: str = ""
    latency: float = 10.0
    changes: tuple[str, ...] = ()
    arm: str = ""


@dataclass(frozen=True)
class Trial:
    """One push.

    Attributes
    ----------
    number : int
        Its seed as well.
    varied : tuple
        Name and value of each of `variations.VARIABLES` that is set apart from the trial's own draw.
    """

    common: Common
    object: str
    floor: str
    number: int
    varied: tuple[tuple[str, Value], ...] = ()

    @property
    def name(self) -> str:
        """What tells it from the other trials of its folder."""
        parts = [self.object, self.floor, *(f"{name}={shown(value)}" for name, value in self.varied)]
        return "/".join([*parts, str(self.number)])


def shown(value: Value) -> str:
    """A varied value in names and tables."""
    return value if isinstance(value, str) else f"{value:g}"


@functools.cache
def load_tables(path: Path | None = None) -> dict[str, Table]:
    """The tables of a file, by default the paper's; `SettingError` with file and line."""
    root = read_yaml(path or config_path(TABLES))
    root.allow("tables")
    return {name: _table(name, section) for name, section in root.sections("tables").items()}


def _table(name: str, section: Section) -> Table:
    section.allow("title", "task", "scene", "controllers", "paper")
    choices = section.section("controllers")
    controllers = {choice: choices.text(choice) for choice in choices.values}
    paper = {
        (thing, floor): (floors.numbers(floor, 2)[0], floors.numbers(floor, 2)[1])
        for thing, floors in section.sections("paper").items()
        for floor in floors.values
    }
    title, task, scene = (section.text(key) for key in ("title", "task", "scene"))
    return Table(name, title, task, scene, controllers, paper)


@functools.cache
def load_maps() -> dict[str, Map]:
    """The maps that there are; `SettingError` with file and line."""
    root = read_yaml(config_path(MAPS))
    root.allow("maps")
    return {name: _map(name, section) for name, section in root.sections("maps").items()}


def _map(name: str, section: Section) -> Map:
    section.allow("table", "row", "variables", "fidelity")
    row = section.value("row")
    if not isinstance(row, list) or len(row) != 2:
        section.fail(f"{section.name}.row = {row!r}: must be an object and a floor", "row")
    variables = section.section("variables")
    variables.allow(*VARIABLES)
    if not 1 <= len(variables.values) <= 2:
        section.fail(f"{section.name}.variables: must be one or two", "variables")
    values = {key: tuple(each) for key, each in variables.values.items()}
    table = section.choice("table", list(load_tables()))
    fidelity = section.choice("fidelity", FIDELITIES, IDEAL)
    return Map(name, table, str(row[0]), str(row[1]), values, fidelity)


def map_of(name: str) -> Map:
    """A map by its name; raises `SettingError` with those there are."""
    maps = load_maps()
    if name not in maps:
        raise SettingError(f"map: {unknown_name(name, list(maps))}")
    return maps[name]


def table_of(name: str) -> Table:
    """A table by its name; raises `SettingError` with those there are."""
    tables = load_tables()
    if name not in tables:
        raise SettingError(f"table: {unknown_name(name, list(tables))}")
    return tables[name]


def trial_run(trial: Trial) -> Run:
    """What happened to each arm; `SettingError` where the trial cannot be."""
    setup = setup_of(trial)
    return run_arms_offline(setup.pushing_scene(), setup.task, setup.options)


def trial_row(trial: Trial) -> Row:
    """The row of a trial: what it was, what was drawn for it, and what came of it; NaN is None.

    Raises `ValueError` with the trial's name where it cannot be run.
    """
    setup = setup_of(trial)
    scene = setup.pushing_scene()
    try:
        run = run_arms_offline(scene, setup.task, setup.options)
    except ValueError as error:
        raise ValueError(f"trial {trial.name}: {error}") from error
    numbers = numbers_of(run)
    push = numbers["push"]
    contact = [numbers["contact_fraction"], push["follower_contact_fraction"]]
    row = {
        "name": trial.name,
        "object": trial.object,
        "floor": trial.floor,
        "trial": trial.number,
        "varied": dict(trial.varied),
        **drawn(scene),
        **{name: numbers[name] for name in NUMBERS},
        "contact_lost": any(part is not None and part < 1.0 for part in contact),
        **push,
    }
    return dict(without_nan(row))


def check_trial(trial: Trial) -> None:
    """`SettingError` or `FileNotFoundError` where a trial cannot be, before many are begun."""
    setup = setup_of(trial)
    scene = setup.pushing_scene()
    arm_plans(setup.task, scene, setup.options.arm)
    for body in scene.bodies.values():
        make_motion(scene, body)


def setup_of(trial: Trial) -> Setup:
    """What a trial is made of; `SettingError` or `FileNotFoundError` for what is not there or is wrong."""
    scene, task, profiles, options = _loaded(trial.common)
    options = replace(options, seed=trial.number)
    setup = Setup(scene, task, options, trial.object, trial.floor, profiles, PushVariation())
    return varied(setup, [("latency", trial.common.latency), *trial.varied])


@functools.cache
def task_of(common: Common) -> Task:
    """The task with the controllers and settings that are chosen; `SettingError` for what is not there."""
    table = table_of(common.table)
    if common.controller not in table.controllers:
        raise SettingError(f"controller: {unknown_name(common.controller, list(table.controllers))}")
    chosen = table.controllers[common.controller] or None
    return load_task(task_path(table.task), table.scene, controller=chosen, changes=common.changes)


@functools.cache
def _loaded(common: Common) -> tuple[Scene, Task, PushedProfiles, OfflineOptions]:
    """What is the same for all trials."""
    fidelity = common.fidelity
    if fidelity is not None and fidelity not in (*FIDELITIES, PLANE):
        raise SettingError(f"fidelity: {unknown_name(fidelity, (*FIDELITIES, PLANE))}")
    fidelity = IDEAL if fidelity == PLANE else fidelity
    scene, task = load_scene(table_of(common.table).scene), task_of(common)
    options = OfflineOptions(arm=common.arm or None, filter=load_filter_settings(common.filter))
    return scene if fidelity is None else scene.with_fidelity(fidelity), task, read_profiles(), options


def numbers_of(run: Run) -> dict[str, Any]:
    """All numbers of the arm that pushes."""
    pusher = next(record for record in run.values() if record.work == Pushing.work)
    return report_of(pusher.task).numbers(pusher, run)
