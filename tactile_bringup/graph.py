"""The graph of a task: which processes run, with which names, parameters and topics.

One description, built from scene, task and options, from which `tactile launch` starts processes and
`launch/*.launch.py` builds its launch description. Only what the scene names, and the task has a role for, is
in it: an estimator, a filter and a controller for each arm; the simulator that is the cell; and where they
are asked for, a recorder and a belief over one object that all arms touch.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tactile_base.config_paths import named_file
from tactile_base.origin import origin
from tactile_base.topics import (
    ARM_TOPICS,
    IMAGE,
    JOINT_STATES,
    OBJECT_TOPICS,
    ROBOT_DESCRIPTION,
    SENSOR_TOPICS,
    SHARED_TOPICS,
    Topic,
    compressed,
)
from tactile_bringup.run_sequence import ArmPlan, arm_plans, awaited_by, waiting_for
from tactile_bringup.scene_check import check_bodies
from tactile_control.task_file import default_scene, load_task, task_path
from tactile_doubles.rehearsal import rehearsed
from tactile_filter.filter_settings import load_filter_settings
from tactile_filter.object.settings import load_object
from tactile_perception.estimating.model_metadata import SIMULATED_ONLY
from tactile_scene.camera import COMPRESSED, ExternalCameraSettings
from tactile_scene.scene import EXTERNAL, SIM, ArmScene, Scene
from tactile_scene.scene_file import load_scene

RECORDER = "recorder"
LOOKING_PERIOD = 0.008  # s between two steps of a task that looks at the images itself


@dataclass(frozen=True)
class NodeProcess:
    """One node in a process of its own.

    Attributes
    ----------
    name, namespace : of the node; the namespace is "/" or "/<arm>"
    module : Python module whose `main` runs the node
    executable : its name for `ros2 run tactile_servoing`
    parameters : parameter name -> value
    remappings : topics that have other names, as (from, to)
    params_file : a user's file of ROS parameters on top of these
    """

    name: str
    namespace: str
    module: str
    executable: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    remappings: tuple[tuple[str, str], ...] = ()
    params_file: Path | None = None

    @property
    def full_name(self) -> str:
        """Namespace and name, as `/arm/filter`."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def file_stem(self) -> str:
        """The full name for files: `arm.filter`."""
        return self.full_name.strip("/").replace("/", ".")

    def parameter_text(self) -> str:
        """A ROS parameter file for this node alone."""
        # an empty list has no type in a ROS parameter file; left out, the node's own empty default stands
        values = {name: _plain(value) for name, value in self.parameters.items() if value not in ([], ())}
        values["autostart"] = True
        return yaml.safe_dump({self.full_name: {"ros__parameters": values}}, sort_keys=False)

    def command(self, parameter_file: Path, python: str = sys.executable) -> list[str]:
        """The command line that runs the node."""
        names = [("__node", self.name), ("__ns", self.namespace), *self.remappings]
        renamed = [word for name, to in names for word in ("-r", f"{name}:={to}")]
        files = [parameter_file, *([self.params_file] if self.params_file is not None else [])]
        given = [word for file in files for word in ("--params-file", str(file))]
        enclave = ["--enclave", self.full_name]  # whose keys it has, where DDS security is on
        return [python, "-m", self.module, "--ros-args", *enclave, *renamed, *given]


@dataclass(frozen=True)
class GraphOptions:
    """What a user chooses when a task is started.

    Attributes
    ----------
    rate : exposures a second; None for the scene's own
    seed : of the simulated cell
    model : of all estimators; None: the one that the scene names for each sensor, else the shipped one
    filter : one of config/filters, or a path; empty: config/filter.yaml
    controller : one of config/controllers, or a path, in place of those that the task names
    changes : settings on top of all files, each as ROLE.GROUP.NAME=VALUE
    goals : names of the goals to run; empty: all
    record : the bag to write
    record_images : whether images go into the bag, compressed without loss
    marker_view : whether each sensor with images gets a node that publishes a picture of its markers
    object_belief : whether the contacts of all arms are fused into one belief over the object that they touch
    object_file : where they touch it: the name of one of config/objects or a path
        (`tactile_filter.object.settings`); empty: that is found by touch
    priority : SCHED_FIFO priority of the nodes from exposure to motion; 0: none
    cores : on which these run; empty: any
    rehearse : whether doubles stand for the arms, and simulated cameras for the cameras
    """

    rate: float | None = None
    seed: int = 0
    model: Path | None = None
    filter: str = ""
    controller: str | None = None
    changes: tuple[str, ...] = ()
    goals: tuple[str, ...] = ()
    record: Path | None = None
    record_images: bool = False
    marker_view: bool = False
    object_belief: bool = False
    priority: int = 0
    cores: tuple[int, ...] = ()
    object_file: str = ""
    rehearse: bool = False


