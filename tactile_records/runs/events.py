"""What messages tell beside their numbers: phases, refusals, faults, warnings, changes of parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from tactile_base import topics
from tactile_records.bags.contents import Bag
from tactile_records.runs.record import Event

WARNING = 30  # rcl_interfaces/Log.WARN
MODES = ("resting", "moving", "stopping", "fault", "emergency stop")  # of tactile_msgs/ArmStatus


class Telling:
    """Events of messages that come one after the other, decoded.

    Attributes
    ----------
    trouble : node -> what it complains about in /diagnostics
    changed : node -> name -> value, of parameters that were changed
    """

    def __init__(self) -> None:
        self.trouble: dict[str, str] = {}
        self.changed: dict[str, dict[str, Any]] = {}
        self._status: dict[str, Any] = {}
        self._controller: dict[str, Any] = {}

    def take(self, topic: str, message: Any, received_ns: int) -> list[Event]:
        """What a message tells that the ones before it did not; AttributeError where it is another type's."""
        arm, _, name = topic[1:].partition("/")
        if topic in _SHARED:
            found = _SHARED[topic](self, message)
        elif name in _OF_ARM:
            found = _OF_ARM[name](self, arm, message)
        else:
            return []
        return [Event(received_ns, kind, text) for kind, text in found]

    def _diagnostics(self, message: Any) -> Iterator[tuple[str, str]]:
        for status in message.status:
            was = self.trouble.pop(status.name, "")
            if status.level not in (0, b"\x00"):
                self.trouble[status.name] = status.message
                if status.message != was:
                    yield "diagnostics", f"{status.name}: {status.message}"

    def _log(self, message: Any) -> Iterator[tuple[str, str]]:
        if message.level >= WARNING:
            yield "warning", f"{message.name}: {message.msg}"

    def _change(self, message: Any) -> Iterator[tuple[str, str]]:
        for changed in message.changed_parameters:
            value = _value_of(changed.value)
            self.changed.setdefault(message.node, {})[changed.name] = value
            yield "parameter", f"{message.node} {changed.name} = {value}"

    def _stop(self, message: Any) -> Iterator[tuple[str, str]]:
        if message.data:
            yield "stop", "emergency stop of all arms"

    def _arm(self, arm: str, message: Any) -> Iterator[tuple[str, str]]:
        before, self._status[arm] = self._status.get(arm), message
        if before is None:
            return
        if (before.mode, before.reason) != (message.mode, message.reason):
            mode = MODES[message.mode] if message.mode < len(MODES) else str(message.mode)
            yield "arm", f"{arm}: {mode} {message.reason}".rstrip()
        if message.refused and message.refused != before.refused:
            yield "refused", f"{arm}: {message.refused}"

    def _task(self, arm: str, message: Any) -> Iterator[tuple[str, str]]:
        before, self._controller[arm] = self._controller.get(arm), message
        if before is None or (before.phase, before.reason) != (message.phase, message.reason):
            yield "phase", f"{arm}: {message.phase} {message.reason}".rstrip()


_SHARED: dict[str, Callable[[Telling, Any], Iterator[tuple[str, str]]]] = {
    topics.DIAGNOSTICS.name: Telling._diagnostics,
    topics.ROSOUT.name: Telling._log,
    topics.PARAMETER_EVENTS.name: Telling._change,
    topics.ESTOP.name: Telling._stop,
}
_OF_ARM: dict[str, Callable[[Telling, str, Any], Iterator[tuple[str, str]]]] = {
    topics.ARM_STATUS.name: Telling._arm,
    topics.CONTROLLER_STATUS.name: Telling._task,
}


def tells(topic: str) -> bool:
    """Whether messages of a topic tell something beside their numbers."""
    return topic in _SHARED or topic[1:].partition("/")[2] in _OF_ARM


def events_of(bag: Bag, arm: str) -> list[Event]:
    """All events of a recording about an arm and what it shares with others, by time."""
    telling, found = Telling(), []
    for topic in (*_SHARED, *(f"/{arm}/{name}" for name in _OF_ARM)):
        senseless = 0
        for recorded, message in bag.decoded(topic):
            try:
                found += telling.take(topic, message, recorded.received_ns)
            except (AttributeError, TypeError):
                senseless += 1
        if senseless:
            bag.problems.append(f"{topic}: {senseless} messages are of another type: they tell nothing")
    return sorted(found)


def _value_of(value: Any) -> Any:
    """What a rcl_interfaces/ParameterValue holds."""
    names = (
        "", "bool_value", "integer_value", "double_value", "string_value", "byte_array_value",
        "bool_array_value", "integer_array_value", "double_array_value", "string_array_value",
    )  # fmt: skip
    name = names[value.type] if value.type < len(names) else ""
    found = getattr(value, name) if name else None
    return found.tolist() if isinstance(found, np.ndarray) else found
