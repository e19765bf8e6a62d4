"""Controller and task files: YAML to settings and goals; errors name file, line and valid choices."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import config_folder, named_file
from tactile_base.settings import SettingError, unknown_name
from tactile_base.yaml_file import Section, read_yaml
from tactile_control.task import PathGoal
from tactile_control.task_settings import SurfaceFollowingSettings
from tactile_filter import se3

TASKS = ("surface_following",)
GROUPS = tuple(item.name for item in dataclasses.fields(SurfaceFollowingSettings))


@dataclass(frozen=True)
class Task:
    """A task on a scene: the settings of the control chain and the paths to run one after the other."""

    name: str
    scene: str
    controller: str
    settings: SurfaceFollowingSettings
    paths: tuple[PathGoal, ...]

    def goals(self, T_base_start: NDArray[np.float64]) -> tuple[PathGoal, ...]:
        """The paths to run in a row, those without a start of their own from T_base_start (4, 4)."""
        return tuple(dataclasses.replace(g, start=T_base_start) if g.start is None else g for g in self.paths)


def load_controller(
    path: str | Path, base: SurfaceFollowingSettings | None = None
) -> SurfaceFollowingSettings:
    """Settings from a file of config/controllers, over those of `base`. Raises `SettingError`, `OSError`."""
    return _merged(base or SurfaceFollowingSettings(), read_yaml(path))


def task_path(name_or_path: str | Path) -> Path:
    """The file of a task: a path (with .yaml), or the name of one of the packaged tasks.

    Raises `SettingError` with the packaged names if there is none.
    """
    try:
        return named_file("task", name_or_path)
    except FileNotFoundError as error:
        raise SettingError(str(error)) from error


def load_task(
    path: str | Path, scene: str, controllers: str | Path | None = None, controller: str | None = None
) -> Task:
    """The task of a file of config/tasks on the scene of that name.

    Parameters
    ----------
    controllers
        Folder of the controller files, by default `../controllers` seen from the task file if there is one,
        else the packaged ones.
    controller
        Name of one of them in place of the one that the task names.

    Raises
    ------
    SettingError
        With file, line and valid choices.
    OSError
        Where a file cannot be read.
    """
    root = read_yaml(path)
    root.allow("task", "controller", "settings", "scenes")
    name = root.choice("task", TASKS)
    scenes = root.sections("scenes")
    if scene not in scenes:
        root.fail(f"no paths for this scene: {unknown_name(scene, list(scenes))}", "scenes")
    on_scene = scenes[scene]
    on_scene.allow("settings", "paths")
    folder = Path(controllers) if controllers is not None else _controllers_of(Path(path))
    names = sorted(file.stem for file in folder.glob("*.yaml"))
    controller = controller or root.choice("controller", names)
    if controller not in names:
        raise SettingError(f"controller: {unknown_name(controller, names)}")
    settings = load_controller(folder / f"{controller}.yaml")
    for section in (root.section("settings"), on_scene.section("settings")):
        settings = _merged(settings, section)
    return Task(name, scene, controller, settings, _paths(on_scene))


def _controllers_of(task_file: Path) -> Path:
    beside = task_file.resolve().parent.parent / "controllers"
    return beside if beside.is_dir() else config_folder() / "controllers"


def _paths(on_scene: Section) -> tuple[PathGoal, ...]:
    items = on_scene.value("paths")
    if not isinstance(items, list) or not items or not all(isinstance(item, Section) for item in items):
        on_scene.fail("paths must be a list of at least one path with names and values", "paths")
    for index, item in enumerate(items):
        item.name = f"path {index}"
    return tuple(_path_goal(item, index) for index, item in enumerate(items))


def _path_goal(item: Section, index: int) -> PathGoal:
    item.allow("name", "direction_deg", "length", "start", "target", "target_radius")
    start = item.numbers("start", 6, None) if "start" in item.values else None
    target = item.numbers("target", 3, None) if "target" in item.values else None
    try:
        return PathGoal(
            direction=math.radians(item.number("direction_deg")),
            length=item.number("length"),
            start=None if start is None else se3.pose_from_euler(start),
            target=None if target is None else np.array(target),
            target_radius=item.number("target_radius", PathGoal.target_radius),
            name=item.text("name", f"path_{index}"),
        )
    except SettingError:
        raise
    except ValueError as error:
        item.fail(f"{item.name}: {error}")


def _merged(settings: SurfaceFollowingSettings, groups: Section) -> SurfaceFollowingSettings:
    """The settings with {group: {name: value}} in place, one by one so that errors know their line."""
    groups.allow(*GROUPS)
    for group, section in ((name, groups.section(name)) for name in groups.values):
        section.allow(*(item.name for item in dataclasses.fields(getattr(settings, group))))
        for key, value in section.values.items():
            try:
                settings = settings.merged({group: {key: value}})
            except SettingError as error:
                section.fail(str(error), key)
    return settings
