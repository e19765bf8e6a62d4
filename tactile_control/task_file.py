"""Task and controller files: YAML to roles, settings and goals; errors name file, line and valid choices.

A task file says who does what on a scene: for each role which task, with which controller file, and on each
scene which arms have the role and which goals they run one after the other (docs/tasks.md); `other` stands
for scenes that have no name here::

    roles:
      leader: {task: trajectory}
      follower: {task: object_tracking, controller: object_tracking_tuned}
    scenes:
      tracking_flat:
        leader: {arms: [leader], after: {follower: track}, ends_run: true, goals: [{displacement: [...]}]}
        follower: {arms: [follower], goals: [{name: track}]}
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import config_folder, named_file
from tactile_base.settings import SettingError, SettingGroups, unknown_name
from tactile_base.yaml_file import Section, name_and_value, read_yaml
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import Goal
from tactile_control.tasks import TASKS
from tactile_geometry import se3

Array = NDArray[np.float64]
TASK_GROUPS = "tasks"  # in a controller file: groups of settings that only some tasks have, by task
SUFFIXES = (".yaml", ".yml")
OTHER = "other"  # among a task's scenes: those that it does not name
G = TypeVar("G", bound=SettingGroups)


@dataclass(frozen=True)
class NamedGoal:
    """One goal to run.

    Attributes
    ----------
    name : str
        For people.
    goal : Goal
        Of the task's `goal_class`.
    start : ndarray (4, 4) or None
        Pose of the controlled frame in the base from which the goal begins; None: where the arm starts in
        the scene.
    """

    name: str
    goal: Goal
    start: Array | None = None


@dataclass(frozen=True)
class Role:
    """What some arms of a scene do.

    Attributes
    ----------
    task : str
        Name in the registry `TASKS`.
    controller : str
        The file of config/controllers, or the path, that the settings began with; '' for none.
    settings : SettingGroups
        Of the task's `settings_class`.
    arms : tuple of str
        The arms that have the role; empty: every arm that can run the task.
    goals : tuple of NamedGoal
        Run one after the other.
    after : tuple (str, str) or None
        Role and phase: the goals wait until every arm of that role has reached that phase, and later rest
        as long as one of them waits for its inputs or fails.
    ends_run : bool
        The run is over when the arms of this role have done their goals; those of the others then end, too.
    """

    name: str
    task: str
    settings: SettingGroups
    goals: tuple[NamedGoal, ...]
    controller: str = ""
    arms: tuple[str, ...] = ()
    after: tuple[str, str] | None = None
    ends_run: bool = False

    @functools.cached_property
    def task_type(self) -> type[PhaseMachine]:
        """The class of its task; looked up once, since a search for entry points takes milliseconds."""
        return TASKS.load(self.task)


@dataclass(frozen=True)
class Task:
    """A task file on a scene."""

    name: str
    scene: str
    roles: tuple[Role, ...] = field(default_factory=tuple)

    def role(self, name: str) -> Role:
        """The role of that name; raises `SettingError` with the names there are."""
        for role in self.roles:
            if role.name == name:
                return role
        raise SettingError(f"role: {unknown_name(name, [role.name for role in self.roles])}")


def load_controller(path: str | Path, base: G) -> G:
    """Settings from a file of config/controllers, over those of `base`. Raises `SettingError`, `OSError`.

    Groups that only one task has stand below its name in `tasks`; for others, which take the gains, they do
    not count.
    """
    root = read_yaml(path)
    settings = _merged(base, root, TASK_GROUPS)
    for name, groups in root.sections(TASK_GROUPS).items():
        if name not in TASKS.names():
            root.fail(f"{TASK_GROUPS}: {unknown_name(name, TASKS.names())}", TASK_GROUPS)
        if isinstance(base, TASKS.load(name).settings_class):
            settings = _merged(settings, groups)
    return settings


def task_path(name_or_path: str | Path) -> Path:
    """The file of a task: a path (with .yaml), or the name of one of the packaged tasks.

    Raises `SettingError` with the packaged names if there is none.
    """
    try:
        return named_file("task", name_or_path)
    except FileNotFoundError as error:
        raise SettingError(str(error)) from error


def default_scene(path: str | Path) -> str:
    """The first scene that a task file names. Raises `SettingError` if it names none."""
    root = read_yaml(path)
    scenes = root.sections("scenes")
    if not scenes:
        root.fail("scenes: a task must have goals on at least one", "scenes")
    return next(iter(scenes))


def load_task(
    path: str | Path,
    scene: str,
    controllers: str | Path | None = None,
    controller: str | None = None,
    changes: Sequence[str] = (),
    goals_of: str = "",
) -> Task:
    """The task of a file of config/tasks on the scene of that name.

    Parameters
    ----------
    controllers
        Folder of the controller files, by default `../controllers` seen from the task file if there is one,
        else the packaged ones.
    controller
        Name of one of them, or a path (with .yaml), in place of those that the task names for the roles that
        feel; ROLE=NAME for one.
    changes
        Settings on top of all files, each as ROLE.GROUP.NAME=VALUE; with one role its name may be left out.
    goals_of
        The scene whose goals it takes where the task does not name it.

    Raises
    ------
    SettingError
        With file, line and valid choices.
    OSError
        Where a file cannot be read.
    """
    root = read_yaml(path)
    root.allow("description", "roles", "scenes")
    roles, scenes = root.sections("roles"), root.sections("scenes")
    if not roles:
        root.fail("roles: a task must have at least one")
    here = scenes.get(scene, scenes.get(goals_of, scenes.get(OTHER)))
    if here is None:
        unknown = unknown_name(goals_of or scene, list(scenes))
        root.fail(
            f"no goals for this scene: {unknown}; say in the scene whose it takes, as `goals_of: "
            f"{next(iter(scenes))}`, or in a copy of this file what arms do there",
            "scenes",
        )
    here.allow(*roles)
    folder = Path(controllers) if controllers is not None else _controllers_of(Path(path))
    only = (controller or "").rpartition("=")[0]
    if only and only not in roles:
        raise SettingError(f"controller {controller}: role {unknown_name(only, list(roles))}")
    loaded = [
        _role(name, section, here.section(name), folder, controller, roles) for name, section in roles.items()
    ]
    task = Task(Path(path).stem, scene, tuple(loaded))
    for change in changes:
        task = _changed(task, change)
    return task


def _role(
    name: str,
    section: Section,
    on_scene: Section,
    folder: Path,
    controller: str | None,
    roles: dict[str, Section],
) -> Role:
    section.allow("task", "controller", "settings")
    on_scene.allow("arms", "after", "ends_run", "settings", "goals")
    task = section.choice("task", list(TASKS.names()))
    task_type = TASKS.load(task)
    names = sorted(file.stem for file in folder.glob("*.yaml"))
    chosen = section.choice("controller", names) if "controller" in section.values else ""
    only, _, wanted = (controller or "").rpartition("=")
    if controller is not None and (only == name if only else task_type.needs_sensor):
        if wanted not in names and not wanted.endswith(SUFFIXES):
            raise SettingError(f"controller: {unknown_name(wanted, names)}; or give the path of a .yaml file")
        chosen = wanted
    settings = task_type.settings_class()
    if chosen:
        file = Path(chosen) if chosen.endswith(SUFFIXES) else folder / f"{chosen}.yaml"
        settings = load_controller(file, settings)
    for changes in (section.section("settings"), on_scene.section("settings")):
        settings = _merged(settings, changes)
    ends = on_scene.value("ends_run", False)
    if not isinstance(ends, bool):
        on_scene.fail(f"{on_scene.name}.ends_run = {ends!r}: must be true or false", "ends_run")
    return Role(
        name=name,
        task=task,
        controller=chosen,
        settings=settings,
        arms=_arms(on_scene),
        goals=_goals(on_scene, task_type),
        after=_after(on_scene, {other: roles[other] for other in roles if other != name}),
        ends_run=ends,
    )


def _arms(on_scene: Section) -> tuple[str, ...]:
    arms = on_scene.value("arms", [])
    if not isinstance(arms, list):
        on_scene.fail(f"{on_scene.name}.arms = {arms!r}: must be a list of names", "arms")
    return tuple(map(str, arms))


def _after(on_scene: Section, others: dict[str, Section]) -> tuple[str, str] | None:
    if "after" not in on_scene.values:
        return None
    after = on_scene.section("after")
    if len(after.values) != 1:
        on_scene.fail(
            f"{on_scene.name}.after: must name one role and its phase, as {{follower: track}}", "after"
        )
    role = next(iter(after.values))
    after.allow(*others)
    awaited = TASKS.load(others[role].choice("task", list(TASKS.names())))
    return role, after.choice(role, awaited.phases)


def _goals(on_scene: Section, task_type: type[PhaseMachine]) -> tuple[NamedGoal, ...]:
    items = on_scene.value("goals")
    if not isinstance(items, list) or not items or not all(isinstance(item, Section) for item in items):
        on_scene.fail("goals must be a list of at least one goal with names and values", "goals")
    for index, item in enumerate(items):
        item.name = f"goal {index}"
    return tuple(_goal(item, index, task_type) for index, item in enumerate(items))


def _goal(item: Section, index: int, task_type: type[PhaseMachine]) -> NamedGoal:
    start = se3.pose_from_euler(item.numbers("start", 6)) if "start" in item.values else None
    values = {key: value for key, value in item.values.items() if key not in ("name", "start")}
    return NamedGoal(item.text("name", f"goal_{index}"), item.checked(task_type.goal_class, values), start)


def _controllers_of(task_file: Path) -> Path:
    beside = task_file.resolve().parent.parent / "controllers"
    return beside if beside.is_dir() else config_folder() / "controllers"


def _merged(settings: G, groups: Section, *others: str) -> G:
    """The settings with {group: {name: value}} in place, one by one so that errors know their line.

    `others` are names of what else may stand there.
    """
    groups.allow(*settings.group_names(), *others)
    for group, section in ((name, groups.section(name)) for name in groups.values if name not in others):
        section.allow(*(item.name for item in dataclasses.fields(settings.group(group))))
        for key, value in section.values.items():
            try:
                settings = settings.merged({group: {key: value}})
            except SettingError as error:
                section.fail(str(error), key)
    return settings


def _changed(task: Task, change: str) -> Task:
    """The task with one setting changed, given as [ROLE.]GROUP.NAME=VALUE."""
    path, value = name_and_value(change, "follower.pid.ewma_decay=0.6")
    parts = path.split(".")
    if len(parts) == 2 and len(task.roles) == 1:
        parts = [task.roles[0].name, *parts]
    if len(parts) != 3:
        raise SettingError(f"--set {change}: must have the form ROLE.GROUP.NAME=VALUE")
    name, group, key = parts
    role = task.role(name)
    settings = role.settings.merged({group: {key: value}}, f"--set {change}")
    changed = dataclasses.replace(role, settings=settings)
    roles = tuple(changed if item is role else item for item in task.roles)
    return dataclasses.replace(task, roles=roles)
