"""The filter's settings in a recording: those at its start, and their changes while it ran."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings
from tactile_base.stamps import SECOND_NS
from tactile_base.topics import PARAMETER_EVENTS
from tactile_filter.bayes_filter import BeliefFlag, FilterSettings
from tactile_records.bags.contents import Recorded, noted
from tactile_records.bags.message_columns import stamps_ns
from tactile_records.bags.reader import Bag
from tactile_wire.cdr import Layout, layout_of
from tactile_wire.errors import MessageError

Array = NDArray[Any]
S = TypeVar("S", bound=Settings)

REINITIALIZED, INVALID = int(BeliefFlag.REINITIALIZED), int(BeliefFlag.INVALID)
MEASUREMENT_FUSED = int(BeliefFlag.MEASUREMENT_FUSED)
NAMES = tuple(item.name for item in dataclasses.fields(FilterSettings))
_VALUES = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}  # of ParameterType


@dataclasses.dataclass(frozen=True)
class Change:
    """Settings that were changed at runtime: when (ns), and names with values."""

    stamp_ns: int
    values: Mapping[str, Any]

    def without(self, names: Collection[str]) -> Change:
        """A copy without some of the names."""
        return Change(self.stamp_ns, {n: v for n, v in self.values.items() if n not in names})


def recorded_settings(note: Mapping[str, str], arm: str) -> tuple[dict[str, Any], list[str]]:
    """Settings with which the filter of a recording started, and names among them that are none now.

    Empty where the recording does not say.
    """
    parameters = noted(note, "parameters").get(f"/{arm}/filter", {})
    own = {name: value for name, value in parameters.items() if "." not in name}
    return {n: v for n, v in own.items() if n in NAMES}, sorted(n for n in own if n not in NAMES)


def recorded_group(note: Mapping[str, str], arm: str, prefix: str, kind: type[S]) -> S:
    """Settings of the filter of a recording that have a prefix; the defaults where they are not recorded."""
    parameters = noted(note, "parameters").get(f"/{arm}/filter", {})
    own = {n.removeprefix(prefix): v for n, v in parameters.items() if n.startswith(prefix)}
    return kind.from_mapping(own)


def recorded_changes(bag: Bag, arm: str) -> list[Change]:
    """Changes of the filter's settings while it ran, by time; empty where the bag does not hold them."""
    node = f"/{arm}/filter"
    # nearly all of a bag's events are of other nodes
    messages = [m for m in bag.messages if m.topic == PARAMETER_EVENTS.name and node.encode() in m.data]
    return sorted(_changes(bag, messages, node), key=lambda change: change.stamp_ns)


def commanded_resets(stamps_ns: Array, flags: Array, nis: Array, max_prediction_age: float) -> frozenset[int]:
    """Stamps (ns) of beliefs that live filters started anew because they were asked to.

    A belief that starts anew says so. Where one stood before it that was neither too old nor refuted by
    measurements in a row, only `~/reset` can have been the reason.
    """
    found, fused_ns = set(), None
    for stamp_ns, flag, innovation in zip(stamps_ns.tolist(), flags.tolist(), nis.tolist(), strict=True):
        started = flag & REINITIALIZED and math.isnan(innovation)
        if started and fused_ns is not None and 0 < stamp_ns - fused_ns <= max_prediction_age * SECOND_NS:
            found.add(stamp_ns)
        if flag & INVALID:
            fused_ns = None
        elif flag & MEASUREMENT_FUSED:
            fused_ns = stamp_ns
    return frozenset(found)


def _changes(bag: Bag, messages: Sequence[Recorded], node: str) -> list[Change]:
    found, damaged = [], []
    for message in messages:
        try:
            layout = layout_of(bag.typestore(message.type).fielddefs, message.type, message.data)
            change = _change(layout, message.data, node)
        except (MessageError, KeyError, ValueError) as error:
            damaged.append(f"at {message.received_ns} ns: {error}")
        else:
            found += [change] if change is not None and change.values else []
    if damaged:
        bag.problems.append(
            f"{PARAMETER_EVENTS.name}: {len(damaged)} messages cannot be decoded, the first {damaged[0]}"
        )
    return found


def _change(layout: Layout, data: bytes, node: str) -> Change | None:
    """A node's changed settings, of one message; None for another node's. Raises KeyError or ValueError."""
    if layout.texts["node"] != node:
        return None
    numbers = np.frombuffer(data, layout.dtype, 1)
    values = {}
    for index in range(layout.lengths["changed_parameters"]):
        prefix = f"changed_parameters.{index}"
        name, kind = layout.texts[f"{prefix}.name"], _VALUES.get(int(numbers[f"{prefix}.value.type"][0]))
        if name in NAMES and kind is not None:
            field = f"{prefix}.value.{kind}"
            values[name] = layout.texts[field] if field in layout.texts else numbers[field][0].item()
    return Change(int(stamps_ns(numbers, "stamp")[0]), values)