@dataclass(frozen=True)
class Graph:
    """All processes of a task, in the order in which they start, the topics between them, and what is run.

    Attributes
    ----------
    task, scene : names, for people
    arms : arms that run something
    plans : what each of them does
    remarks : what whoever starts it has to know
    """

    task: str
    scene: str
    scene_file: Path
    arms: tuple[str, ...]
    nodes: tuple[NodeProcess, ...]
    topics: tuple[Topic, ...]
    plans: tuple[ArmPlan, ...] = ()
    remarks: tuple[str, ...] = ()

    def node(self, full_name: str) -> NodeProcess:
        """The node of that full name; raises KeyError with the names there are."""
        for node in self.nodes:
            if node.full_name == full_name:
                return node
        raise KeyError(f"{full_name}; nodes: {', '.join(n.full_name for n in self.nodes)}")


def check_options(options: GraphOptions, spelling: str) -> None:
    """Raise ValueError for what a node would find out only seconds later; `spelling` as in "--{} {}"."""
    if options.record is not None and options.record.exists():
        given = spelling.format("record", options.record)
        raise ValueError(f"{given}: exists already; remove it or record elsewhere")
    if options.model is not None and not options.model.is_file():
        raise ValueError(f"{spelling.format('model', options.model)}: no such file")
    if missing := sorted({*options.cores} - os.sched_getaffinity(0)):
        given, there = spelling.format("cores", missing[0]), sorted(os.sched_getaffinity(0))
        raise ValueError(f"{given}: this process may use the cores {', '.join(map(str, there))}")
    if options.rate is not None and not 1.0 <= options.rate <= 240.0:
        raise ValueError(f"{spelling.format('rate', f'{options.rate:g}')}: must lie in [1, 240] Hz")


def load_graph(task: str, scene: str | None = None, options: GraphOptions | None = None) -> Graph:
    """The graph of a task on a scene, each the name of a packaged one or the path of a file.

    Without a scene it is the first that the task names. `SettingError` names file, line and valid choices
    where a file holds something wrong; `FileNotFoundError` lists the tasks or scenes that there are.
    """
    options = options or GraphOptions()
    path = task_path(task)
    loaded = load_scene(scene or default_scene(path))
    loaded = rehearsed(loaded) if options.rehearse else loaded
    chosen: dict[str, Any] = {"controller": options.controller, "changes": options.changes}
    described = load_task(path, loaded.name, goals_of=loaded.goals_of, **chosen)
    return build_graph(described.name, loaded, arm_plans(described, loaded, goals=options.goals), options)


def build_graph(task: str, scene: Scene, plans: Sequence[ArmPlan], options: GraphOptions) -> Graph:
    """The graph in which each arm does what its plan says; raises as `load_graph` does."""
    filter_values = dataclasses.asdict(load_filter_settings(options.filter))
    # an arm whose task looks at the images itself is to feel without a network
    looking = {plan.arm for plan in plans if plan.role.task_type.needs_images}
    nodes = _drivers(scene, options, feels=not looking)
    for plan in plans:
        arm = scene.arms[plan.arm]
        if arm.sensor is not None and plan.arm not in looking:
            nodes += _senses(scene, plan.arm, filter_values, options)
        nodes.append(_controller(plan, arm, plans))
    more = {name: value for name in ("priority", "cores") if (value := getattr(options, name))}
    if more:
        nodes = [dataclasses.replace(node, parameters={**node.parameters, **more}) for node in nodes]
    topics = tuple(_topics(list(scene.arms.values())))
    feeling = [
        plan.arm for plan in plans if scene.arms[plan.arm].sensor is not None and plan.arm not in looking
    ]
    if options.object_belief:
        nodes.append(_object(feeling, options))
        topics += OBJECT_TOPICS
    if options.record is not None:
        nodes.insert(0, _recorder(task, scene, plans, topics, nodes, options))
    arms, remarks = tuple(plan.arm for plan in plans), tuple(_remarks(scene, feeling, options))
    return Graph(task, scene.name, scene.path.absolute(), arms, tuple(nodes), topics, tuple(plans), remarks)


