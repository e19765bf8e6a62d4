"""ArmAttention: does the arm follow who asks it to, and if not, why?"""

from __future__ import annotations

import time

from tactile_drivers.ownership import REST_FIRST
from tactile_msgs.msg import ArmStatus

TROUBLE = {ArmStatus.FAULT: "fault", ArmStatus.ESTOP: "emergency stop"}
REFUSED = 1.0  # s, for which an arm, at rest by then, refuses all that it is told until that is trouble
NONE = -1.0  # what an arm that has no command in force says of its age
UNHEARD = 1.0  # s, for which none of what it is told has come to it
HELD_UP = 0.5  # s between two questions: who asks was held up, and so were the answers
SILENT = 1.5  # s without a status: longer than inputs may be missing, of which the reason says more


class ArmAttention:
    """Takes `arm/status` for one commander, whose name is the source of its commands.

    Attributes
    ----------
    trouble : str
        Why the arm does not follow it; '' if it does, as far as is known.
    wants_rest : bool
        Whether the arm waits for a twist of zero from it, as after a silence of half a second.
    """

    def __init__(self, source: str) -> None:
        self.source, self.trouble, self.wants_rest = source, "", False
        self._seen: float | None = None
        self._asked = 0.0
        self._since: dict[str, float] = {}

    def see(self, status: ArmStatus, commands: bool) -> None:
        """Take a status; `commands`: whether twists are sent all the time now."""
        self.trouble, self._seen = self._trouble(status, commands), time.monotonic()
        self.wants_rest = status.refused_source == self.source and status.refused == REST_FIRST

    def silence(self) -> str:
        """How long an arm that used to report has not; '' if it does. To be called all the time."""
        now = time.monotonic()
        if self._seen is not None and now - self._asked > HELD_UP:
            self._seen = now
        self._asked = now
        age = 0.0 if self._seen is None else now - self._seen
        return f"the arm's node has said nothing for {age:.1f} s: is it active?" if age > SILENT else ""

    def _trouble(self, status: ArmStatus, commands: bool) -> str:
        if status.mode in TROUBLE:
            return f"the arm is in {TROUBLE[status.mode]}: {status.reason}"
        if status.owner not in ("", self.source):
            return f"the arm is commanded by {status.owner}"
        if self._lasts("refused", status.refused_source == self.source, REFUSED):
            return f"the arm refuses its commands: {status.refused}"
        limit = UNHEARD
        none = status.command_age == NONE
        unheard = commands and not status.refused and (none or status.command_age > limit)
        if self._lasts("unheard", unheard, limit):
            return f"the arm has heard no command for {limit:g} s: they do not arrive"
        return ""

    def _lasts(self, what: str, holds: bool, limit: float) -> bool:
        """Whether something has held for that long (s)."""
        if not holds:
            self._since.pop(what, None)
            return False
        return time.monotonic() - self._since.setdefault(what, time.monotonic()) > limit
