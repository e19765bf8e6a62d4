"""What a node says about itself in /diagnostics: counters, ages of inputs and complaints."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

FIRST_MESSAGE_GRACE = 3.0  # s; nodes find each other and other nodes start within this

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@dataclass
class InputWatch:
    """Age of one input against its limit; the clock starts when the node becomes active.

    Ages are measured on the steady clock from arrival, so that a jump of the system's time cannot hide
    silence.
    """

    name: str
    limit: float  # s; 0 for none
    last: float = field(default_factory=time.monotonic)
    count: int = 0

    def seen(self) -> None:
        """A message arrived now."""
        self.last = time.monotonic()
        self.count += 1

    def excuse(self) -> None:
        """There was nothing to send so far: silence counts from now."""
        self.last = time.monotonic()

    def restart(self) -> None:
        """The node became active: silence counts from now."""
        self.last = time.monotonic()
        self.count = 0

    @property
    def age(self) -> float:
        """Seconds since the last message, or since `restart`."""
        return time.monotonic() - self.last

    def complaint(self) -> str:
        """'' or which input is silent, for how long, and the limit."""
        age = self.age
        limit = self.limit if self.count else max(self.limit, FIRST_MESSAGE_GRACE)
        if self.limit <= 0.0 or age <= limit:
            return ""
        what = "no message for" if self.count else "no message yet in"
        return f"{self.name}: {what} {age:.2f} s (limit {self.limit:.2f} s)"


class Diagnostics:
    """Collects what is worth telling and turns it into a DiagnosticArray.

    A complaint lasts for one publication, a fault until it is cleared.
    """

    def __init__(self, name: str, hardware_id: str) -> None:
        self._name, self._hardware_id = name, hardware_id
        self.counters: Counter[str] = Counter()
        self.values: dict[str, str] = {}
        self.inputs: dict[str, InputWatch] = {}
        self.fault = ""
        self._complaints: dict[str, str] = {}
        self._reported: set[str] = set()

    def watch(self, name: str, limit: float) -> InputWatch:
        """Watch the age of an input from now on (limit in s, 0 for none)."""
        self.inputs[name] = InputWatch(name, limit)
        return self.inputs[name]

    def complain(self, key: str, message: str) -> None:
        """Say this at the next publication, as a warning; the newest complaint of one key counts."""
        self._complaints[key] = message

    def silent_inputs(self) -> list[str]:
        """Complaints about inputs that are older than their limit."""
        return [complaint for watch in self.inputs.values() if (complaint := watch.complaint())]

    def has_news(self, active: bool) -> bool:
        """Whether there is something to complain about that the last report did not say."""
        return not self._subjects(active) <= self._reported

    def _subjects(self, active: bool) -> set[str]:
        """What is complained about now."""
        silent = {watch.name for watch in self.inputs.values() if watch.complaint()} if active else set()
        return {*self._complaints, *silent, *(["fault"] if self.fault else [])}

    def message(self, stamp: object, state: str, active: bool) -> DiagnosticArray:
        """The report as of now; takes the complaints with it."""
        self._reported = self._subjects(active)
        complaints = list(self._complaints.values()) + (self.silent_inputs() if active else [])
        self._complaints.clear()
        status = DiagnosticStatus(name=self._name, hardware_id=self._hardware_id, values=self._values(state))
        status.level = ERROR if self.fault else WARN if complaints else OK
        status.message = self.fault or "; ".join(complaints) or state
        array = DiagnosticArray(status=[status])
        array.header.stamp = stamp
        return array

    def _values(self, state: str) -> list[KeyValue]:
        values = {"state": state, **self.values}
        values |= {name: str(count) for name, count in sorted(self.counters.items())}
        for watch in self.inputs.values():
            values[f"{watch.name} messages"] = str(watch.count)
            values[f"{watch.name} age (s)"] = f"{watch.age:.3f}"
            values[f"{watch.name} age limit (s)"] = f"{watch.limit:g}"
        return [KeyValue(key=key, value=value) for key, value in values.items()]
