"""Registries: what plugs in by name, from this package or from somebody else's by entry points.

A registry knows where its entries lie and loads one when it is asked for, so that naming a shape in a scene
file imports nothing that the others need::

    SHAPES = Registry("shape", "tactile_servoing.shapes", {"plane": "tactile_drivers.shapes.plane:Plane"})
    shape = SHAPES.load("plane")

Another package adds an entry in its own metadata, and nothing here has to change::

    [project.entry-points."tactile_servoing.shapes"]
    my_shape = "my_package.my_shape:MyShape"
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from tactile_base.settings import SettingError, unknown_name

T = TypeVar("T")


class Registry(Generic[T]):
    """Names, and where what they stand for can be imported from.

    Parameters
    ----------
    kind : str
        What an entry is, for messages.
    group : str
        Entry-point group of other packages' entries.
    builtin : mapping
        Name -> "module:attribute" of this package's entries; another package cannot replace them.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str]) -> None:
        self.kind, self.group = kind, group
        self._builtin = dict(builtin)

    def names(self) -> tuple[str, ...]:
        """All names that there are, this package's first."""
        others = {point.name for point in entry_points(group=self.group)} - set(self._builtin)
        return (*self._builtin, *sorted(others))

    def load(self, name: str) -> T:
        """What the name stands for.

        Raises
        ------
        SettingError
            With the names that there are, or with what keeps an entry from being imported.
        """
        place = self._builtin.get(name) or self._elsewhere(name)
        module, _, attribute = place.partition(":")
        try:
            found: Any = importlib.import_module(module)
            for part in attribute.split("."):
                found = getattr(found, part)
        except (ImportError, AttributeError) as error:
            raise SettingError(f"{self.kind} '{name}': {place} cannot be loaded: {error}") from error
        return found

    def _elsewhere(self, name: str) -> str:
        for point in entry_points(group=self.group, name=name):
            return point.value
        raise SettingError(f"{self.kind}: {unknown_name(name, list(self.names()))}")
