"""Ownership: who may command an arm. One at a time, and whoever is new or was silent asks for rest first."""

from __future__ import annotations

from typing import NamedTuple

from tactile_base.stamps import SECOND_NS

REST_FIRST = "the arm waits for a twist of zero, as from every new commander and after every stop"


class Commander(NamedTuple):
    """Who sends a command.

    Attributes
    ----------
    name : str
        What it calls itself; anybody can repeat that, since it is told to everybody.
    session : int
        A number that it has drawn by itself, and that nobody tells; 0: none.
    """

    name: str
    session: int = 0


class Ownership:
    """Who commands an arm, and since when.

    Attributes
    ----------
    waits_for_rest : bool
        Whether nothing but a twist of zero is followed now.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout_ns = round(timeout * SECOND_NS)
        self.leave()

    def leave(self) -> None:
        """The arm is nobody's."""
        self._who: Commander | None = None
        self._heard_ns, self._sequence = 0, 0
        self.waits_for_rest = True

    @property
    def owner(self) -> str:
        """The name of whoever commands the arm; empty for nobody."""
        return self._who.name if self._who is not None else ""

    def silent(self, now_ns: int) -> bool:
        """Whether whoever owns the arm has said nothing for so long that it is nobody's any more."""
        return now_ns - self._heard_ns > self._timeout_ns

    def is_owner(self, who: Commander) -> bool:
        """Whether that is who commands the arm."""
        return self._who == who

    def objection(self, now_ns: int, who: Commander, sequence: int = 0) -> str:
        """Why the arm does not listen to somebody now; '' if it does.

        Two who send as one, each with numbers of its own (`sequence`, 0: none), cannot be told apart: then
        nobody is followed before a twist of zero.
        """
        if self._who is None or self.silent(now_ns):
            return ""
        if self._who == who:
            if not 0 < sequence <= self._sequence:
                return ""
            self.waits_for_rest = True
            return f"two commanders send as {who.name}: number {sequence} came after {self._sequence}"
        if who.name == self._who.name:
            return f"somebody else commands the arm as {who.name}, too: names have to differ"
        return f"the arm is commanded by {self._who.name}, not by {who.name or 'somebody without a name'}"

    def hear(self, now_ns: int, who: Commander, sequence: int, moves: bool) -> str:
        """Take a command of somebody to whom there is no objection; why it is not followed, '' if it is.

        A commander is heard of from its first twist of zero on: one that never rests never has the arm.
        """
        new = self._who != who
        if new or self.silent(now_ns):
            self.waits_for_rest = True
        if self.waits_for_rest and moves:
            if not new:
                self._heard_ns, self._sequence = now_ns, sequence
            return REST_FIRST
        self._who, self._heard_ns, self._sequence = who, now_ns, sequence
        self.waits_for_rest = False
        return ""
