"""Transforms between named frames over time, as a plain library: bounded history, interpolation, lookups by
stamp.

What a lookup cannot answer exactly is an error that names the stamps it has; the latest transform never
stands in for the one that was asked for.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import SECOND_NS
from tactile_filter import se3

Array = NDArray[np.float64]


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

    Notes
    -----
    It is the only store of transforms in this project, so that live nodes, replayed bags and offline runs
    agree to the bit. Where tf2's differs: tf2 moves the translation between two stamps along a straight line,
    this one along the screw motion (the same rotation, and at most |d| / 2 tan(angle / 4) beside tf2's
    translation, d being its difference); tf2 takes a stamp of 0 for "the newest", which here is `newest`;
    tf2 keeps what a frame was to its former parent.
    """

    def __init__(self, history_ns: int = 10 * SECOND_NS, jump_ns: int = SECOND_NS) -> None:
        if history_ns <= 0 or jump_ns < 0:
            raise ValueError(f"history_ns = {history_ns}, jump_ns = {jump_ns}: must be positive")
        self.history_ns = history_ns
        self.jump_ns = jump_ns
        self._links: dict[str, _Link] = {}
        self._paths: dict[tuple[str, str], tuple[list[str], list[str]]] = {}  # of this tree, see _chains

    def set_transform(
        self, parent: str, child: str, stamp_ns: int, T_parent_child: ArrayLike, *, static: bool = False
    ) -> int:
        """Add a transform (4, 4); its rotation may be off orthonormal by `se3.ROTATION_TOLERANCE`.

        Returns
        -------
        int
            By how much (ns) time had jumped back, as the stamp showed; the history was then cleared. Else 0.

        Raises
        ------
        ValueError
            If the matrix is no pose, a name is empty, or the link would close a loop.
        """
        T = self._checked(parent, child, T_parent_child)
        link = self._links.get(child)
        jump_ns = 0 if link is None or static else self._jump(link, int(stamp_ns))
        if jump_ns:
            self.clear()
            link = None
        if link is None or link.parent != parent or link.static != static:
            link = self._links[child] = _Link(parent, static)
            self._paths.clear()
        if static:
            link.stamps, link.transforms = [int(stamp_ns)], [T]
        else:
            self._insert(link, int(stamp_ns), T)
        return jump_ns

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

    def clear(self) -> None:
        """Forget all but the static transforms."""
        self._links = {child: link for child, link in self._links.items() if link.static}
        self._paths.clear()

    def frames(self) -> list[str]:
        """The names of all frames, sorted."""
        return sorted({name for child, link in self._links.items() for name in (child, link.parent)})

    def _checked(self, parent: str, child: str, T_parent_child: ArrayLike) -> Array:
        if not parent or not child:
            raise ValueError(f"transform '{parent}' -> '{child}': a frame's name must not be empty")
        if parent == child or child in self._ancestors(parent):
            raise ValueError(f"transform '{parent}' -> '{child}': would close a loop")
        try:
            return se3.orthonormalized(T_parent_child)
        except ValueError as error:
            raise ValueError(f"transform '{parent}' -> '{child}': {error}") from error

    def _jump(self, link: _Link, stamp_ns: int) -> int:
        behind_ns = link.stamps[-1] - stamp_ns
        return behind_ns if behind_ns > self.jump_ns and not link.static else 0

    def _insert(self, link: _Link, stamp_ns: int, T: Array) -> None:
        at = bisect.bisect_left(link.stamps, stamp_ns)
        if at < len(link.stamps) and link.stamps[at] == stamp_ns:
            link.transforms[at] = T
            return
        link.stamps.insert(at, stamp_ns)
        link.transforms.insert(at, T)
        kept = bisect.bisect_left(link.stamps, link.stamps[-1] - self.history_ns)
        if kept:
            del link.stamps[:kept], link.transforms[:kept]

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
