"""Which process of a graph may say and hear what, for DDS security: policies of SROS 2 and what DDS checks.

An enclave is what keys are made for: one process. Layout and names: policy.xsd of sros2 (version 0.2.0),
"DDS Security" 1.1 of the OMG for governance and permissions, and "Topic and Service name mapping to DDS"
(design.ros2.org) for how topics (rt), requests (rq) and replies (rr) are called there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree as Xml

from tactile_base import topics
from tactile_base.node_topics import (
    ARM,
    CLIENT,
    EVERY_NODE,
    FOXGLOVE,
    GET_STATE,
    LAST_ZEROS,
    NODE_SERVICES,
    NODES,
    TRANSITION_EVENT,
    VIEW,
    Part,
)
from tactile_base.topics import Topic
from tactile_bringup.graph import RECORDER, Graph, NodeProcess
from tactile_scene.external_settings import ExternalArmSettings
from tactile_scene.scene import EXTERNAL, SIM, ArmScene, Scene

OPERATOR = "/operator"  # who stops arms by hand, and looks at all that is said
_ACTION = ("send_goal", "cancel_goal", "get_result")
_SPECS = "http://www.omg.org/spec/DDS-SECURITY/20170901"
_SCHEMA = "{http://www.w3.org/2001/XMLSchema-instance}noNamespaceSchemaLocation"


@dataclass
class Profile:
    """What one node may do, by full names of topics, services and actions."""

    namespace: str
    node: str
    publish: set[str] = field(default_factory=set)
    subscribe: set[str] = field(default_factory=set)
    reply: set[str] = field(default_factory=set)
    request: set[str] = field(default_factory=set)
    execute: set[str] = field(default_factory=set)
    call: set[str] = field(default_factory=set)

    def published(self) -> set[str]:
        """The DDS topics that it writes."""
        feedback = {f"rt{name}/_action/{what}" for name in self.execute for what in ("feedback", "status")}
        asked = self.request | _services(self.call)
        told = {f"rq{name}Request" for name in asked}
        told |= {f"rr{name}Reply" for name in self.reply | _services(self.execute)}
        return {f"rt{name}" for name in self.publish} | feedback | told

    def heard(self) -> set[str]:
        """The DDS topics that it reads."""
        feedback = {f"rt{name}/_action/{what}" for name in self.call for what in ("feedback", "status")}
        asked = self.request | _services(self.call)
        told = {f"rr{name}Reply" for name in asked}
        told |= {f"rq{name}Request" for name in self.reply | _services(self.execute)}
        return {f"rt{name}" for name in self.subscribe} | feedback | told


def enclaves(graph: Graph, scene: Scene) -> dict[str, list[Profile]]:
    """The nodes of each enclave of a graph, by the enclave's path, those of people among them."""
    found = {process.full_name: _process(process, graph, scene) for process in graph.nodes}
    nodes = [profile for profiles in found.values() for profile in profiles]
    client = Profile("/", CLIENT.strip("/"))
    operator = Profile("/", OPERATOR.strip("/"))
    for arm in graph.arms:
        client.subscribe |= {topic.of(arm).name for topic in (topics.ARM_STATUS, topics.LATENCY)}
        for person in (client, operator):
            person.call.add(f"/{arm}/{topics.RUN_TASK}")
    client.request = {f"{_full(node)}/{GET_STATE}" for node in nodes}
    client.publish = operator.publish = {topics.ESTOP.name, topics.PARAMETER_EVENTS.name, topics.ROSOUT.name}
    operator.subscribe = set().union(*(node.publish for node in nodes))
    operator.request = set().union(*(node.reply for node in nodes))
    lookers = [Profile("/", name.strip("/"), {topics.PARAMETER_EVENTS.name}) for name in (VIEW, FOXGLOVE)]
    told = {topic.of(arm).name for arm in graph.arms for topic in (topics.TASK_STATUS, topics.TASK_FEEDBACK)}
    for looker in lookers:
        looker.subscribe = operator.subscribe | operator.publish | told
    others = [client, operator, *lookers]
    for plain in others:
        plain.reply = {f"{_full(plain)}/{name}" for name in NODE_SERVICES}
    return {**found, **{_full(plain): [plain] for plain in others}}


