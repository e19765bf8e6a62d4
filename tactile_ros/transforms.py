"""/tf and /tf_static into a `TransformBuffer` and out of it, the same one that a replayed bag goes through.

Lookups are at a stamp and never fall back to another one in silence. Who needs a transform that is not there
yet waits for it with a `TransformGate`, in the order of the stamps and up to a deadline. Nodes that make a
belief of such inputs have `BeliefInputSettings` and `serve_reset` in common.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tf2_msgs.msg import TFMessage

from tactile_base import topics
from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_filter.events import JUMP_NS, Event, EventJoin
from tactile_geometry.transform_buffer import (
    MotionLimits,
    TransformBuffer,
    TransformInPast,
    TransformUnavailable,
)
from tactile_msgs.srv import ResetFilter
from tactile_ros.conversions import transform_stamped
from tactile_ros.managed_node import ManagedNode
from tactile_ros.message_bytes import ReceivedTransform, transforms_from_bytes
from tactile_ros.qos import TF, TF_STATIC
from tactile_wire.pose_numbers import pose_from_numbers

Array = NDArray[np.float64]


class TransformListener:
    """Listens to /tf and /tf_static while the node is configured.

    Parameters
    ----------
    on_update : callable, optional
        Called after each message of /tf or /tf_static.
    on_jump : callable, optional
        Called with the reason when what was known before means nothing any more, after it was forgotten: when
        stamps go back, or a frame has jumped and stays there.
    frames : sequence of (str, str)
        Target and source of all lookups; others' frames may jump.
    limits : MotionLimits, optional
        A transform that no frame can have reached is refused, counted and told.
    ignore : collection of str, optional
        Child frames that are passed over: those the node itself publishes. One from before a jump that is
        heard only after it would be taken for the start of yet another time.
    """

    def __init__(
        self,
        node: ManagedNode,
        on_update: Callable[[], None] | None = None,
        on_jump: Callable[[str], None] | None = None,
        ignore: Collection[str] = (),
        frames: Sequence[tuple[str, str]] = (),
        limits: MotionLimits | None = None,
    ) -> None:
        self._node, self._on_update, self._on_jump = node, on_update, on_jump
        self._ignore = frozenset(ignore)
        self._buffer = TransformBuffer(jump_ns=JUMP_NS, limits=limits, frames=frames)
        receive_static = functools.partial(self._receive, static=True)
        node.subscribe(TFMessage, topics.TF_STATIC.name, receive_static, TF_STATIC, always=True, raw=True)
        node.subscribe(TFMessage, topics.TF.name, self._receive, TF, always=True, raw=True)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Array:
        """T_target_source (4, 4) at the stamp; raises `TransformUnavailable`."""
        return self._buffer.lookup(target, source, stamp_ns)

    def newest(self, target: str, source: str) -> tuple[int, Array]:
        """The newest T_target_source with its stamp; raises `TransformUnavailable`."""
        return self._buffer.newest(target, source)

    def _receive(self, data: bytes, static: bool = False) -> None:
        for transform in transforms_from_bytes(data):
            if transform.child in self._ignore:
                continue
            try:
                restarted = self._put(transform, static)
            except ValueError as error:
                self._node.count("transforms refused")
                self._node.warn("tf", f"/tf: {transform.child} refused: {error}")
                continue
            if restarted:
                self._report_jump(f"/tf: {restarted}")
        if self._on_update is not None:
            self._on_update()

    def _put(self, transform: ReceivedTransform, static: bool) -> str:
        """Add to the buffer; a leading slash, which old programs still send, is no part of a name."""
        parent, child = transform.parent.removeprefix("/"), transform.child.removeprefix("/")
        if not static and self._buffer.concerns(child):
            self._node.check_stamp(transform.stamp_ns)
        T = pose_from_numbers((*transform.translation, *transform.rotation))
        return self._buffer.set_transform(parent, child, transform.stamp_ns, T, static=static)

    def _report_jump(self, reason: str) -> None:
        self._node.count("restarts")
        self._node.warn("jump", f"{reason}: transforms and state are cleared")
        if self._on_jump is not None:
            self._on_jump(reason)


class FramePublisher:
    """Publishes a pose as a frame on /tf, at most so often.

    Parameters
    ----------
    parent, child : frames
    rate : callable
        The highest rate in Hz, by the poses' stamps; 0: never.
    """

    def __init__(self, node: ManagedNode, parent: str, child: str, rate: Callable[[], float]) -> None:
        self._frames, self._rate = (parent, child), rate
        self._out = node.publisher(TFMessage, topics.TF.name, TF)
        self.clear()

    def clear(self) -> None:
        """The next pose is published, whatever its stamp."""
        self._newest_ns = -1

    def publish(self, stamp_ns: int, T_parent_child: Array) -> None:
        """Publish the pose, unless the last one was too short a time ago."""
        rate = self._rate()
        if rate and abs(stamp_ns - self._newest_ns) * rate >= 0.95 * SECOND_NS:
            self._newest_ns = stamp_ns
            frame = transform_stamped(stamp_ns, *self._frames, T_parent_child)
            self._out.publish(TFMessage(transforms=[frame]))


@dataclass(frozen=True)
class BeliefInputSettings(Settings):
    """How long the node waits for what it needs, and how often it publishes its frame."""

    tf_timeout: float = setting(
        0.05, lower=0.0, upper=5.0, unit="s", doc="an input waits so long for the sensor's pose at its stamp"
    )
    age_limit: float = setting(
        0.25, lower=0.0, upper=60.0, unit="s",
        doc="longer silence of an input is reported in /diagnostics; 0: never",
    )  # fmt: skip
    tf_rate: float = setting(
        15.0, lower=0.0, upper=1000.0, unit="Hz",
        doc="the belief is published as a frame on /tf as well, at most this often; 0: never",
    )  # fmt: skip


class TransformGate:
    """Holds joined events until T_target_source at their stamp is there; hands them out by stamp.

    Call `pump` whenever something arrived; a timer of the node calls it for the deadlines.

    Parameters
    ----------
    timeout : callable
        The longest wait in s, from the arrival of an event's first message.
    deliver : callable
        Called with the event and T_target_source (4, 4).
    drop : callable
        Called with the event and the reason when the deadline has passed.
    """

    def __init__(
        self,
        node: ManagedNode,
        join: EventJoin,
        transforms: TransformListener,
        frames: tuple[str, str],
        timeout: Callable[[], float],
        deliver: Callable[[Event, Array], None],
        drop: Callable[[Event, str], None],
    ) -> None:
        self._join, self._transforms, self._frames = join, transforms, frames
        self._timeout, self._deliver, self._drop = timeout, deliver, drop
        node.timer(0.01, self.pump)

    def pump(self) -> None:
        """Hand out what is ready and drop what has waited too long."""
        while len(self._join):
            event = self._join.ready() or self._join.oldest()
            if event is None or not self._hand_out(event):
                return

    def _hand_out(self, event: Event) -> bool:
        """Deliver or drop the oldest event; False if it goes on waiting."""
        missing = self._join.missing(event)
        if missing:
            return self._give_up(event, f"no {' and no '.join(missing)} of the same stamp")
        try:
            T = self._transforms.lookup(*self._frames, event.stamp_ns)
        except TransformUnavailable as error:
            return self._give_up(event, str(error), at_once=isinstance(error, TransformInPast))
        self._join.pop()
        self._deliver(event, T)
        return True

    def _give_up(self, event: Event, reason: str, at_once: bool = False) -> bool:
        """Drop the event if its deadline has passed or waiting cannot help."""
        waited = (time.monotonic_ns() - event.received_ns) / SECOND_NS
        if waited <= self._timeout() and not at_once:
            return False
        self._drop(self._join.drop_oldest(), f"{reason}; waited {waited * 1e3:.0f} ms")
        return True


def serve_reset(node: ManagedNode, reset: Callable[[], None], success_message: str) -> None:
    """Offer `~/reset` while the node is configured: it forgets what it believes, if it is active.

    Parameters
    ----------
    success_message : str
        What comes next, for who asked.
    """

    def act(request: ResetFilter.Request) -> None:
        node.get_logger().info(f"reset: {request.reason or 'no reason given'}")
        reset()

    node.serve_request(ResetFilter, "~/reset", act, success_message)
