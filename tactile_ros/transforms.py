"""TF behind one interface: tf2's buffer where it is installed, else our own, both fed from real /tf messages.

Lookups are at a stamp and never fall back to another one in silence. Who needs a transform that is not there
yet waits for it with a `TransformGate`, in the order of the stamps and up to a deadline.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from rclpy.time import Time
from tf2_msgs.msg import TFMessage

from tactile_filter.events import JUMP_NS, Event, EventJoin
from tactile_filter.transform_buffer import (
    TransformBuffer,
    TransformDisconnected,
    TransformInFuture,
    TransformInPast,
    TransformUnavailable,
)
from tactile_ros.cdr import ReceivedTransform, transforms_from_bytes
from tactile_ros.conversions import (
    MessageError,
    matrix_from_transform,
    pose_from_numbers,
    transform_stamped,
)
from tactile_ros.managed_node import ManagedNode
from tactile_ros.qos import TF, TF_STATIC
from tactile_ros.stamps import SECOND_NS

try:
    import tf2_ros
except ImportError:  # no wheels of it exist
    tf2_ros = None

Array = NDArray[np.float64]


class Store(Protocol):
    """Where transforms are kept."""

    def put(self, transform: ReceivedTransform, static: bool) -> None:
        """Keep a transform; raises `MessageError` if it cannot be used."""

    def lookup(self, target: str, source: str, stamp_ns: int) -> Array:
        """T_target_source (4, 4) at the stamp; raises `TransformUnavailable`."""

    def newest(self, target: str, source: str) -> tuple[int, Array]:
        """Newest stamp along the chain, and T_target_source there; raises `TransformUnavailable`."""

    def clear(self) -> None:
        """Forget what is not static."""


class OwnStore:
    """Our own buffer, `tactile_filter.transform_buffer`."""

    def __init__(self) -> None:
        self._buffer = TransformBuffer()

    def put(self, transform: ReceivedTransform, static: bool) -> None:
        """See `Store`."""
        parent, child = _frames(transform)
        T = pose_from_numbers(transform.translation, transform.rotation)
        try:
            self._buffer.set_transform(parent, child, transform.stamp_ns, T, static=static)
        except ValueError as error:
            raise MessageError(str(error)) from error

    def lookup(self, target: str, source: str, stamp_ns: int) -> Array:
        """See `Store`."""
        return self._buffer.lookup(target, source, stamp_ns)

    def newest(self, target: str, source: str) -> tuple[int, Array]:
        """See `Store`."""
        stamp_ns = self._buffer.latest_stamp(target, source)
        if stamp_ns is None:
            raise _nothing_moves(target, source)
        return stamp_ns, self._buffer.lookup(target, source, stamp_ns)

    def clear(self) -> None:
        """See `Store`."""
        self._buffer.clear()


class Tf2Store:
    """The buffer of tf2_ros, which interpolates position and rotation each on its own.

    What tf2 would log and ignore, or take and answer wrongly later, is refused here as by our own buffer.
    """

    def __init__(self) -> None:
        self._buffer = tf2_ros.Buffer()
        self._parents: dict[str, tuple[str, bool]] = {}  # by child, with whether the link is static

    def put(self, transform: ReceivedTransform, static: bool) -> None:
        """See `Store`."""
        parent, child = _frames(transform)
        self._check_link(parent, child)
        T = pose_from_numbers(transform.translation, transform.rotation)
        if not np.isfinite(T).all():
            raise MessageError(f"transform '{parent}' -> '{child}': must be finite, is {transform}")
        self._parents[child] = parent, static
        message = transform_stamped(transform.stamp_ns, parent, child, T)
        if static:
            self._buffer.set_transform_static(message, "tf_static")
        else:
            self._buffer.set_transform(message, "tf")

    def lookup(self, target: str, source: str, stamp_ns: int) -> Array:
        """See `Store`; tf2 takes a time of zero for 'the newest', which is right only where nothing moves."""
        if stamp_ns <= 0 and self._newest_ns(target, source) > 0:
            raise TransformInPast(f"{_asked(target, source, stamp_ns)}: must be later than 0")
        try:
            found = self._buffer.lookup_transform(target, source, Time(nanoseconds=max(stamp_ns, 0)))
        except tf2_ros.TransformException as error:
            raise self._unavailable(target, source, stamp_ns, error) from error
        return matrix_from_transform(found.transform)

    def newest(self, target: str, source: str) -> tuple[int, Array]:
        """See `Store`."""
        stamp_ns = self._newest_ns(target, source)
        if stamp_ns == 0:
            raise _nothing_moves(target, source)
        return stamp_ns, self.lookup(target, source, stamp_ns)

    def clear(self) -> None:
        """See `Store`; tf2 keeps static transforms as well."""
        self._buffer.clear()
        self._parents = {child: link for child, link in self._parents.items() if link[1]}

    def _check_link(self, parent: str, child: str) -> None:
        """Raise `MessageError` for a link without a name or one that would close a loop."""
        if not parent or not child:
            raise MessageError(f"transform '{parent}' -> '{child}': a frame's name must not be empty")
        ancestor = parent
        while ancestor != child and ancestor in self._parents:
            ancestor = self._parents[ancestor][0]
        if ancestor == child:
            raise MessageError(f"transform '{parent}' -> '{child}': would close a loop")

    def _newest_ns(self, target: str, source: str) -> int:
        """Newest stamp along the chain (ns), 0 if nothing moves in it; raises `TransformDisconnected`."""
        try:
            return int(self._buffer.get_latest_common_time(target, source).nanoseconds)
        except tf2_ros.TransformException as error:
            raise TransformDisconnected(f"no transform from '{source}' to '{target}': {error}") from error

    def _unavailable(self, target: str, source: str, stamp_ns: int, error: Exception) -> TransformUnavailable:
        """The error that says whether waiting may help, which tf2's do not tell in Python."""
        try:
            newest_ns = self._newest_ns(target, source)
        except TransformDisconnected as disconnected:
            return disconnected
        asked, later = _asked(target, source, stamp_ns), (stamp_ns - newest_ns) / SECOND_NS
        if later > 0.0:
            return TransformInFuture(
                f"{asked}: the newest is of {newest_ns} ns, the stamp is {later:.6f} s later"
            )
        return TransformInPast(f"{asked}: the stamp is earlier than what is kept: {error}")