def write_permissions(
    folder: Path, found: dict[str, list[Profile]], domain: int, valid: tuple[datetime, datetime]
) -> None:
    """Write policies.xml, governance.xml, and permissions.xml of each enclave, into an existing folder."""
    _write(folder / "policies.xml", policies(found))
    _write(folder / "governance.xml", governance(domain))
    for path, profiles in found.items():
        file = folder / "enclaves" / path.strip("/") / "permissions.xml"
        file.parent.mkdir(parents=True, exist_ok=True)
        _write(file, permissions(path, profiles, domain, valid))


def policies(found: dict[str, list[Profile]]) -> Xml.Element:
    """What `ros2 security generate_artifacts -p` reads."""
    root = Xml.Element("policy", version="0.2.0")
    outer = Xml.SubElement(root, "enclaves")
    for path, profiles in found.items():
        inner = Xml.SubElement(Xml.SubElement(outer, "enclave", path=path), "profiles")
        for profile in profiles:
            element = Xml.SubElement(inner, "profile", ns=profile.namespace, node=profile.node)
            for kind, right, names in (
                ("topic", "publish", profile.publish),
                ("topic", "subscribe", profile.subscribe),
                ("service", "reply", profile.reply),
                ("service", "request", profile.request),
                ("action", "execute", profile.execute),
                ("action", "call", profile.call),
            ):
                if names:
                    _listed(Xml.SubElement(element, f"{kind}s", {right: "ALLOW"}), kind, names)
    return root


def permissions(
    path: str, profiles: Sequence[Profile], domain: int, valid: tuple[datetime, datetime]
) -> Xml.Element:
    """What an enclave's process may write and read in a domain, and nothing else; to be signed."""
    root = Xml.Element("dds", {_SCHEMA: f"{_SPECS}/omg_shared_ca_permissions.xsd"})
    grant = Xml.SubElement(Xml.SubElement(root, "permissions"), "grant", name=path)
    Xml.SubElement(grant, "subject_name").text = f"CN={path}"
    validity = Xml.SubElement(grant, "validity")
    for name, moment in zip(("not_before", "not_after"), valid, strict=True):
        Xml.SubElement(validity, name).text = moment.strftime("%Y-%m-%dT%H:%M:%S")
    rule = Xml.SubElement(grant, "allow_rule")
    _domain(rule, domain)
    graph_info = {"ros_discovery_info"}  # by which ROS 2 tells which node has which topics
    written = graph_info.union(*(profile.published() for profile in profiles))
    read = graph_info.union(*(profile.heard() for profile in profiles))
    for right, names in (("publish", written), ("subscribe", read)):
        _listed(Xml.SubElement(Xml.SubElement(rule, right), "topics"), "topic", names)
    Xml.SubElement(grant, "default").text = "DENY"
    return root


def governance(domain: int) -> Xml.Element:
    """Nobody without keys takes part, all is encrypted, and permissions are checked for every topic."""
    root = Xml.Element("dds", {_SCHEMA: f"{_SPECS}/omg_shared_ca_governance.xsd"})
    rule = Xml.SubElement(Xml.SubElement(root, "domain_access_rules"), "domain_rule")
    _domain(rule, domain)
    for name, value in (
        ("allow_unauthenticated_participants", "false"),
        ("enable_join_access_control", "true"),
        ("discovery_protection_kind", "ENCRYPT"),
        ("liveliness_protection_kind", "ENCRYPT"),
        ("rtps_protection_kind", "SIGN"),
    ):
        Xml.SubElement(rule, name).text = value
    topic = Xml.SubElement(Xml.SubElement(rule, "topic_access_rules"), "topic_rule")
    for name, value in (
        ("topic_expression", "*"),
        ("enable_discovery_protection", "true"),
        ("enable_liveliness_protection", "true"),
        ("enable_read_access_control", "true"),
        ("enable_write_access_control", "true"),
        ("metadata_protection_kind", "ENCRYPT"),
        ("data_protection_kind", "ENCRYPT"),
    ):
        Xml.SubElement(topic, name).text = value
    return root


