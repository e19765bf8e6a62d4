"""Controller and task files: YAML to settings and goals; errors name file, line and valid choices."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tactile_control.task import PathGoal
from tactile_control.task_settings import SurfaceFollowingSettings
from tactile_filter import se3
from tactile_filter.settings import SettingError, unknown_name

TASKS = ("surface_following",)
TASK_KEYS = ("task", "controller", "settings", "scenes")
SCENE_KEYS = ("settings", "paths")
PATH_KEYS = ("name", "direction_deg", "length", "start", "target", "target_radius")
GROUPS = tuple(item.name for item in dataclasses.fields(SurfaceFollowingSettings))


@dataclass(frozen=True)
class Task:
    """A task on a scene: the settings of the control chain and the paths to run one after the other."""

    name: str
    scene: str
    controller: str
    settings: SurfaceFollowingSettings
    paths: tuple[PathGoal, ...]


def load_controller(
    path: str | Path, base: SurfaceFollowingSettings | None = None
) -> SurfaceFollowingSettings:
    """Settings from a file of config/controllers, over those of `base`. Raises `SettingError`, `OSError`."""
    document = _Document(path)
    return document.merge(
        base or SurfaceFollowingSettings(), document.mapping(document.data, "the file", GROUPS)
    )


def load_task(path: str | Path, scene: str, controllers: str | Path | None = None) -> Task:
    """The task of a file of config/tasks on the scene of that name.

    `controllers` is the folder of the controller files, by default `../controllers` seen from the task file.
    Raises `SettingError` with file, line and valid choices, and `OSError` where a file cannot be read.
    """
    document = _Document(path)
    data = document.mapping(document.data, "the file", TASK_KEYS)
    name = document.choice(data, "task", TASKS)
    scenes = document.mapping(data.get("scenes"), "scenes")
    if scene not in scenes:
        raise SettingError(
            f"{document.where(scenes)}: no paths for this scene: {unknown_name(scene, list(scenes))}"
        )
    on_scene = document.mapping(scenes[scene], f"scenes.{scene}", SCENE_KEYS)
    folder = (
        Path(controllers) if controllers is not None else Path(path).resolve().parent.parent / "controllers"
    )
    controller = document.choice(data, "controller", sorted(p.stem for p in folder.glob("*.yaml")))
    settings = load_controller(folder / f"{controller}.yaml")
    for values in (data.get("settings", {}), on_scene.get("settings", {})):
        settings = document.merge(settings, document.mapping(values, "settings", GROUPS))
    paths = on_scene.get("paths")
    if not isinstance(paths, list) or not paths:
        raise SettingError(f"{document.where(on_scene)}: paths must be a list of at least one path")
    goals = tuple(_path_goal(document, item, index) for index, item in enumerate(paths))
    return Task(name, scene, controller, settings, goals)


def _path_goal(document: _Document, item: Any, index: int) -> PathGoal:
    item = document.mapping(item, f"path {index}", PATH_KEYS)
    for key in ("direction_deg", "length"):
        if key not in item:
            raise SettingError(f"{document.where(item)}: path {index} has no {key}")
    try:
        start, target = item.get("start"), item.get("target")
        return PathGoal(
            direction=math.radians(float(item["direction_deg"])),
            length=float(item["length"]),
            start=None if start is None else se3.pose_from_euler(np.array(start, dtype=float)),
            target=None if target is None else np.array(target, dtype=float),
            target_radius=float(item.get("target_radius", PathGoal.target_radius)),
            name=str(item.get("name", f"path_{index}")),
        )
    except (ValueError, TypeError) as error:
        raise SettingError(f"{document.where(item)}: path {index}: {error}") from error


class _Lines(yaml.SafeLoader):
    """Safe loader whose mappings remember their line, and that refuses a name given twice."""


class _Mapping(dict[str, Any]):
    line = 0
    lines: dict[str, int]


def _construct_mapping(loader: _Lines, node: yaml.MappingNode) -> _Mapping:
    mapping = _Mapping()
    mapping.line, mapping.lines = node.start_mark.line + 1, {}
    for key_node, value_node in node.value:
        key = str(loader.construct_object(key_node, deep=True))
        if key in mapping:
            raise yaml.constructor.ConstructorError(
                None, None, f"'{key}' is given twice", key_node.start_mark
            )
        mapping.lines[key] = key_node.start_mark.line + 1
        mapping[key] = loader.construct_object(value_node, deep=True)
    return mapping


_Lines.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)


class _Document:
    """One YAML file, with checks that know the line."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self.data = yaml.load(self.path.read_text(), Loader=_Lines)
        except yaml.MarkedYAMLError as error:
            line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
            raise SettingError(f"{self.path}{line}: {error.problem}") from error

    def where(self, value: Any, key: str | None = None) -> str:
        lines = getattr(value, "lines", {})
        line = lines.get(key) if key in lines else getattr(value, "line", 0)
        return f"{self.path}:{line}" if line else str(self.path)

    def mapping(self, value: Any, name: str, keys: tuple[str, ...] | None = None) -> Mapping[str, Any]:
        """The value as a mapping whose names are among `keys`."""
        if not isinstance(value, Mapping):
            raise SettingError(f"{self.path}: {name} must hold names and values, is {value!r}")
        for key in value:
            if keys is not None and key not in keys:
                raise SettingError(f"{self.where(value, key)}: {unknown_name(key, keys)}")
        return value

    def choice(self, data: Mapping[str, Any], key: str, choices: tuple[str, ...] | list[str]) -> str:
        value = data.get(key)
        if value not in choices:
            raise SettingError(f"{self.where(data, key)}: {key}: {unknown_name(str(value), choices)}")
        return str(value)

    def merge(
        self, settings: SurfaceFollowingSettings, groups: Mapping[str, Any]
    ) -> SurfaceFollowingSettings:
        """The settings with {group: {name: value}} in place, one by one so that errors know their line."""
        for group, values in groups.items():
            names = tuple(item.name for item in dataclasses.fields(getattr(settings, group)))
            for key, value in self.mapping(values, group, names).items():
                settings = settings.merged({group: {key: value}}, self.where(values, key))
        return settings
