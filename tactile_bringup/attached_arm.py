"""The nodes of one arm beside somebody else's arm and camera: the graph of a task without a cell of its own.

`launch/servoing.launch.py` starts it within other people's launch files, `tactile run --namespace` runs a
task on it. Names in the ROS graph, which are fixed where a whole cell is launched, are the user's here.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

from tactile_base.settings import unknown_name
from tactile_base.topics import EXTERNAL_COMMAND, IMAGE, Topic, compressed
from tactile_bringup.graph import Graph, GraphOptions, NodeProcess, load_graph
from tactile_bringup.run_sequence import ArmPlan

ARM_NODE = "arm"
_NAMESPACE = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*")
_TOPIC = re.compile(r"[/~]?[A-Za-z_]\w*(/[A-Za-z_]\w*)*")


@dataclass(frozen=True)
class Place:
    """Where the nodes of an arm stand in the ROS graph; what is empty is as everywhere else.

    Attributes
    ----------
    namespace : of the nodes; an absolute one, or one below `within`; empty: the arm's name
    within : namespace around it, as others have pushed it
    base_frame, tool_frame, sensor_frame, contact_frame : empty: `<namespace>/base` and so on
    image_topic : images of the sensor; a relative name is one below the namespace
    twist_topic : twists for an external arm
    arm_node : whether the node with the safe command stage is started here
    use_sim_time : whether time is that of /clock
    params_file : ROS parameters on top of all others
    """

    namespace: str = ""
    within: str = ""
    base_frame: str = ""
    tool_frame: str = ""
    sensor_frame: str = ""
    contact_frame: str = ""
    image_topic: str = ""
    twist_topic: str = ""
    arm_node: bool = True
    use_sim_time: bool = False
    params_file: Path | None = None

    def __post_init__(self) -> None:
        for name, form in (("namespace", _NAMESPACE), ("image_topic", _TOPIC), ("twist_topic", _TOPIC)):
            value = getattr(self, name)
            if value and not form.fullmatch(value):
                raise ValueError(f"{name} '{value}': must be letters, digits and _, parts divided by /")
        for name in ("base_frame", "tool_frame", "sensor_frame", "contact_frame"):
            value = getattr(self, name)
            if value.startswith("/") or " " in value:
                raise ValueError(
                    f"{name} '{value}': must be as on /tf, without / in front and without blanks"
                )
        if self.params_file is not None and not self.params_file.is_file():
            raise ValueError(f"params_file '{self.params_file}': no such file")

    def namespace_of(self, arm: str) -> str:
        """The absolute namespace of an arm's nodes."""
        name = self.namespace or arm
        return name if name.startswith("/") else f"/{self.within.strip('/')}/{name}".replace("//", "/")

    def frames(self, arm: str) -> dict[str, str]:
        """The parameters that name the arm's frames."""
        prefix = self.namespace_of(arm).strip("/")
        return {
            "frames.base": self.base_frame or f"{prefix}/base",
            "frames.tool": self.tool_frame or f"{prefix}/tool",
            "frames.sensor": self.sensor_frame or f"{prefix}/tactile_sensor",
            "frames.contact": self.contact_frame or f"{prefix}/contact",
        }

    def put(self, node: NodeProcess, arm: str) -> NodeProcess:
        """A copy of a node with this arm's namespace, topics and frames."""
        given: dict[str, object] = {"use_sim_time": True} if self.use_sim_time else {}
        renamed = [(compressed(IMAGE), f"{self.image_topic}/compressed")] if self.image_topic else []
        renamed += [(IMAGE, self.image_topic), (EXTERNAL_COMMAND, self.twist_topic)]
        return dataclasses.replace(
            node,
            namespace=self.namespace_of(arm),
            parameters={"arm": arm, **self.frames(arm), **node.parameters, **given},
            remappings=tuple((topic.name, name) for topic, name in renamed if name),
            params_file=self.params_file,
        )


def load_servoing_graph(
    task: str, scene: str | None, arm: str, place: Place, options: GraphOptions | None = None
) -> Graph:
    """The graph of one arm's part in a task; what is simulated, and other arms, are left out.

    `arm` is its name in the scene, and may be empty where only one has a role. In the graph's plan and topics
    it is called by its namespace. Raises as `load_graph` does, and `ValueError` where it is not known which
    arm is meant.
    """
    whole = load_graph(task, scene, options)
    if arm and arm not in whole.arms:
        raise ValueError(f"arm: {unknown_name(arm, whole.arms)}")
    if not arm and len(whole.arms) > 1:
        raise ValueError(f"arm: must be one of {', '.join(whole.arms)}, which have roles in {whole.task}")
    name = arm or whole.arms[0]
    namespace = place.namespace_of(name)
    nodes = [place.put(node, name) for node in whole.nodes if node.namespace == f"/{name}"]
    plan = next(plan for plan in whole.plans if plan.arm == name)
    return dataclasses.replace(
        whole,
        arms=(namespace.strip("/"),),
        nodes=tuple(node for node in nodes if place.arm_node or node.name != ARM_NODE),
        topics=tuple(_moved(topic, name, namespace) for topic in whole.topics),
        plans=(ArmPlan(namespace.strip("/"), plan.role, plan.goals),),
    )


def _moved(topic: Topic, arm: str, namespace: str) -> Topic:
    own = topic.name.startswith(f"/{arm}/")
    return dataclasses.replace(topic, name=namespace + topic.name[len(arm) + 1 :]) if own else topic
