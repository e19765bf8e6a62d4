"""Loads a task on a scene: its files become the graph of processes and the paths to run."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import named_file
from tactile_base.settings import SettingError
from tactile_bringup.graph import ArmOutline, Graph, GraphOptions, SceneOutline, build_graph
from tactile_control.files import load_task, task_path
from tactile_control.task import PathGoal
from tactile_drivers.scene import ArmScene, Scene, load_scene
from tactile_filter.filter_settings import load_filter_settings
from tactile_filter.object.settings import load_object


@dataclass(frozen=True)
class TaskGraph:
    """A graph, the paths to run on it, and what both were made from."""

    graph: Graph
    paths: tuple[PathGoal, ...]
    scene: Scene


def load_task_graph(task: str, scene: str, options: GraphOptions) -> TaskGraph:
    """The graph of a task on a scene, each the name of a packaged one or the path of a file.

    Raises
    ------
    SettingError
        A file holds something wrong; the message names file, line and valid choices.
    FileNotFoundError
        There is no such task or scene; the message lists those that there are.
    """
    loaded = load_scene(scene)
    described = load_task(task_path(task), loaded.name)
    groups: dict[str, dict[str, Any]] = dataclasses.asdict(described.settings)
    paths = described.goals(_start(loaded))
    names = [path.name for path in paths]
    filter_values = dataclasses.asdict(load_filter_settings())
    object_values = _object_values(loaded, options)
    graph = build_graph(described.name, outline(loaded), groups, names, options, filter_values, object_values)
    return TaskGraph(graph, paths, loaded)


def _object_values(scene: Scene, options: GraphOptions) -> dict[str, Any]:
    """The parameters of the belief over the object, from its file; none without one."""
    if not options.object_file:
        return {}
    file = named_file("object", options.object_file)
    arms = [arm.name for arm in scene.arms.values() if arm.sensor is not None]
    settings, places = load_object(file, arms)
    values = dataclasses.asdict(settings)
    for arm, place in places.items():
        values |= {f"place.{arm}.{name}": value for name, value in dataclasses.asdict(place).items()}
    return values


def _start(scene: Scene) -> NDArray[np.float64]:
    """Where the arms start, each in its own base: what a path goes back to before it begins."""
    starts = [arm.T_base_start for arm in scene.arms.values()]
    if any(not np.allclose(start, starts[0]) for start in starts):
        raise SettingError(f"{scene.path}: the arms of one task must start at the same pose in their bases")
    return starts[0]


def outline(scene: Scene) -> SceneOutline:
    """What the graph has to know of a scene."""
    return SceneOutline(scene.name, scene.path.absolute(), tuple(_arm(arm) for arm in scene.arms.values()))


def _arm(arm: ArmScene) -> ArmOutline:
    if arm.sensor is None:
        return ArmOutline(arm.name, None, images=False)
    settings = arm.sensor.settings
    return ArmOutline(arm.name, settings.camera_rate, images=settings.fidelity == "image")
