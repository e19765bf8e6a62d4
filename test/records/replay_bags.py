"""Small synthetic recordings: a sensor that moves over a surface that stands still."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_base.topics import Topic
from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian, left_from_ros, ros_from_left
from tactile_records.bags.contents import Gap
from tactile_records.bags.writer import BagWriter
from tactile_wire.message_definitions import message_definition

START_NS = 1_700_000_000_000_000_000
STEP_NS = 16_666_667
ESTIMATE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PRESENCE = "tactile_msgs/msg/ContactPresence"
STATE = "tactile_msgs/msg/ContactState"
TRUTH = "tactile_msgs/msg/ContactTruth"
PARAMETERS = "rcl_interfaces/msg/ParameterEvent"
FORCE = "tactile_msgs/msg/ContactForce"
TYPES = (ESTIMATE, TRANSFORMS, PRESENCE, STATE, TRUTH, FORCE)

STORE = get_typestore(Stores.LATEST)
for name in TYPES:
    parts = get_types_from_msg(message_definition(name), name)
    STORE.register({key: value for key, value in parts.items() if key not in STORE.types})


def make(type_name: str, *values):
    return STORE.types[type_name](*values)


def stamp(stamp_ns: int):
    return make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)


def header(stamp_ns: int, frame: str):
    return make("std_msgs/msg/Header", stamp(stamp_ns), frame)


def _parts(T):
    point, quaternion = T[:3, 3].tolist(), se3.quaternion_from_rotation(T[:3, :3]).tolist()
    return point, make("geometry_msgs/msg/Quaternion", *quaternion)


def pose(T):
    point, quaternion = _parts(T)
    return make("geometry_msgs/msg/Pose", make("geometry_msgs/msg/Point", *point), quaternion)


def transform(stamp_ns: int, parent: str, child: str, T):
    point, quaternion = _parts(T)
    moved = make("geometry_msgs/msg/Transform", make("geometry_msgs/msg/Vector3", *point), quaternion)
    return make("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, moved)


def serialized(message, type_name: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, type_name))


@dataclasses.dataclass
class Recording:
    """Messages as a recorder has them, in the order in which they came."""

    messages: list[tuple[str, str, bytes, int]] = dataclasses.field(default_factory=list)
    note: dict[str, str] = dataclasses.field(default_factory=dict)
    gaps: list[Gap] = dataclasses.field(default_factory=list)
    late_ns: int = 5_000_000  # from a message's stamp to its reception

    def add(self, topic: str, type_name: str, message, stamp_ns: int) -> None:
        self.messages.append((topic, type_name, serialized(message, type_name), stamp_ns + self.late_ns))

    def transforms(self, topic: str, stamp_ns: int, *transforms) -> None:
        self.add(topic, TRANSFORMS, make(TRANSFORMS, list(transforms)), stamp_ns)

    def static(self, arm: str = "arm") -> None:
        mounted = transform(0, f"{arm}/tool", f"{arm}/tactile_sensor", T_TOOL_SENSOR)
        self.transforms("/tf_static", START_NS - 10**9, mounted)

    def move(self, stamp_ns: int, T_base_sensor, arm: str = "arm") -> None:
        T = T_base_sensor @ se3.inverse(T_TOOL_SENSOR)
        self.transforms("/tf", stamp_ns, transform(stamp_ns, f"{arm}/base", f"{arm}/tool", T))

    def estimate(self, stamp_ns: int, gaussian: PoseGaussian, arm: str = "arm", frame: str = "") -> None:
        cov = ros_from_left(gaussian.cov, gaussian.mean[:3, 3]).reshape(36)
        content = make("geometry_msgs/msg/PoseWithCovariance", pose(gaussian.mean), cov)
        head = header(stamp_ns, frame or f"{arm}/tactile_sensor")
        self.add(f"/{arm}/contact/estimate", ESTIMATE, make(ESTIMATE, head, content), stamp_ns)

    def presence(self, stamp_ns: int, in_contact: bool, arm: str = "arm") -> None:
        head = header(stamp_ns, f"{arm}/tactile_sensor")
        message = make(PRESENCE, head, float(in_contact), 0.5, in_contact, False, np.nan)
        self.add(f"/{arm}/contact/presence", PRESENCE, message, stamp_ns)

    def force(self, stamp_ns: int, mean, cov, arm: str = "arm") -> None:
        head = header(stamp_ns, f"{arm}/tactile_sensor")
        message = make(FORCE, head, np.array(mean, float), np.array(cov, float).ravel(), np.nan)
        self.add(f"/{arm}/contact/wrench_estimate", FORCE, message, stamp_ns)

    def truth(self, stamp_ns: int, T_fs, arm: str = "arm") -> None:
        vector, nothing = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 1.0), np.zeros(3)
        point = make("geometry_msgs/msg/Point", 0.0, 0.0, 0.0)
        euler = se3.euler_from_pose(T_fs)
        message = make(
            TRUTH, header(stamp_ns, f"{arm}/base"), True, float(T_fs[2, 3]), 0.0, euler, nothing, 0.0, 1.0,
            pose(np.eye(4)), point, vector,
        )  # fmt: skip
        self.add(f"/{arm}/sim/truth", TRUTH, message, stamp_ns)

    def state(self, belief, arm: str = "arm") -> None:
        """What the live filter publishes."""
        valid = belief.valid
        xi = se3.log(belief.mean) if valid else np.full(6, np.nan)
        euler = se3.euler_from_pose(se3.inverse(belief.mean)) if valid else np.full(6, np.nan)
        message = make(
            STATE, header(belief.stamp_ns, f"{arm}/tactile_sensor"), xi, belief.cov.reshape(36), euler,
            belief.nis, belief.nis_dof, int(belief.flags), belief.rejected, belief.inflation, np.nan,
            make("builtin_interfaces/msg/Duration", 0, 8_000_000),
        )  # fmt: skip
        self.add(f"/{arm}/contact/state", STATE, message, belief.stamp_ns)

    def parameter(self, stamp_ns: int, name: str, value, arm: str = "arm", declared: bool = False) -> None:
        """The event that a parameter of the filter was changed, or declared."""
        kind = {bool: 1, int: 2, float: 3, str: 4}[type(value)]
        fields = {1: False, 2: 0, 3: 0.0, 4: ""} | {kind: value}
        empty = [np.zeros(0, np.uint8), np.zeros(0, bool), np.zeros(0, np.int64), np.zeros(0), []]
        content = make("rcl_interfaces/msg/ParameterValue", kind, *fields.values(), *empty)
        parameter = make("rcl_interfaces/msg/Parameter", name, content)
        lists = ([parameter], [], []) if declared else ([], [parameter], [])
        event = make(PARAMETERS, stamp(stamp_ns), f"/{arm}/filter", *lists)
        self.add("/parameter_events", PARAMETERS, event, stamp_ns)

    def without(self, topic: str) -> Recording:
        return dataclasses.replace(self, messages=[m for m in self.messages if m[0] != topic])

    def write(self, folder: Path, flush_every: int = 0) -> Path:
        """As our recorder does, with a flush after so many messages."""
        topics = [Topic(topic, type_name) for topic, type_name in dict(m[:2] for m in self.messages).items()]
        with BagWriter(folder, topics, note=self.note) as bag:
            for number, (topic, _, data, received_ns) in enumerate(self.messages, 1):
                bag.write(topic, data, received_ns)
                if flush_every and number % flush_every == 0:
                    bag.flush()
            for gap in self.gaps:
                bag.add_gap(gap)
        return folder

    def write_as_ros2_bag(
        self,
        folder: Path,
        plugin: StoragePlugin = StoragePlugin.SQLITE3,
        mode: CompressionMode = CompressionMode.NONE,
    ) -> Path:
        bag = Writer(folder, version=9, storage_plugin=plugin)
        if mode != CompressionMode.NONE:
            bag.set_compression(mode, CompressionFormat.ZSTD)
        with bag:
            types = dict(m[:2] for m in self.messages)
            connections = {t: bag.add_connection(t, kind, typestore=STORE) for t, kind in types.items()}
            for topic, _, data, received_ns in self.messages:
                bag.write(connections[topic], received_ns, data)
        return folder


T_TOOL_SENSOR = se3.exp([0.0, 0.0, 0.075, 0.0, 0.0, 0.3])
X_BASE_SURFACE = se3.exp([0.4, 0.1, 0.02, 3.0, 0.1, 0.2])


def T_base_sensor(seconds: float):
    """The sensor's way: along the surface, tilting a little."""
    rho = 0.004 * seconds, 0.01 * seconds, 3e-4 * np.sin(3 * seconds)
    drift = se3.exp([*rho, 0.05 * np.sin(seconds), 0.0, 0.0])
    return X_BASE_SURFACE @ drift @ se3.exp([0.0, 0.0, 0.003, 0.0, 0.02, 0.0])


