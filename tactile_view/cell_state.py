"""CellState: what messages have said of a cell up to now, the same live and from a recording.

    cell = CellState(installed_typestore)
    cell.take("/arm/contact/state", "tactile_msgs/msg/ContactState", data, received_ns)
    cell.arms["arm"].newest("belief")

Messages come as bytes and are read by `rosbags`, so that a recording needs no ROS. Of each stream of an arm
the last `WINDOW` seconds are kept, of an image only the newest, undecoded. A message that is none is counted
and passed over: whoever shows something must not end by it.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError

from tactile_base import topics
from tactile_base.stamps import SECOND_NS
from tactile_base.topics import Topic
from tactile_records.bags.contents import Recorded
from tactile_records.runs.events import Telling, tells
from tactile_records.runs.from_bag import STREAMS, frames_of, transform_matrix
from tactile_records.runs.record import Event
from tactile_wire.errors import MessageError
from tactile_wire.message_definitions import installed_typestore

Array = NDArray[Any]
Row = dict[str, Any]
#: Type -> what `rosbags` deserializes it with.
Types = Callable[[str], Any]

WINDOW = 10.0  # s
MOST_ROWS = 4000  # of a stream within the window, whatever its rate
PATH = 3000  # points of the way behind
STEP = 5e-4  # m, between two of them
MOST_EVENTS = 200
#: What bytes raise that are no message of their type, and a message that makes no sense.
SENSELESS = (
    SerdeError, MessageError, struct.error, ValueError, LookupError, TypeError, AttributeError,
    AssertionError, OverflowError, MemoryError,
)  # fmt: skip
_NAMES = {topic: name for name, (topic, _) in STREAMS.items()}
_IMAGES = (topics.IMAGE.name, topics.compressed(topics.IMAGE).name)


@dataclass
class ArmState:
    """What is known of one arm.

    Attributes
    ----------
    streams : name in `from_bag.STREAMS` -> its rows of the last seconds, oldest first
    status, controller : the last ArmStatus and ControllerStatus
    image : the last image's message, undecoded
    joints : angles of the joints (n,), rad, where the arm tells them
    path : where the sensor was, in the base (3,), m
    ahead : where its task leads (n, 3), in the base, m, the last one its goal; none where nobody knows
    latency, dropped : stage -> (exposure (ns), seconds) of the last frames; how many were dropped so far
    """

    name: str
    streams: dict[str, deque[Row]] = field(default_factory=lambda: {name: deque() for name in STREAMS})
    status: Any = None
    controller: Any = None
    image: Recorded | None = None
    joints: Array | None = None
    path: deque[Array] = field(default_factory=lambda: deque(maxlen=PATH))
    ahead: Array = field(default_factory=lambda: np.zeros((0, 3)))
    latency: dict[str, deque[tuple[int, float]]] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    T_world_base: Array = field(default_factory=lambda: np.eye(4))

    def newest(self, stream: str) -> Row | None:
        """The last row of a stream."""
        rows = self.streams[stream]
        return rows[-1] if rows else None


class CellState:
    """See the module's text; of events the latest `most_events` are kept, or all.

    Attributes
    ----------
    arms : by name
    bodies : name -> T_world_body (4, 4), of those that move
    trouble : node -> what it complains about in /diagnostics
    events : what is told beside the numbers
    changed : node -> name -> value, of parameters that were changed since somebody took it from here
    refused : topic -> number of messages that were none
    now_ns : stamp of the latest message
    """

    def __init__(self, types: Types = installed_typestore, most_events: int | None = MOST_EVENTS) -> None:
        self.types, self._most_events = types, most_events
        self.clear()

    def clear(self) -> None:
        """Forget everything, as for another place in a recording."""
        self.arms: dict[str, ArmState] = {}
        self.bodies: dict[str, Array] = {}
        self._telling = Telling()
        self.trouble, self.changed = self._telling.trouble, self._telling.changed
        self.events: deque[Event] = deque(maxlen=self._most_events)
        self.refused: Counter[str] = Counter()
        self.now_ns = 0

    def arm(self, name: str) -> ArmState:
        """The state of an arm, which begins with its first message."""
        if name not in self.arms:
            self.arms[name] = ArmState(name)
        return self.arms[name]

    def take(self, topic: str, type_name: str, data: bytes, received_ns: int) -> None:
        """One message; what nobody shows is passed over."""
        arm, _, name = topic[1:].partition("/")
        shows = name in _SHOWN
        if not shows and not tells(topic) and topic not in _TRANSFORMS:
            return
        self.now_ns = max(self.now_ns, received_ns)
        if name in _IMAGES:
            self.arm(arm).image = Recorded(topic, type_name, data, received_ns, received_ns)
            return
        try:
            message = self.types(type_name).deserialize_cdr(data, type_name)
            if topic in _TRANSFORMS:
                self._take_transforms(message)
            elif shows:
                self._take_of_arm(self.arm(arm), name, message)
            self.events.extend(self._telling.take(topic, message, received_ns))
        except SENSELESS:
            self.refused[topic] += 1

    # ---- of all ----

    def _take_transforms(self, message: Any) -> None:
        for item in message.transforms:
            child, parent = item.child_frame_id, item.header.frame_id
            if parent != topics.WORLD:
                continue
            if child.startswith(BODY):
                self.bodies[child.removeprefix(BODY)] = transform_matrix(item.transform)
            elif child.endswith(BASE):
                self.arm(child.removesuffix(BASE)).T_world_base = transform_matrix(item.transform)

    # ---- of an arm ----

    def _take_of_arm(self, state: ArmState, name: str, message: Any) -> None:
        if name in _NAMES:
            self._take_row(state, _NAMES[name], message)
        if name == topics.ARM_STATUS.name:
            state.status = message
        elif name == topics.CONTROLLER_STATUS.name:
            state.controller = message
        elif name == topics.JOINT_STATES.name:
            state.joints = np.asarray(message.position, dtype=np.float64)
        elif name == topics.PATH.name:
            state.ahead = _positions(message)
        elif name == topics.LATENCY.name:
            self._take_latency(state, message)

    def _take_row(self, state: ArmState, stream: str, message: Any) -> None:
        row = STREAMS[stream][1](message)
        if row is None:
            return
        rows = state.streams[stream]
        if rows and row["stamp_ns"] < rows[-1]["stamp_ns"]:
            return  # late: it would draw a line back
        rows.append(row)
        while len(rows) > MOST_ROWS or row["stamp_ns"] - rows[0]["stamp_ns"] > WINDOW * SECOND_NS:
            rows.popleft()
        if stream == "pose":
            position = row["T_base_sensor"][:3, 3]
            if not state.path or np.linalg.norm(position - state.path[-1]) > STEP:
                state.path.append(position)

    def _take_latency(self, state: ArmState, message: Any) -> None:
        stage, frames = frames_of(message)
        if frames:
            kept = state.latency.setdefault(stage, deque(maxlen=600))
            kept.extend((stamp_ns, seconds) for stamp_ns, seconds, _ in frames)
            state.dropped[stage] = frames[-1][2]


def _positions(message: Any) -> Array:
    """Of the poses of a PoseArray (n, 3); `ValueError` where they are nowhere."""
    places = [pose.position for pose in message.poses]
    found = np.array([(p.x, p.y, p.z) for p in places], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(found).all():
        raise ValueError("a path must lead along finite positions")
    return found


BODY, BASE = topics.body_frame(""), topics.base_frame("")
_TRANSFORMS = (topics.TF.name, topics.TF_STATIC.name)
_SHOWN = {
    *_NAMES, *_IMAGES, topics.ARM_STATUS.name, topics.CONTROLLER_STATUS.name, topics.PATH.name,
    topics.STATE.name, topics.JOINT_STATES.name, topics.LATENCY.name,
}  # fmt: skip


def shown_topics(arm: str, images: bool = True) -> list[Topic]:
    """The topics of an arm that are looked at."""
    found = {topic.name: topic for topic in (*topics.ARM_TOPICS, *topics.SENSOR_TOPICS, topics.JOINT_STATES)}
    chosen = [topic for name, topic in found.items() if name in _SHOWN]
    return [topic.of(arm) for topic in (*chosen, *((topics.IMAGE,) if images else ()))]
