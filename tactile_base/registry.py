"""Registries: what plugs in by name, from this package or from somebody else's by entry points.

A registry knows where its entries lie and loads one when it is asked for, so that naming a shape in a scene
file imports nothing that the others need::

    SHAPES = Registry("shape", "tactile_servoing.shapes", {"plane": "tactile_scene.shapes.plane:Plane"})
    shape = SHAPES.load("plane")

Another package adds an entry in its own metadata, and nothing here has to change::

    [project.entry-points."tactile_servoing.shapes"]
    my_shape = "my_package.my_shape:MyShape"
"""

from __future__ import annotations

import functools
import importlib
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from tactile_base.contract import Contract
from tactile_base.raised import in_short, note_plugin, raised_in_plugin
from tactile_base.settings import SettingError, unknown_name

T = TypeVar("T")
OURS = "tactile_servoing"


def _changed_ns(folder: str) -> int:
    """When something was last installed into a folder of packages, or removed."""
    try:
        return os.stat(folder or os.curdir).st_mtime_ns
    except OSError:  # a name of sys.path that is not there
        return 0


@functools.lru_cache(maxsize=4)
def _entry_points(folders: tuple[tuple[str, int], ...]) -> Any:
    """Those of all groups; a search reads the metadata of every package, which takes 10 ms and more."""
    return entry_points()


@dataclass(frozen=True)
class Entry:
    """One thing that plugs in.

    Attributes
    ----------
    name : as users say it
    place : "module:attribute"
    package : the distribution that brings it
    shadowed_by : the one whose entry of that name is used in place of this; '' for none
    """

    name: str
    place: str
    package: str
    shadowed_by: str = ""


class Registry(Generic[T]):
    """Names, and where what they stand for can be imported from.

    Parameters
    ----------
    kind : what an entry is, for messages
    group : entry-point group of other packages' entries
    builtin : name -> "module:attribute" of this package's entries; another package cannot replace them
    contract : what entries have to offer; those of other packages are held against it when they are loaded
    """

    def __init__(
        self, kind: str, group: str, builtin: Mapping[str, str], contract: Contract | None = None
    ) -> None:
        self.kind, self.group = kind, group
        self.contract = contract or Contract()
        self._builtin = dict(builtin)

    def entries(self) -> list[Entry]:
        """All that there is, this package's first; of one name the first is used, and shadows the others."""
        own = [Entry(name, place, OURS) for name, place in self._builtin.items()]
        others = [Entry(p.name, p.value, p.dist.name if p.dist else "?") for p in self._points()]
        found: dict[str, Entry] = {}
        listed = []
        for entry in own + others:
            first = found.setdefault(entry.name, entry)
            listed.append(entry if first is entry else replace(entry, shadowed_by=first.package))
        return listed

    def names(self) -> tuple[str, ...]:
        """All names that there are, this package's first."""
        others = {point.name for point in self._points()} - set(self._builtin)
        return (*self._builtin, *sorted(others))

    def load(self, name: str) -> T:
        """What the name stands for.

        Raises `SettingError` with the names that there are, or with what keeps an entry from being imported
        or used, and where.
        """
        if name in self._builtin:
            return self.load_place(self._builtin[name], name)
        place = next((point.value for point in self._points() if point.name == name), None)
        if place is None:
            raise SettingError(f"{self.kind}: {unknown_name(name, list(self.names()))}")
        found = self.load_place(place, name)
        if objections := self.contract.objections(found):
            raise SettingError(f"{self.kind} '{name}': {place} {'; '.join(objections)}")
        return found

    def load_place(self, place: str, name: str) -> T:
        """What lies at "module:attribute", unchecked; raises `SettingError` for `name` as `load` does."""
        module, _, attribute = place.partition(":")
        try:
            found: Any = importlib.import_module(module)
            for part in attribute.split("."):
                found = getattr(found, part)
        except Exception as error:  # somebody else's module may raise anything
            at = raised_in_plugin(error)
            why = f"{in_short(error)} ({at})" if at else in_short(error)
            raise SettingError(f"{self.kind} '{name}': {place} cannot be loaded: {why}") from error
        if place not in self._builtin.values():
            note_plugin(found, f"{self.kind} '{name}'")
        return found

    def _points(self) -> list[EntryPoint]:
        folders = tuple((folder, _changed_ns(folder)) for folder in sys.path)
        found = _entry_points(folders).select(group=self.group)
        return sorted(found, key=lambda point: (point.name, point.value))