def measured(seconds: float, random: np.random.Generator) -> PoseGaussian:
    """An estimate of X_sf, through a message and back as a node receives it."""
    X_sf = se3.inverse(T_base_sensor(seconds)) @ X_BASE_SURFACE
    sigma = np.array([2e-4] * 3 + [0.01] * 3)
    cov = np.diag(sigma**2)
    return PoseGaussian(se3.exp(sigma * random.standard_normal(6)) @ X_sf, cov)


def recording(
    count: int = 60, start_ns: int = START_NS, arms: tuple[str, ...] = ("arm",), touching=lambda k: k >= 5
) -> Recording:
    """`count` exposures, with a transform at each of them and one between each two."""
    random = np.random.default_rng(7)
    result = Recording(note={"scene": "test"})
    for arm in arms:
        result.static(arm)
    for k in range(count):
        stamp_ns = start_ns + k * STEP_NS
        seconds = (stamp_ns - start_ns) * 1e-9
        for arm in arms:
            estimate = measured(seconds, random)
            result.move(stamp_ns, T_base_sensor(seconds), arm)
            if touching(k):
                result.estimate(stamp_ns, estimate, arm)
                result.truth(stamp_ns, se3.inverse(se3.inverse(T_base_sensor(seconds)) @ X_BASE_SURFACE), arm)
            result.presence(stamp_ns, touching(k), arm)
            result.move(stamp_ns + STEP_NS // 2, T_base_sensor(seconds + 0.5e-9 * STEP_NS), arm)
    return result


def believed(
    source: Recording,
    settings: FilterSettings | None = None,
    arm: str = "arm",
    skip=(),
    changes=(),
    resets=(),
) -> list:
    """What a live filter believes: messages decoded one by one, scalar functions, transforms as they are.

    `changes` are pairs of a stamp and the settings that are in force from its exposure on; before the stamps
    in `resets` it is asked to start anew.
    """
    poses, in_contact, estimates = {}, {}, {}
    for topic, type_name, data, _ in source.messages:
        message = STORE.deserialize_cdr(data, type_name)
        if topic == "/tf":
            for each in message.transforms:
                if each.child_frame_id == f"{arm}/tool":
                    T = _matrix(each.transform.translation, each.transform.rotation)
                    poses[_ns(each.header)] = se3.orthonormalized(T)
        elif topic == f"/{arm}/contact/presence":
            in_contact[_ns(message.header)] = message.in_contact
        elif topic == f"/{arm}/contact/estimate":
            content = message.pose
            mean = _matrix(content.pose.position, content.pose.orientation)
            cov = left_from_ros(np.asarray(content.covariance).reshape(6, 6), mean[:3, 3])
            estimates[_ns(message.header)] = PoseGaussian(mean, cov)
    contact_filter, beliefs = ContactFilter(settings), []
    mounted = _through_message(T_TOOL_SENSOR)
    for stamp_ns in sorted(in_contact):
        if stamp_ns in skip:
            continue
        if stamp_ns in resets:
            contact_filter.reset("service")
        for changed_ns, changed in changes:
            if changed_ns == stamp_ns:
                contact_filter.configure(changed)
        if in_contact[stamp_ns]:
            T = se3.inverse(np.eye(4)) @ (poses[stamp_ns] @ mounted)
            beliefs.append(contact_filter.step(stamp_ns, estimates[stamp_ns], T))
        elif contact_filter.has_belief:
            contact_filter.reset("no contact")
    return beliefs


def _through_message(T):
    point, quaternion = _parts(T)
    return se3.orthonormalized(_matrix(make("geometry_msgs/msg/Vector3", *point), quaternion))


def _matrix(point, quaternion):
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_quaternion((quaternion.x, quaternion.y, quaternion.z, quaternion.w))
    T[:3, 3] = point.x, point.y, point.z
    return T


def _ns(head) -> int:
    return head.stamp.sec * 10**9 + head.stamp.nanosec
