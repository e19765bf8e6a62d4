"""Ownership: who may command an arm. One at a time, and whoever is new, or was silent, asks for rest first."""

from __future__ import annotations

from collections.abc import Hashable

from tactile_base.stamps import SECOND_NS

class Ownership:
    """Who commands an arm, and since when.

    A commander is known by a name, which it says itself and anybody can repeat, and by an identity that is
    given to it from outside, as the middleware's of its publisher; None where there is none.

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
        self._who: tuple[str, Hashable] | None = None
        self._heard_ns = 0
        self.waits_for_rest = True

    @property
    def owner(self) -> str:
        """The name of whoever commands the arm; empty for nobody."""
        return self._who[0] if self._who is not None else ""

    def silent(self, now_ns: int) -> bool:
        """Whether whoever owns the arm has said nothing for so long that it is nobody's any more."""
        return now_ns - self._heard_ns > self._timeout_ns

    def is_owner(self, name: str, identity: Hashable) -> bool:
        """Whether that is who commands the arm."""
        return self._who == (name, identity)

    def objection(self, now_ns: int, name: str, identity: Hashable) -> str:
        """Why the arm does not listen to somebody now; '' if it does."""
        if self._who is None or self.silent(now_ns) or self.is_owner(name, identity):
            return ""
        if name == self.owner:
            return f"somebody else commands the arm as {name}, too: names have to differ"
        return f"the arm is commanded by {self.owner}, not by {name or 'somebody without a name'}"

    def hear(self, now_ns: int, name: str, identity: Hashable, moves: bool) -> str:
        """Take a command of somebody to whom there is no objection; why it is not followed, '' if it is.

        A commander is heard of from its first twist of zero on: one that never rests never has the arm.
        """
        new = not self.is_owner(name, identity)
        if new or self.silent(now_ns):
            self.waits_for_rest = True
        if self.waits_for_rest and moves:
            if not new:
                self._heard_ns = now_ns
            return "the arm waits for a twist of zero, as from every new commander and after every stop"
        self._who, self._heard_ns = (name, identity), now_ns
        self.waits_for_rest = False
        return ""
