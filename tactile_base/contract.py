"""What a plug-in has to offer, as far as its code shows it: it is looked at when it is loaded."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from tactile_base.raised import defined_in
from tactile_base.settings import SettingGroups, Settings


@dataclass(frozen=True)
class Contract:
    """What the class of a plug-in is, is made from, and does.

    Attributes
    ----------
    made_from : what it is called with, in this order; None: it is no class, and never called
    methods : method -> what it is called with, in this order
    settings : whether it has a `settings_class`
    attributes : what else it has, for all of its objects
    base : gives what it has to be a subclass of; or an object of, where it is no class
    also : what else is wrong with one that has all of this
    """

    made_from: tuple[str, ...] | None = ()
    methods: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    settings: bool = False
    attributes: tuple[str, ...] = ()
    base: Callable[[], type] | None = None
    also: Callable[[Any], Iterator[str]] = lambda found: iter(())

    def objections(self, found: Any) -> list[str]:
        """What is wrong with a plug-in, with what would be right; each with its place where that is known."""
        objections = list(self._objections(found)) or [(text, found) for text in self.also(found)]
        return [f"{text}{_place(at)}" for text, at in objections]

    def _objections(self, found: Any) -> Iterator[tuple[str, Any]]:
        base = None if self.base is None else self.base()
        if self.made_from is None:
            if base is not None and not isinstance(found, base):
                yield f"is a {type(found).__name__}, must be a {base.__name__}", found
            return
        if not callable(found):
            yield f"is a {type(found).__name__}, must be a class", found
            return
        if base is not None and not (inspect.isclass(found) and issubclass(found, base)):
            yield f"must be a subclass of {base.__name__}", found
        if self.settings:
            kind = getattr(found, "settings_class", None)
            if not (inspect.isclass(kind) and issubclass(kind, Settings | SettingGroups)):
                yield "has no settings_class, must be a subclass of Settings (tactile_base.settings)", found
        for name in self.attributes:
            if not hasattr(found, name):
                yield f"has no {name}", found
        if inspect.isabstract(found):
            lacks = ", ".join(sorted(found.__abstractmethods__))
            yield f"has no {lacks}", found
        yield from _call(found, getattr(found, "__name__", "it"), self.made_from, 0)
        if inspect.isclass(found):
            for name, given in self.methods.items():
                yield from _method(found, name, given)


def _method(found: type, name: str, given: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    method = getattr(found, name, None)
    if not callable(method):
        yield f"has no method {name}({', '.join(given)})", found
        return
    bound = isinstance(inspect.getattr_static(found, name), staticmethod | classmethod)
    yield from _call(method, name, given, 0 if bound else 1)


def _call(function: Any, name: str, given: tuple[str, ...], selves: int) -> Iterator[tuple[str, Any]]:
    """Whether it can be called with so many things, in the order in which they are given."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of C: nobody knows
        return
    try:
        signature.bind(*[None] * (selves + len(given)))
    except TypeError as error:
        taken = [str(parameter) for parameter in list(signature.parameters.values())[selves:]]
        yield f"{name}({', '.join(taken)}) is called as {name}({', '.join(given)}): {error}", function


def _place(found: Any) -> str:
    """File and line, in brackets; empty where there is no source."""
    try:
        return f" ({inspect.getsourcefile(found)}:{inspect.getsourcelines(found)[1]})"
    except (OSError, TypeError):
        at = defined_in(found) if inspect.isclass(found) else ""
        return f" ({at})" if at else ""
