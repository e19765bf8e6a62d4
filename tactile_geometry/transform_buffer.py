"""Transforms between named frames over time, as a plain library: bounded history, interpolation, lookups by
stamp.

What a lookup cannot answer exactly is an error that names the stamps it has; the latest transform never
stands in for the one that was asked for. A transform that no arm can have reached since the one before it is
refused, unless those that follow confirm it.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_geometry import se3

Array = NDArray[np.float64]

STAMP_SLACK = 0.005  # s; by how much the time between two stamps may be off the time that passed
#: Links, characters of a frame's name, and transforms of all links together that are kept: more are no cell.
MOST_LINKS, LONGEST_FRAME, MOST_TRANSFORMS = 2000, 200, 500_000
CONFIRMED_BY = 5  # transforms, at least, that make a new place credible


@dataclass(frozen=True)
class MotionLimits(Settings):
    """What moves at most how fast; a transform that is further away is refused."""

    largest_speed: float = setting(
        1.0, lower=0.01, upper=10.0, unit="m/s", doc="a frame that was faster since its last transform jumped"
    )
    largest_turn_rate: float = setting(
        2.0 * math.pi, lower=0.05, upper=50.0, unit="rad/s", doc="the same of its rotation"
    )
    restart_after: float = setting(
        0.5, lower=0.05, upper=60.0, unit="s",
        doc="a frame whose transforms agree with each other for so long after it jumped is where they say",
    )  # fmt: skip

    def fault(self, before: tuple[int, Array], after: tuple[int, Array]) -> str:
        """Why nothing gets from one stamped transform to the other; empty where it can."""
        (start_ns, A), (end_ns, B) = before, after
        elapsed = abs(end_ns - start_ns) * NANOSECOND
        way = math.dist(A[:3, 3], B[:3, 3])
        if way > self.largest_speed * (elapsed + STAMP_SLACK):
            return f"jumped by {way * 1e3:.4g} mm in {_rate_text(elapsed, way, self.largest_speed, 'm/s')}"
        angle = math.acos(min(1.0, max(-1.0, 0.5 * (float(np.vdot(A[:3, :3], B[:3, :3])) - 1.0))))
        if angle > self.largest_turn_rate * (elapsed + STAMP_SLACK):
            rate = _rate_text(elapsed, angle, self.largest_turn_rate, "rad/s")
            return f"turned by {math.degrees(angle):.0f} degrees in {rate}"
        return ""


def _rate_text(elapsed: float, way: float, limit: float, unit: str) -> str:
    rate = f"{way / elapsed:.3g} {unit}, " if elapsed > 0.0 else ""
    return f"{elapsed * 1e3:.0f} ms ({rate}limit {limit:.3g} {unit})"


class TransformJump(ValueError):
    """A transform further from the one before it than anything moves; the message says which and how far."""


class TransformUnavailable(LookupError):
    """No transform at the stamp that was asked for; the message says what there is instead."""


class TransformDisconnected(TransformUnavailable):
    """A frame is unknown, or no chain of transforms connects the two frames."""


class TransformInFuture(TransformUnavailable):
    """The stamp is later than the newest transform of a link: waiting may help."""


class TransformInPast(TransformUnavailable):
    """The stamp is earlier than the oldest transform kept of a link: waiting will not help."""


@dataclass
class _Link:
    """A child's transforms to its parent by stamp; a static link has one, which holds at any stamp."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    transforms: list[Array] = field(default_factory=list)
    elsewhere: list[tuple[int, Array]] = field(default_factory=list)  # see `_is_confirmed`