def _frames(transform: ReceivedTransform) -> tuple[str, str]:
    """Parent and child; a leading slash, which old programs still send, is no part of a name in tf2."""
    return transform.parent.removeprefix("/"), transform.child.removeprefix("/")


def _asked(target: str, source: str, stamp_ns: int) -> str:
    return f"transform from '{source}' to '{target}' at {stamp_ns} ns"


def _nothing_moves(target: str, source: str) -> TransformUnavailable:
    return TransformUnavailable(f"nothing moves between '{target}' and '{source}': no newest transform")


class TransformListener:
    """Listens to /tf and /tf_static while the node is configured.

    Parameters
    ----------
    on_update : callable, optional
        Called after each message of /tf or /tf_static.
    on_jump : callable, optional
        Called with the size of the jump in seconds when stamps go back, after the old transforms were
        forgotten.
    ignore : collection of str, optional
        Child frames that are passed over: those the node itself publishes. One from before a jump that is
        heard only after it would be taken for the start of yet another time.
    """

    def __init__(
        self,
        node: ManagedNode,
        on_update: Callable[[], None] | None = None,
        on_jump: Callable[[float], None] | None = None,
        ignore: Collection[str] = (),
    ) -> None:
        self._node = node
        self._on_update = on_update
        self._on_jump = on_jump
        self._ignore = frozenset(ignore)
        self._newest_ns: dict[str, int] = {}
        self.store: Store = OwnStore() if tf2_ros is None else Tf2Store()
        node.subscribe(TFMessage, "/tf_static", self._receive_static, TF_STATIC, always=True, raw=True)
        node.subscribe(TFMessage, "/tf", self._receive, TF, always=True, raw=True)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Array:
        """T_target_source (4, 4) at the stamp; raises `TransformUnavailable`."""
        return self.store.lookup(target, source, stamp_ns)

    def newest(self, target: str, source: str) -> tuple[int, Array]:
        """The newest T_target_source with its stamp, for who asks where things are and heeds the age."""
        return self.store.newest(target, source)

    def _receive_static(self, data: bytes) -> None:
        self._put_all(transforms_from_bytes(data), static=True)

    def _receive(self, data: bytes) -> None:
        self._put_all(transforms_from_bytes(data), static=False)

    def _put_all(self, transforms: list[ReceivedTransform], static: bool) -> None:
        for transform in transforms:
            if transform.child in self._ignore:
                continue
            if not static:
                self._look_for_jump(transform)
            try:
                self.store.put(transform, static)
            except MessageError as error:
                self._node.count("transforms refused")
                self._node.warn("tf", f"transform of {transform.child} refused: {error}")
        if self._on_update is not None:
            self._on_update()

    def _look_for_jump(self, transform: ReceivedTransform) -> None:
        stamp_ns, child = transform.stamp_ns, transform.child
        newest_ns = self._newest_ns.get(child, stamp_ns)
        if stamp_ns < newest_ns - JUMP_NS:
            self._newest_ns.clear()
            self.store.clear()
            self._node.count("backward time jumps")
            seconds = (newest_ns - stamp_ns) / SECOND_NS
            self._node.warn("jump", f"time jumped back by {seconds:.3f} s: transforms and state are cleared")
            if self._on_jump is not None:
                self._on_jump(seconds)
        self._newest_ns[child] = max(stamp_ns, self._newest_ns.get(child, 0))


class FramePublisher:
    """Publishes a pose as a frame on /tf, at most so often.

    Parameters
    ----------
    parent, child : frames
    rate : callable
        The highest rate in Hz, by the poses' stamps; 0: never.
    """

    def __init__(self, node: ManagedNode, parent: str, child: str, rate: Callable[[], float]) -> None:
        self._frames = parent, child
        self._rate = rate
        self._out = node.publisher(TFMessage, "/tf", TF)
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
        self._join = join
        self._transforms = transforms
        self._frames = frames
        self._timeout = timeout
        self._deliver = deliver
        self._drop = drop
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