def _topics(arms: Sequence[ArmScene]) -> list[Topic]:
    """What the arms publish; one without a sensor says no more than where it is and what it does."""
    kinds = [(arm, ARM_TOPICS if arm.sensor is None else ARM_TOPICS + SENSOR_TOPICS) for arm in arms]
    for arm in arms:
        if arm.kinematics is not None and arm.driver != EXTERNAL:
            described = (ROBOT_DESCRIPTION,) if arm.kinematics.description is not None else ()
            kinds.append((arm, (JOINT_STATES, *described)))
    return [*(topic.of(arm.name) for arm, topics in kinds for topic in topics), *SHARED_TOPICS]


def _node(name: str, namespace: str, parameters: Mapping[str, Any]) -> NodeProcess:
    return NodeProcess(name, namespace, f"tactile_ros.nodes.{name}_node", name, parameters)


def _drivers(scene: Scene, options: GraphOptions, feels: bool) -> list[NodeProcess]:
    """What moves arms and exposes sensors: the simulated cell, a process for each other arm and camera."""
    nodes = []
    where: dict[str, Any] = {"scene": str(scene.path.absolute())}
    if options.rehearse:
        where["rehearse"] = True
    moved = where if feels else where | {"feels": False}
    if scene.is_simulated:
        parameters = moved | {"seed": options.seed}
        if options.rate is not None:
            parameters["camera_rate"] = float(options.rate)
        nodes.append(_node("sim", "/", parameters))
    for arm in scene.arms.values():
        if arm.driver != SIM:
            nodes.append(_node("arm", f"/{arm.name}", moved))
        if arm.sensor is not None and arm.sensor.camera not in (SIM, EXTERNAL):
            nodes.append(_node("camera", f"/{arm.name}", {"scene": where["scene"]}))
    return nodes


def _senses(
    scene: Scene, arm: str, filter_values: Mapping[str, Any], options: GraphOptions
) -> list[NodeProcess]:
    """From the arm's images to its belief; an ideal simulated sensor gives the contact pose itself."""
    nodes = []
    if scene.gives_images(arm):
        nodes.append(_estimator(scene, arm, options))
        if options.marker_view:
            nodes.append(_node("marker_view", f"/{arm}", _transport(scene.arms[arm])))
    return [*nodes, _node("filter", f"/{arm}", filter_values)]


def _remarks(scene: Scene, arms: Sequence[str], options: GraphOptions) -> Iterator[str]:
    for arm in arms:
        sensor = scene.arms[arm].sensor
        shipped = options.model is None and scene.model_file(arm) is None
        if sensor is not None and sensor.camera != SIM and shipped:
            yield f"{arm}: {SIMULATED_ONLY}"
    yield from check_bodies(scene)


def _estimator(scene: Scene, arm: str, options: GraphOptions) -> NodeProcess:
    sensor, model = scene.arms[arm].sensor, options.model or scene.model_file(arm)
    assert sensor is not None
    rate = options.rate if scene.arms[arm].simulated_sensor else None
    parameters: dict[str, Any] = {"images.rate": float(rate or sensor.settings.camera_rate)}
    parameters |= _transport(scene.arms[arm], "images.")
    if model is not None:
        parameters["model"] = str(model.absolute())
    return _node("estimator", f"/{arm}", parameters)