class TransformBuffer:
    """A tree of frames; each child has one parent.

    Parameters
    ----------
    history_ns : int
        How far back from its newest transform a link's history reaches (ns).
    jump_ns : int
        A transform older than the newest of its link by more than this means that time jumped back (a bag
        that starts again, a simulation that was reset): everything but the static transforms is forgotten.
        One that is older by less has been overtaken on the way and is put in its place.
    limits : MotionLimits, optional
        How fast frames move at most; without, transforms may jump.
    frames : sequence of (str, str)
        Target and source of the lookups. What happens to links that do not lie between them is nobody's
        business: they are never refused for a jump, and time that jumps back there concerns them alone.
        Without any, all links count.

    Notes
    -----
    It is the only store of transforms in this project, so that live nodes, replayed bags and offline runs
    agree to the bit. Where tf2's differs: tf2 moves the translation between two stamps along a straight line,
    this one along the screw motion (the same rotation, and at most |d| / 2 tan(angle / 4) beside tf2's
    translation, d being its difference); tf2 takes a stamp of 0 for "the newest", which here is `newest`;
    tf2 keeps what a frame was to its former parent.
    """

    def __init__(
        self,
        history_ns: int = 10 * SECOND_NS,
        jump_ns: int = SECOND_NS,
        limits: MotionLimits | None = None,
        frames: Sequence[tuple[str, str]] = (),
    ) -> None:
        if history_ns <= 0 or jump_ns < 0:
            raise ValueError(f"history_ns = {history_ns}, jump_ns = {jump_ns}: must be positive")
        self.history_ns = history_ns
        self.jump_ns = jump_ns
        self.limits = limits
        self._frames = tuple(frames)
        self._between: set[str] | None = None  # the children that lookups depend on, see `concerns`
        self._links: dict[str, _Link] = {}
        self._count = 0  # of all transforms; no less than there are
        self._paths: dict[tuple[str, str], tuple[list[str], list[str]]] = {}  # of this tree, see _chains

    def set_transform(
        self, parent: str, child: str, stamp_ns: int, T_parent_child: ArrayLike, *, static: bool = False
    ) -> str:
        """Add a transform (4, 4); its rotation may be off orthonormal by `se3.ROTATION_TOLERANCE`.

        Returns
        -------
        str
            Why what was known before means nothing any more and was forgotten: time jumped back, as the stamp
            showed, or the frame jumped and stayed where it is now. Empty in the regular case.

        Raises
        ------
        TransformJump
            If the frame cannot have got there since the transform before, see `MotionLimits`; with these, a
            frame keeps its parent, too.
        ValueError
            If the matrix is no pose, a name is empty, or the link would close a loop.
        """
        T, stamp_ns = self._checked(parent, child, T_parent_child), int(stamp_ns)
        link, restarted = self._links.get(child), ""
        if link is not None and not static and self._jump(link, stamp_ns):
            if self.concerns(child):
                seconds = self._jump(link, stamp_ns) * NANOSECOND
                restarted = f"time jumped back by {seconds:.3f} s in the transforms of '{child}'"
                self.clear()
            link = None
        if link is None or link.parent != parent or link.static != static:
            if link is not None and self.limits is not None and self.concerns(child):
                kind = "does not move" if link.static else "moves"
                raise TransformJump(f"'{parent}' -> '{child}': it hangs below '{link.parent}' and {kind}")
            if child not in self._links and len(self._links) >= MOST_LINKS:
                raise ValueError(f"{len(self._links)} frames are known already, more are not taken")
            link = self._links[child] = _Link(parent, static)
            self._forget_paths()
        fault = self._fault(link, child, stamp_ns, T)
        if static and not fault:
            link.stamps, link.transforms = [stamp_ns], [T]
            return restarted
        if fault and not self._is_confirmed(link, stamp_ns, T):
            raise TransformJump(f"'{parent}' -> '{child}' {fault}")
        if fault:
            restarted = f"'{parent}' -> '{child}' {fault} and stayed there"
            link.stamps, link.transforms = map(list, zip(*link.elsewhere, strict=True))
        link.elsewhere.clear()
        self._insert(link, stamp_ns, T)
        return restarted

    def lookup(self, target: str, source: str, stamp_ns: int) -> Array:
        """T_target_source (4, 4) at a stamp, interpolated along screw motions between the stamps of each
        link.

        Raises `TransformDisconnected`, `TransformInFuture` or `TransformInPast`.
        """
        up, down = self._chains(target, source)
        T_common_source = self._compose(down, stamp_ns)
        return se3.inverse(self._compose(up, stamp_ns)) @ T_common_source if up else T_common_source

    def newest(self, target: str, source: str) -> tuple[int, Array]:
        """The newest stamp at which T_target_source is known, and T_target_source there.

        For who asks where things are and heeds the age. `TransformUnavailable` also where nothing moves.
        """
        stamp_ns = self.latest_stamp(target, source)
        if stamp_ns is None:
            raise TransformUnavailable(f"nothing moves between '{target}' and '{source}': none is the newest")
        return stamp_ns, self.lookup(target, source, stamp_ns)

    def latest_stamp(self, target: str, source: str) -> int | None:
        """The newest stamp (ns) at which every moving link between the frames is known; None if none moves.

        Raises `TransformDisconnected`.
        """
        up, down = self._chains(target, source)
        moving = [self._links[child] for child in (*up, *down) if not self._links[child].static]
        return min((link.stamps[-1] for link in moving), default=None)

    def stamps(self, child: str) -> list[int]:
        """The stamps (ns) of the transforms that are kept of a child, in order."""
        return list(self._links[child].stamps)

    def clear(self) -> None:
        """Forget all but the static transforms."""
        self._links = {child: link for child, link in self._links.items() if link.static}
        self._forget_paths()

    def concerns(self, child: str) -> bool:
        """Whether lookups depend on this child's link; where frames are not connected yet, they may."""
        if not self._frames:
            return True
        if self._between is None:
            self._between = set()
            for target, source in self._frames:
                try:
                    up, down = self._chains(target, source)
                except TransformDisconnected:
                    up, down = self._ancestors(target), self._ancestors(source)
                self._between.update(up, down)
        return child in self._between

    def frames(self) -> list[str]:
        """The names of all frames, sorted."""
        return sorted({name for child, link in self._links.items() for name in (child, link.parent)})

    def _checked(self, parent: str, child: str, T_parent_child: ArrayLike) -> Array:
        if not parent or not child:
            raise ValueError(f"transform '{parent}' -> '{child}': a frame's name must not be empty")
        if (longest := max(len(parent), len(child))) > LONGEST_FRAME:
            raise ValueError(f"a frame's name has {longest} characters, may have {LONGEST_FRAME}")
        known = self._links.get(child)
        if (known is None or known.parent != parent) and child in self._ancestors(parent):
            raise ValueError(f"transform '{parent}' -> '{child}': would close a loop")
        try:
            return se3.orthonormalized(T_parent_child)
        except ValueError as error:
            raise ValueError(f"transform '{parent}' -> '{child}': {error}") from error

    def _jump(self, link: _Link, stamp_ns: int) -> int:
        behind_ns = link.stamps[-1] - stamp_ns
        return behind_ns if behind_ns > self.jump_ns and not link.static else 0

    def _fault(self, link: _Link, child: str, stamp_ns: int, T: Array) -> str:
        """Why the frame cannot be there at that stamp, by the transforms next to it; empty if it can."""
        if self.limits is None or not link.stamps or not self.concerns(child):
            return ""
        at = 0 if link.static else bisect.bisect_left(link.stamps, stamp_ns)
        for near in (at - 1, at):
            if 0 <= near < len(link.stamps):
                since_ns = stamp_ns if link.static else link.stamps[near]  # static: no time to move
                if link.elsewhere and since_ns < link.elsewhere[-1][0] < stamp_ns:
                    since_ns = link.elsewhere[-1][0]  # nor does what jumped come within reach by waiting
                fault = self.limits.fault((since_ns, link.transforms[near]), (stamp_ns, T))
                if fault:
                    return fault
        return ""

    def _is_confirmed(self, link: _Link, stamp_ns: int, T: Array) -> bool:
        """Keep a transform that jumped; whether those that did agree with each other for long enough."""
        assert self.limits is not None
        if link.static or stamp_ns <= link.stamps[-1]:
            return False
        others = link.elsewhere
        if others and (stamp_ns <= others[-1][0] or self.limits.fault(others[-1], (stamp_ns, T))):
            others.clear()
        others.append((stamp_ns, T))
        lasted = (stamp_ns - others[0][0]) * NANOSECOND
        return len(others) >= CONFIRMED_BY and lasted >= self.limits.restart_after

    def _insert(self, link: _Link, stamp_ns: int, T: Array) -> None:
        at = bisect.bisect_left(link.stamps, stamp_ns)
        if at < len(link.stamps) and link.stamps[at] == stamp_ns:
            link.transforms[at] = T
            return
        self._count += 1
        if self._count > MOST_TRANSFORMS:
            self._make_room()
        link.stamps.insert(at, stamp_ns)
        link.transforms.insert(at, T)
        oldest_ns = link.stamps[-1] - self.history_ns
        if link.stamps[0] < oldest_ns:
            kept = bisect.bisect_left(link.stamps, oldest_ns)
            del link.stamps[:kept], link.transforms[:kept]
            self._count -= kept

    def _make_room(self) -> None:
        """Forget the older half of each link that lookups do not need; where all are needed, of all."""
        others = [link for child, link in self._links.items() if self._frames and not self.concerns(child)]
        for link in others or self._links.values():
            half = len(link.stamps) // 2
            del link.stamps[:half], link.transforms[:half]
        self._count = 1 + sum(len(link.stamps) for link in self._links.values())

    def _forget_paths(self) -> None:
        """The tree has changed."""
        self._paths.clear()
        self._between = None

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, its parent and so on to the root."""
        chain = [frame]
        while chain[-1] in self._links:
            chain.append(self._links[chain[-1]].parent)
        return chain

    def _chains(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """The frames from target, and those from source, up to below their common ancestor."""
        path = self._paths.get((target, source))
        if path is None:
            path = self._paths[target, source] = self._find_chains(target, source)
        return path

    def _find_chains(self, target: str, source: str) -> tuple[list[str], list[str]]:
        for frame in (target, source):
            self._check_known(frame)
        up, down = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise TransformDisconnected(
                f"no transform from '{source}' to '{target}': the one hangs below '{down[-1]}', the other "
                f"below '{up[-1]}', and nothing connects these"
            )
        return up[: up.index(common)], down[: down.index(common)]

    def _check_known(self, frame: str) -> None:
        if frame not in self._links and all(link.parent != frame for link in self._links.values()):
            raise TransformDisconnected(
                f"frame '{frame}' is unknown; known: {', '.join(self.frames()) or 'none'}"
            )

    def _compose(self, chain: list[str], stamp_ns: int) -> Array:
        """T_common_first of the chain's first frame; a matrix of its own."""
        if not chain:
            return np.eye(4)
        T = self._at(chain[0], stamp_ns)
        for child in chain[1:]:
            T = self._at(child, stamp_ns) @ T
        return T.copy() if len(chain) == 1 else T

    def _at(self, child: str, stamp_ns: int) -> Array:
        """T_parent_child at a stamp."""
        link = self._links[child]
        if link.static:
            return link.transforms[0]
        at = bisect.bisect_left(link.stamps, stamp_ns)
        if at < len(link.stamps) and link.stamps[at] == stamp_ns:
            return link.transforms[at]
        if at == len(link.stamps):
            raise TransformInFuture(self._message(link, child, stamp_ns, link.stamps[-1], "newest", "later"))
        if at == 0:
            raise TransformInPast(self._message(link, child, stamp_ns, link.stamps[0], "oldest", "earlier"))
        before, after = link.stamps[at - 1], link.stamps[at]
        fraction = (stamp_ns - before) / (after - before)
        return se3.interpolate(link.transforms[at - 1], link.transforms[at], fraction)

    def _message(self, link: _Link, child: str, stamp_ns: int, have_ns: int, which: str, side: str) -> str:
        difference = abs(stamp_ns - have_ns) / SECOND_NS
        return (
            f"transform '{link.parent}' -> '{child}' at {stamp_ns} ns: the {which} is of {have_ns} ns, "
            f"the stamp is {difference:.6f} s {side}"
        )
