"""Which settings of a run are not the declared defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from tactile_control.tasks import TASKS
from tactile_filter.filter_settings import FilterSettings
from tactile_records.runs.record import RunRecord


class Given(NamedTuple):
    """A setting of a node, and its default; None where nothing declares one."""

    node: str
    name: str
    value: Any
    default: Any


def given(parameters: Mapping[str, Mapping[str, Any]], arm: str) -> dict[str, dict[str, Any]]:
    """`RunRecord.settings` of an arm, from the parameters of all nodes of a graph by their full names."""
    found = {}
    for node, values in parameters.items():
        namespace, _, name = node.rpartition("/")
        if namespace in ("", f"/{arm}"):
            found[name] = dict(values)
    return found


def differing(record: RunRecord) -> Iterator[Given]:
    """The settings of a run that are not their defaults, as they are declared now, or have none here."""
    for given in settings_of(record.settings, record.task):
        if given.default is None or plain(given.value) != plain(given.default):
            yield given


def settings_of(settings: Mapping[str, Mapping[str, Any]], task: str) -> Iterator[Given]:
    """All settings of `RunRecord.settings`, without what nodes are told of their cell."""
    for node, values in settings.items():
        known = _defaults(node, task)
        for name, value in values.items():
            if known is None or name in known:
                yield Given(node, name, value, (known or {}).get(name))


def _defaults(node: str, task: str) -> dict[str, Any] | None:
    """None for a node without declared defaults here."""
    if node == "filter":
        return dataclasses.asdict(FilterSettings())
    if node == "controller" and task in TASKS.names():
        return TASKS.load(task).settings_class().dotted()
    return None


def plain(value: Any) -> Any:
    """The value as JSON holds it, so that what was kept in a file compares with what was not."""
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
