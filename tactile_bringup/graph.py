"""The graph of a task: which processes run, with which names, parameters and topics.

One description, built from scene, task and options, from which `tactile launch` starts processes and
`launch/*.launch.py` builds its launch description. Only what the scene names is in it: one estimator, filter
and controller for each of its arms; the simulator that is the cell; and where they are asked for, a recorder
and a belief over one object that all arms touch.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from tactile_records.bags.writer import Topic

RECORDER = "recorder"

# Topics of each arm, below its namespace.
_ARM_TOPICS = (
    Topic("arm/pose", "geometry_msgs/msg/PoseStamped"),
    Topic("arm/status", "tactile_msgs/msg/ArmStatus"),
    Topic("command/twist", "geometry_msgs/msg/TwistStamped"),
    Topic("command/twist_limited", "geometry_msgs/msg/TwistStamped"),
)
_SENSOR_TOPICS = (
    Topic("contact/presence", "tactile_msgs/msg/ContactPresence"),
    Topic("contact/estimate", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    Topic("contact/belief", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    Topic("contact/state", "tactile_msgs/msg/ContactState"),
    Topic("controller/status", "tactile_msgs/msg/ControllerStatus"),
    Topic("sim/truth", "tactile_msgs/msg/ContactTruth"),
    Topic("latency", "tactile_msgs/msg/StageLatency", "sensor"),
)
_SHARED_TOPICS = (
    Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
    Topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent"),
    Topic("/tf", "tf2_msgs/msg/TFMessage"),
    Topic("/tf_static", "tf2_msgs/msg/TFMessage", "latched"),
    Topic("/sim/markers", "visualization_msgs/msg/MarkerArray", "latched"),
)
_OBJECT_TOPICS = (
    Topic("/object/belief", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    Topic("/object/latency", "tactile_msgs/msg/StageLatency", "sensor"),
)
IMAGE = Topic("tactile/image", "sensor_msgs/msg/Image", "sensor")


@dataclass(frozen=True)
class NodeProcess:
    """One node in a process of its own.

    Attributes
    ----------
    name, namespace : str
        Of the node; the namespace is "/" or "/<arm>".
    module : str
        Python module whose `main` runs the node.
    executable : str
        Its name for `ros2 run tactile_servoing`.
    parameters : mapping
        Parameter name -> value.
    """

    name: str
    namespace: str
    module: str
    executable: str
    parameters: Mapping[str, Any] = field(default_factory=dict)

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
        values = {name: _plain(value) for name, value in self.parameters.items() if not _is_empty(value)}
        values["autostart"] = True
        return yaml.safe_dump({self.full_name: {"ros__parameters": values}}, sort_keys=False)

    def command(self, parameter_file: Path, python: str = sys.executable) -> list[str]:
        """The command line that runs the node."""
        names = ["-r", f"__node:={self.name}", "-r", f"__ns:={self.namespace}"]
        return [python, "-m", self.module, "--ros-args", *names, "--params-file", str(parameter_file)]


@dataclass(frozen=True)
class GraphOptions:
    """What a user chooses when a task is started.

    Attributes
    ----------
    rate : float or None
        Exposures a second; None for the scene's own.
    seed : int
        Of the simulated cell.
    model : Path or None
        Of the estimator; None for the one that the package ships.
    record : Path or None
        The bag to write.
    record_images : bool
        Whether images go into the bag, compressed without loss.
    marker_view : bool
        Whether each sensor with images gets a node that publishes a picture of its markers.
    object_belief : bool
        Whether the contacts of all arms are fused into one belief over the object that they touch.
    object_file : str
        Where they touch it: the name of one of config/objects or a path (`tactile_filter.object.settings`);
        empty: that is found by touch.
    """

    rate: float | None = None
    seed: int = 0
    model: Path | None = None
    record: Path | None = None
    record_images: bool = False
    marker_view: bool = False
    object_belief: bool = False
    object_file: str = ""


@dataclass(frozen=True)
class ArmOutline:
    """What the graph has to know of an arm.

    Attributes
    ----------
    camera_rate : float or None
        Of its tactile sensor, Hz; None for an arm without one.
    images : bool
        Whether the sensor gives images; an ideal simulated one gives the contact pose itself.
    """

    name: str
    camera_rate: float | None = 60.0
    images: bool = True


@dataclass(frozen=True)
class SceneOutline:
    """What the graph has to know of a scene."""

    name: str
    file: Path
    arms: tuple[ArmOutline, ...]


@dataclass(frozen=True)
class Graph:
    """All processes of a task, in the order in which they start, and the topics between them.

    `arms` are those that can run the task: the ones with a sensor.
    """

    task: str
    scene: str
    arms: tuple[str, ...]
    nodes: tuple[NodeProcess, ...]
    topics: tuple[Topic, ...]

    def node(self, full_name: str) -> NodeProcess:
        """The node of that full name; raises KeyError with the names there are."""
        for node in self.nodes:
            if node.full_name == full_name:
                return node
        raise KeyError(f"{full_name}; nodes: {', '.join(n.full_name for n in self.nodes)}")


def build_graph(
    task: str,
    scene: SceneOutline,
    controller: Mapping[str, Mapping[str, Any]],
    paths: Sequence[str] = (),
    options: GraphOptions | None = None,
    filter_values: Mapping[str, Any] | None = None,
    object_values: Mapping[str, Any] | None = None,
) -> Graph:
    """The graph of a task on a scene.

    Parameters
    ----------
    controller : mapping
        Group -> parameter -> value, for the controller of every arm.
    paths : sequence of str
        Names of the paths that will be run; kept with the recording.
    filter_values : mapping, optional
        Parameter -> value, for the filter of every arm.
    object_values : mapping, optional
        Parameter -> value, for the belief over the object, if the options ask for it.
    """
    options = options or GraphOptions()
    feeling = tuple(arm for arm in scene.arms if arm.camera_rate is not None)
    nodes = [_simulator(scene, options)]
    for arm in feeling:
        if arm.images:
            nodes.append(_estimator(arm, options))
            if options.marker_view:
                nodes.append(_marker_view(arm))
        nodes += [_filter(arm, filter_values or {}), _controller(arm, controller)]
    topics = tuple(_topics(scene.arms))
    if options.object_belief:
        nodes.append(_object(feeling, object_values or {}))
        topics += _OBJECT_TOPICS
    if options.record is not None:
        nodes.insert(0, _recorder(task, scene, paths, topics, nodes, options))
    return Graph(task, scene.name, tuple(arm.name for arm in feeling), tuple(nodes), topics)


def build_collection_graph(
    task: str,
    scene: SceneOutline,
    arm: str,
    collector: Mapping[str, Any],
    options: GraphOptions | None = None,
    simulate: bool = True,
) -> Graph:
    """The graph that collects a data set with one arm of a scene.

    Parameters
    ----------
    collector : mapping
        Parameter -> value, for the collector.
    simulate : bool
        Whether the simulated cell is part of it; without, driver and camera run already.
    """
    options = options or GraphOptions()
    nodes = [_simulator(scene, options)] if simulate else []
    module, name = "tactile_ros.nodes.collector_node", "collector"
    nodes.append(NodeProcess(name, f"/{arm}", module, name, collector))
    topics = tuple(_topics([outline for outline in scene.arms if outline.name == arm]))
    if options.record is not None:
        nodes.insert(0, _recorder(task, scene, (), topics, nodes, options))
    return Graph(task, scene.name, (arm,), tuple(nodes), topics)


def _topics(arms: Sequence[ArmOutline]) -> list[Topic]:
    """What the arms of the scene publish; one without a sensor publishes no more than where it is."""
    below = []
    for arm in arms:
        kinds = _ARM_TOPICS if arm.camera_rate is None else _ARM_TOPICS + _SENSOR_TOPICS
        below += [dataclasses.replace(topic, name=f"/{arm.name}/{topic.name}") for topic in kinds]
    return [*below, *_SHARED_TOPICS]


def _simulator(scene: SceneOutline, options: GraphOptions) -> NodeProcess:
    parameters: dict[str, Any] = {"scene": str(scene.file), "seed": options.seed}
    if options.rate is not None:
        parameters["camera_rate"] = float(options.rate)
    return NodeProcess("sim", "/", "tactile_ros.nodes.sim_node", "sim", parameters)


def _estimator(arm: ArmOutline, options: GraphOptions) -> NodeProcess:
    parameters: dict[str, Any] = {"images.rate": float(options.rate or arm.camera_rate or 0.0)}
    if options.model is not None:
        parameters["model"] = str(options.model)
    return NodeProcess(
        "estimator", f"/{arm.name}", "tactile_ros.nodes.estimator_node", "estimator", parameters
    )


def _marker_view(arm: ArmOutline) -> NodeProcess:
    return NodeProcess("marker_view", f"/{arm.name}", "tactile_ros.nodes.marker_view_node", "marker_view", {})


def _filter(arm: ArmOutline, values: Mapping[str, Any]) -> NodeProcess:
    return NodeProcess("filter", f"/{arm.name}", "tactile_ros.nodes.filter_node", "filter", values)


def _controller(arm: ArmOutline, groups: Mapping[str, Mapping[str, Any]]) -> NodeProcess:
    parameters = {
        f"{group}.{name}": value for group, values in groups.items() for name, value in values.items()
    }
    return NodeProcess(
        "controller", f"/{arm.name}", "tactile_ros.nodes.controller_node", "controller", parameters
    )


def _object(arms: Sequence[ArmOutline], values: Mapping[str, Any]) -> NodeProcess:
    parameters = {"arms": [arm.name for arm in arms], **values}
    return NodeProcess("object", "/", "tactile_ros.nodes.object_node", "object", parameters)


def _recorder(
    task: str,
    scene: SceneOutline,
    paths: Sequence[str],
    topics: Sequence[Topic],
    nodes: Sequence[NodeProcess],
    options: GraphOptions,
) -> NodeProcess:
    images = [f"/{arm.name}/{IMAGE.name}" for arm in scene.arms if arm.images and arm.camera_rate is not None]
    note = {
        "task": task,
        "scene": scene.name,
        "scene_file": str(scene.file),
        "seed": str(options.seed),
        "paths": json.dumps(list(paths)),
        "parameters": json.dumps({node.full_name: node.parameters for node in nodes}),
    }
    parameters = {
        "bag": str(options.record),
        "topics": [f"{topic.name} {topic.type} {topic.qos}" for topic in topics],
        "images": images if options.record_images else [],
        "note": [f"{name}={text}" for name, text in note.items()],
    }
    return NodeProcess(RECORDER, "/", "tactile_ros.nodes.recorder_node", "recorder", parameters)


def _is_empty(value: Any) -> bool:
    """An empty list has no type in a ROS parameter file; left out, the node's own empty default stands."""
    return isinstance(value, list | tuple) and not value


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
