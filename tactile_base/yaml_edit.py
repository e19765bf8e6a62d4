"""Values set in the text of a YAML file, with all else in it, comments too, as its author wrote it.

Not by a round trip through ruamel.yaml: that joins lists over several lines, and so loses the comments in
them, writes `null` as nothing, and moves aligned values and their comments (test/base/test_yaml_edit.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml


class YamlEditError(ValueError):
    """A text in which the place is not there, or is written in a way that cannot be edited."""


def with_values(text: str, keys: Sequence[str], values: Mapping[str, Any]) -> str:
    """The text with `values` set in the mapping that the keys lead to.

    A key that is there gets the new value in its place, others are added to the mapping. The mapping itself
    may be missing, what is around it not.

    Raises `YamlEditError` if one of the keys leads nowhere, or the mapping around a missing one is written in
    braces.
    """
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise YamlEditError(f"not valid YAML: {error}") from error
    for depth, key in enumerate(keys):
        found = _value(_mapping(node, keys[:depth]), key)
        if found is None and depth == len(keys) - 1:
            return with_values(text, keys[:-1], {key: dict(values)})
        node = found
    mapping = _mapping(node, keys)
    if mapping.flow_style:
        return _in_braces(text, mapping, values)
    lines = text.splitlines()
    indent = " " * mapping.start_mark.column
    for key, value in values.items():
        written = [indent + line for line in _lines(key, value)]
        pair = next((pair for pair in mapping.value if pair[0].value == key), None)
        first = pair[0].start_mark.line if pair else mapping.start_mark.line
        last = _last_line(pair[1]) + 1 if pair else first
        return with_values(
            "\n".join([*lines[:first], *written, *lines[last:]]) + "\n",
            keys,
            {name: other for name, other in values.items() if name != key},
        )
    return text


def _lines(key: str, value: Any) -> list[str]:
    """A value in lines; a mapping of plain values in braces."""
    if isinstance(value, Mapping) and any(isinstance(part, Mapping) for part in value.values()):
        return [f"{key}:", *(f"  {line}" for name, part in value.items() for line in _lines(name, part))]
    return [f"{key}: {_braces([value])[1:-1]}"]


def _braces(value: Any) -> str:
    return str(yaml.safe_dump(value, sort_keys=False, default_flow_style=True, width=10_000)).strip()


def _in_braces(text: str, mapping: yaml.MappingNode, values: Mapping[str, Any]) -> str:
    inside = yaml.SafeLoader("").construct_document(mapping) | dict(values)
    return text[: mapping.start_mark.index] + _braces(inside) + text[mapping.end_mark.index :]


def _mapping(node: yaml.Node | None, keys: Sequence[str]) -> yaml.MappingNode:
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise YamlEditError(f"{'.'.join(keys) or 'the file'}: must hold names and values")
    return node


def _value(mapping: yaml.MappingNode, key: str) -> yaml.Node | None:
    return next((value for name, value in mapping.value if name.value == key), None)


def _last_line(node: yaml.Node) -> int:
    """The last line of a value, from 0; what follows a block, as comments, is not of it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _last_line(last[1] if isinstance(last, tuple) else last)
    mark = node.end_mark
    return mark.line - 1 if mark.column == 0 and mark.line > node.start_mark.line else mark.line