def _transport(arm: ArmScene, prefix: str = "") -> dict[str, Any]:
    """How nodes take the images of somebody else's camera; nothing for others, which are raw."""
    sensor = arm.sensor
    if sensor is None or sensor.camera != EXTERNAL:
        return {}
    values: dict[str, Any] = {}
    if sensor.camera_settings.values:
        given = sensor.camera_settings.checked(ExternalCameraSettings, sensor.camera_settings.values)
        values = dataclasses.asdict(given)
    if sensor.settings.time_offset:
        values["time_offset"] = sensor.settings.time_offset
    return {f"{prefix}{name}": value for name, value in values.items()}


def _controller(plan: ArmPlan, arm: ArmScene, plans: Sequence[ArmPlan]) -> NodeProcess:
    parameters: dict[str, Any] = {"task_name": plan.role.task, "controlled_frame": arm.controlled_frame}
    for corner in ("workspace_lower", "workspace_upper"):
        parameters[f"space.{corner}"] = list(getattr(arm.safety, corner))
    parameters |= plan.role.settings.dotted()
    if plan.role.task_type.needs_images:
        parameters |= _transport(arm, "images.") | {"timing.watchdog_period": LOOKING_PERIOD}
    partners = {"awaited": awaited_by(plan, plans), "waiting": waiting_for(plan, plans)}
    parameters |= {name: arms for name, arms in partners.items() if arms}
    return _node("controller", f"/{plan.arm}", parameters)


def _object(arms: Sequence[str], options: GraphOptions) -> NodeProcess:
    """The belief over one object, with the parameters of its file if there is one."""
    parameters: dict[str, Any] = {"arms": list(arms)}
    if options.object_file:
        settings, places = load_object(named_file("object", options.object_file), list(arms))
        parameters |= dataclasses.asdict(settings)
        for arm, place in places.items():
            parameters |= {f"place.{arm}.{name}": value for name, value in dataclasses.asdict(place).items()}
    return _node("object", "/", parameters)


def _recorder(
    task: str,
    scene: Scene,
    plans: Sequence[ArmPlan],
    topics: Sequence[Topic],
    nodes: Sequence[NodeProcess],
    options: GraphOptions,
) -> NodeProcess:
    assert options.record is not None
    seeing = [scene.arms[arm] for arm in scene.arms if scene.gives_images(arm) and options.record_images]
    packed = [arm.name for arm in seeing if _transport(arm).get("transport") == COMPRESSED]
    images = [IMAGE.of(arm.name).name for arm in seeing if arm.name not in packed]
    topics = [*topics, *(compressed(IMAGE).of(arm) for arm in packed)]
    note = {
        "task": task,
        "scene": scene.name + " (rehearsed)" * options.rehearse,
        "scene_file": str(scene.path.absolute()),
        "seed": str(options.seed),
        "roles": json.dumps({plan.arm: role_note(plan, scene) for plan in plans}),
        "parameters": json.dumps({node.full_name: node.parameters for node in nodes}),
        "origin": json.dumps(origin()),
    }
    parameters = {
        "bag": str(options.record.absolute()),
        "topics": [f"{topic.name} {topic.type} {topic.qos}" for topic in topics],
        "images": images,
        "note": [f"{name}={text}" for name, text in note.items()],
    }
    return _node(RECORDER, "/", parameters)


def role_note(plan: ArmPlan, scene: Scene) -> dict[str, Any]:
    """What is kept with a recording of what an arm was to do."""
    arm = scene.arms[plan.arm]
    return {
        "role": plan.role.name,
        "task": plan.role.task,
        "goals": [goal.name for goal in plan.goals],
        "targets": _known(plan.targets),
        "directions": _known(plan.directions),
        "T_world_base": arm.T_world_base.tolist(),
        "T_controlled_sensor": scene.T_controlled_sensor(plan.arm).tolist(),
        "tip_radius": arm.sensor.settings.tip_radius if arm.sensor is not None else 0.0,
    }


def _known(rows: NDArray[np.float64]) -> list[list[float] | None]:
    """Each row (3,), or None where it holds nothing."""
    return [row.tolist() if np.isfinite(row).all() else None for row in rows]


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
