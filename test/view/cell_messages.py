"""Messages of an arm that follows a plane, as a recorder keeps them: serialized by `rosbags`, not by us."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base import topics
from tactile_base.topics import Topic
from tactile_geometry import se3
from tactile_records.bags.writer import BagWriter
from tactile_wire.message_definitions import message_definition, typestore

START, RATE = 1_700_000_000_000_000_000, 60
DEPTH, SHEAR = 3e-3, 1e-3
GOAL = (0.4, 0.1, 0.017)
SIGMA = np.array([1e-4, 2e-4, 3e-4, 4e-3, 5e-3, 6e-3])
TOPICS = (
    topics.ARM_POSE.of("arm"), topics.ARM_STATUS.of("arm"), topics.CONTROLLER_STATUS.of("arm"),
    topics.PATH.of("arm"), topics.STATE.of("arm"), topics.ESTIMATE.of("arm"), topics.PRESENCE.of("arm"),
    topics.TRUTH.of("arm"), topics.LATENCY.of("arm"), topics.IMAGE.of("arm"), topics.TF, topics.TF_STATIC,
    topics.DIAGNOSTICS, topics.ROSOUT, topics.PARAMETER_EVENTS, topics.ESTOP,
)  # fmt: skip


@cache
def store(type_name: str) -> Any:
    return typestore(type_name, message_definition(type_name))


def packed(type_name: str, **fields: Any) -> bytes:
    """A message with these fields, nested ones by `name__inner`; all others are zero or empty."""
    message = blank(type_name, type_name)
    for name, value in fields.items():
        *path, last = name.split("__")
        target = message
        for part in path:
            target = getattr(target, part)
        object.__setattr__(target, last, value)
    return bytes(store(type_name).serialize_cdr(message, type_name))


def blank(of: str, type_name: str) -> Any:
    """A message of a type that a message of type `of` holds, with nothing in it."""
    types = store(of)
    values = {name: _blank_value(of, kind) for name, kind in types.fielddefs[type_name][1]}
    return types.types[type_name](**values)


def _blank_value(of: str, kind: Any) -> Any:
    node, content = kind
    if node == 2:  # a message
        return blank(of, content)
    if node == 1:
        return "" if content[0] == "string" else False if content[0] == "bool" else 0
    inner, length = content
    if inner[0] == 1 and inner[1][0] != "string":
        name = {"octet": "uint8", "byte": "uint8", "char": "uint8"}.get(inner[1][0], inner[1][0])
        return np.zeros(length if node == 3 else 0, dtype=name)
    return []


def stamp(ns: int) -> dict[str, int]:
    return {"header__stamp__sec": ns // 10**9, "header__stamp__nanosec": ns % 10**9}


def pose_fields(prefix: str, T: np.ndarray) -> dict[str, float]:
    q = se3.quaternion_from_rotation(T[:3, :3])
    names = [f"{prefix}__position__{axis}" for axis in "xyz"]
    names += [f"{prefix}__orientation__{axis}" for axis in "xyzw"]
    return dict(zip(names, [*T[:3, 3].tolist(), *q.tolist()], strict=True))


def sensor_pose(seconds: float) -> np.ndarray:
    """T_base_sensor over the plane z = 0: 10 mm/s along x, `DEPTH` into it."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = [0.3 + 0.01 * seconds, 0.1, 0.020 - DEPTH]
    return T


X_FS = se3.pose_from_euler([SHEAR, 0.0, DEPTH, 0.0, 0.0, 0.0])
X_SF = se3.inverse(X_FS)


def messages(seconds: float) -> Iterator[tuple[str, str, bytes, int]]:
    """Topic, type, bytes and time (ns) of all that is said in so many seconds."""
    arm = {topic.name: topic for topic in TOPICS}

    def said(topic: Topic, ns: int, **fields: Any) -> tuple[str, str, bytes, int]:
        return topic.name, topic.type, packed(topic.type, **fields), ns

    transform = blank(topics.TF.type, "geometry_msgs/msg/TransformStamped")
    transform.header.frame_id, transform.child_frame_id = "world", "arm/base"
    transform.transform.rotation.w, transform.transform.translation.z = 1.0, 0.5
    yield said(topics.TF_STATIC, START, transforms=[transform])
    for k in range(round(seconds * RATE)):
        ns = START + round(k / RATE * 1e9)
        header = stamp(ns)
        T = sensor_pose(k / RATE)
        yield said(arm["/arm/arm/pose"], ns, **header, **pose_fields("pose", T))
        yield said(arm["/arm/arm/status"], ns, **header, mode=1, owner="/arm/controller", twist=twist())
        yield said(
            arm["/arm/controller/status"], ns, **header, task="surface_following", goal_name="east",
            phase="approach" if k < RATE // 2 else "follow", progress=k / RATE / seconds, limited=twist(),
            unlimited=twist(), reference=np.array([0.0, 0.0, DEPTH, 0.0, 0.0, 0.0]),
        )  # fmt: skip
        if k % (RATE // 2) == 0:
            goal = blank(topics.PATH.type, "geometry_msgs/msg/Pose")
            goal.position.x, goal.position.y, goal.position.z = GOAL
            yield said(arm["/arm/controller/path"], ns, **header, poses=[goal])
        yield said(arm["/arm/contact/presence"], ns, **header, in_contact=True, score=1.0)
        yield said(
            arm["/arm/contact/state"],
            ns,
            **header,
            xi=se3.log(X_SF),
            covariance=np.diag(SIGMA**2).ravel(),
            flags=1,
        )
        yield said(
            arm["/arm/contact/estimate"], ns, **header, **pose_fields("pose__pose", X_SF),
            pose__covariance=np.diag(SIGMA**2).ravel(),
        )  # fmt: skip
        yield said(
            arm["/arm/sim/truth"], ns, **header, in_contact=True, depth=DEPTH,
            euler=np.array([SHEAR, 0.0, DEPTH, 0.0, 0.0, 0.0]),
        )  # fmt: skip
        if k % 6 == 0:
            image = np.full((48, 64), 20, np.uint8)
            image[10:20, (k % 40) : (k % 40) + 10] = 220
            yield said(
                arm["/arm/tactile/image"], ns, **header, height=48, width=64, step=64, encoding="mono8",
                data=image.ravel(),
            )  # fmt: skip


def twist() -> np.ndarray:
    return np.array([0.010, 0.0, 0.0, 0.0, 0.0, 0.0])


def record(folder: Path, seconds: float = 3.0, note: dict[str, str] | None = None) -> Path:
    """A bag of them."""
    with BagWriter(folder, TOPICS, note=note) as bag:
        for topic, _, data, ns in messages(seconds):
            bag.write(topic, data, ns)
    return folder
