"""Errors of code that plugs in: which plug-in it is, and where in its files, beside what an error says.

A registry notes what it has loaded from other packages (`note_plugin`). Of an error's frames the deepest one
that is somebody's own, the plug-in's or ours, says where to look: what is deeper belongs to a library, which
was given something wrong.
"""

from __future__ import annotations

import sys
import sysconfig
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from tactile_base.settings import SettingError

_ROOT = Path(__file__).resolve().parents[1]
_STANDARD = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib"))
_INSTALLED = {"site-packages", "dist-packages"}
_PLUGINS: dict[int, tuple[Any, str]] = {}  # by identity: not everything that plugs in can be hashed

LIBRARY, PLUGIN, OURS = "library", "plug-in", "ours"
BY_ERROR = "ended by an error: "
#: With what a node says in its log why it ends; whoever started it looks for them.
CAUSES = ("cannot start: ", "cannot configure: ", "cannot activate: ", BY_ERROR)


def note_plugin(found: Any, name: str) -> None:
    """Remember that `found` was loaded as what users call `name`, as "shape 'bowl'"."""
    _PLUGINS[id(found)] = found, name


def plugin_name(kind: Any) -> str:
    """What users call a plug-in, or a class that is derived from one; '' for what was never loaded as one."""
    for found in getattr(kind, "__mro__", (kind,)):
        if id(found) in _PLUGINS:
            return _PLUGINS[id(found)][1]
    return ""


def in_short(error: BaseException) -> str:
    """What an error says, with its kind unless that is said by its words."""
    plain = isinstance(error, SettingError | ImportError | OSError)
    return str(error) if plain and str(error) else f"{type(error).__name__}: {error}"


def raised_at(error: BaseException) -> str:
    """File and line to look at: the plug-in's own if there is one, else ours; of a library alone, its own."""
    places = list(_places(error))
    own = [place for place, whose in places if whose == OURS]
    return raised_in_plugin(error) or (own or [place for place, _ in places] or ["nobody knows where"])[-1]


def raised_in_plugin(error: BaseException) -> str:
    """File and line of the plug-in that raised an error, and of ours that it called then; else ''."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{error.filename}:{error.lineno}"
    known = [(place, whose) for place, whose in _places(error) if whose != LIBRARY]
    theirs = [place for place, whose in known if whose == PLUGIN]
    if not theirs:
        return ""
    place, whose = known[-1]
    return theirs[-1] if whose == PLUGIN else f"{theirs[-1]}, in {place}"


def raised_by(error: BaseException) -> str:
    """Whose code has raised an error itself: `LIBRARY`, `PLUGIN` or `OURS`."""
    return next((whose for _, whose in reversed(list(_places(error)))), OURS)


def told(error: BaseException, kind: Any = None, words: str = "") -> str:
    """An error for people: whose it is, what it says (or `words`), and where it was raised.

    Parameters
    ----------
    kind : type, optional
        Of the plug-in that was called; where it is in no frame, what it gave was wrong, and its file is told.
    """
    name = plugin_name(kind) or plugin_of(error)
    place = raised_at(error)
    if plugin_name(kind) and not raised_in_plugin(error):
        place = f"{place}, of what {defined_in(kind)} gives"
    return f"{name + ': ' if name else ''}{words or in_short(error)} ({place})"


def defined_in(kind: Any) -> str:
    """File, and line where that is cheap to know, in which a class is defined."""
    code = next((c for c in map(_code, vars(kind).values()) if c is not None), None) if kind else None
    if code is not None:
        return f"{code.co_filename}:{code.co_firstlineno}"
    module = getattr(kind, "__module__", "somebody")
    return str(getattr(sys.modules.get(module), "__file__", None) or module)


def plugin_of(error: BaseException) -> str:
    """What users call the plug-in that raised an error; '' where none did."""
    frames = [f for f, _ in traceback.walk_tb(error.__traceback__) if _whose(f) == PLUGIN]
    found = (name for by in (_by_object, _by_module) for f in reversed(frames) if (name := by(f)))
    return next(found, "")


def _by_object(frame: FrameType) -> str:
    """By the object whose method runs, or by the function."""
    functions = (name for found, name in _PLUGINS.values() if _code(found) is frame.f_code)
    return plugin_name(type(frame.f_locals.get("self"))) or next(functions, "")


def _by_module(frame: FrameType) -> str:
    """By what was loaded from that module; from one that many were loaded from, by that module."""
    module = frame.f_globals.get("__name__")
    names = {name for found, name in _PLUGINS.values() if getattr(found, "__module__", None) == module}
    return " or ".join(sorted(names)) if len(names) < 3 else f"a plug-in of {module}"


def _code(thing: Any) -> CodeType | None:
    return getattr(thing, "__code__", None)


def _places(error: BaseException) -> Iterator[tuple[str, str]]:
    """File and line of each frame, and whose it is; the deepest last."""
    for frame, line in traceback.walk_tb(error.__traceback__):
        yield f"{frame.f_code.co_filename}:{line}", _whose(frame)


def _whose(frame: FrameType) -> str:
    name = frame.f_code.co_filename
    if name.startswith("<"):  # frozen modules, what dataclasses write
        return LIBRARY
    path = Path(name)
    if path.is_relative_to(_ROOT) and path.relative_to(_ROOT).parts[0].startswith("tactile_"):
        return OURS
    if _INSTALLED & set(path.parts):
        module = _package(frame.f_globals.get("__name__"))
        plugs_in = module in {_package(getattr(found, "__module__", "")) for found, _ in _PLUGINS.values()}
        return PLUGIN if plugs_in else LIBRARY
    return LIBRARY if any(path.is_relative_to(folder) for folder in _STANDARD) else PLUGIN


def _package(module: Any) -> str:
    return str(module).partition(".")[0]