def _process(process: NodeProcess, graph: Graph, scene: Scene) -> list[Profile]:
    """The nodes of a process; the simulated cell has an arm and a camera for each simulated one, too."""
    found = [_profile(process.namespace, process.name, scene)]
    arm = scene.arms.get(process.namespace.strip("/"))
    if process.name == ARM and arm is not None and arm.driver == EXTERNAL:
        found += _external(found[0], arm)
    if process.name == RECORDER:
        images = (topics.IMAGE, topics.compressed(topics.IMAGE))
        found[0].subscribe |= {topic.name for topic in graph.topics} | _names(images, scene.arms)
    if process.name == SIM:
        for arm in scene.arms.values():
            if arm.driver == SIM:
                found.append(_profile(f"/{arm.name}", "arm", scene))
            if arm.simulated_sensor:
                found.append(_profile(f"/{arm.name}", "camera", scene))
    return found


def _external(profile: Profile, arm: ArmScene) -> list[Profile]:
    """Let the node of an external arm say and hear what the scene names; who stops it should the node die."""
    settings = arm.driver_settings.checked(ExternalArmSettings, arm.driver_settings.values)
    if settings.servo_status:
        profile.subscribe.add(_absolute(settings.servo_status, profile.namespace))
    if not settings.joint_velocities:
        return []
    commands = _absolute(settings.joint_velocities, profile.namespace)
    profile.publish.add(commands)
    profile.subscribe.add(_absolute(settings.joint_states, profile.namespace))
    last = Profile(profile.namespace, LAST_ZEROS, publish={commands, topics.PARAMETER_EVENTS.name})
    last.reply = {f"{_full(last)}/{service}" for service in NODE_SERVICES}
    return [last]


def _absolute(topic: str, namespace: str) -> str:
    return topic if topic.startswith("/") else f"{namespace}/{topic}"


def _profile(namespace: str, name: str, scene: Scene) -> Profile:
    profile = Profile(namespace, name)
    for part in (EVERY_NODE, NODES[name]):
        _add(profile, part, list(scene.arms))
    profile.publish.add(f"{_full(profile)}/{TRANSITION_EVENT}")
    profile.reply |= {f"{_full(profile)}/{service}" for service in NODE_SERVICES}
    return profile


def _add(profile: Profile, part: Part, arms: Sequence[str]) -> None:
    profile.publish |= _names(part.publishes, [profile.namespace]) | _names(part.publishes_all, arms)
    profile.subscribe |= _names(part.hears, [profile.namespace]) | _names(part.hears_all, arms)
    profile.reply |= {
        name.replace("~", _full(profile)) if name[0] == "~" else f"{profile.namespace}/{name}"
        for name in part.serves
    }
    profile.execute |= {f"{profile.namespace}/{name}" for name in part.does}


def _names(listed: Iterable[Topic], arms: Iterable[str]) -> set[str]:
    """Full names; of a topic of each arm, one for each."""
    listed, names = list(listed), [arm.strip("/") for arm in arms]
    shared = {topic.name for topic in listed if topic.name.startswith("/")}
    return shared | {t.of(arm).name for t in listed for arm in names if t.name not in shared}


def _services(actions: Iterable[str]) -> set[str]:
    return {f"{name}/_action/{service}" for name in actions for service in _ACTION}


def _full(profile: Profile) -> str:
    return f"{profile.namespace.rstrip('/')}/{profile.node}"


def _domain(rule: Xml.Element, domain: int) -> None:
    Xml.SubElement(Xml.SubElement(rule, "domains"), "id").text = str(domain)


def _listed(parent: Xml.Element, kind: str, names: Iterable[str]) -> None:
    for name in sorted(names):
        Xml.SubElement(parent, kind).text = name


def _write(path: Path, root: Xml.Element) -> None:
    Xml.indent(root)
    Xml.ElementTree(root).write(path, encoding="UTF-8", xml_declaration=True)
