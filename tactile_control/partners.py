"""Partners: which of the arms that work on the same object does not go on, so that this one rests as well.

Where a task waits for another arm's contact (`after` of a task file) two arms hold one object, and each of
them minds the other: the one that waits minds the one it waits for all the time; the latter minds the former
once its work has begun, since before that it does not press yet. Trouble is an arm's own: one that rests
because of another one is in none, so that what comes back as an echo holds nobody. The same over ROS and
without::

    partners = Partners(awaited=["follower"], age_limit=0.2)
    partners.hear("follower", now, word)             # a `Command`, or what a controller's status says
    task.partner = partners.trouble(now)
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from tactile_control.phases import Command, StampedPose


@dataclass(frozen=True)
class Word:
    """What an arm's task says of itself to those who work together with it, as a `Command` has it.

    Attributes
    ----------
    over : whether it has no goal, or its goal has come to its end
    at_work : whether it has come to its own phase, and is not over
    trouble : why it does not go on with what it is for, whatever others do; '' where it does
    hold : where it holds the object, in the world (`Command.hold`); None: not known
    """

    over: bool
    at_work: bool
    trouble: str
    hold: StampedPose | None = None


@dataclass
class _Partner:
    """Whether an arm is awaited and is monitored now, its last word, and when that was heard (s)."""

    awaited: bool
    monitored: bool
    word: Word | Command | None = None
    heard: float = -math.inf

    def hear(self, now: float, word: Word | Command) -> None:
        self.word, self.heard = word, now
        if not self.awaited:  # one that has failed goes on to count
            self.monitored = word.at_work or (self.monitored and bool(word.trouble))

    def trouble(self, now: float, age_limit: float) -> str:
        if not self.monitored:
            return ""
        if self.word is None or now - self.heard > age_limit:
            return "nothing is heard of its controller"
        return self.word.trouble or ("its task is over" if self.awaited and self.word.over else "")


class Partners:
    """See the module's text.

    Parameters
    ----------
    awaited : iterable of str
        Arms whose work this one's task waits for.
    waiting : iterable of str
        Arms whose task waits for this one's work.
    age_limit : float
        Silence that counts as trouble, s.

    Attributes
    ----------
    arms : tuple of str
        All of them.
    """

    def __init__(
        self, awaited: Iterable[str] = (), waiting: Iterable[str] = (), age_limit: float = math.inf
    ) -> None:
        self._limit = age_limit
        self._partners = {arm: _Partner(awaited=False, monitored=False) for arm in waiting}
        self._partners |= {arm: _Partner(awaited=True, monitored=True) for arm in awaited}
        self.arms = tuple(self._partners)

    def begin(self) -> None:
        """A goal of this arm begins: how the work of those that wait for it ended before is over with."""
        for partner in self._partners.values():
            partner.monitored = partner.awaited

    def hear(self, arm: str, now: float, word: Word | Command) -> None:
        """Take what an arm says now (s); it is of no concern unless it is one of `arms`."""
        if arm in self._partners:
            self._partners[arm].hear(now, word)

    @property
    def hold(self) -> StampedPose | None:
        """Where the partner holds the object now; None where that is not known, or several do."""
        words = [partner.word for partner in self._partners.values() if partner.word is not None]
        holds = [word.hold for word in words if word.hold is not None]
        return holds[0] if len(holds) == 1 else None

    def trouble(self, now: float) -> str:
        """Who of them does not go on, and why; '' where all do."""
        words = {arm: partner.trouble(now, self._limit) for arm, partner in self._partners.items()}
        return "; ".join(f"{arm}: {word}" for arm, word in words.items() if word)
