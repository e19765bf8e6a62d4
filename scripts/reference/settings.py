"""Pages of everything that is declared as settings: of scenes, of tasks, and the rest."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from text import code, first_sentences, ours, table

from tactile_base import settings
from tactile_base.settings import Settings, range_text
from tactile_bringup.plugin_check import REGISTRIES

PACKAGES = Path(inspect.getfile(settings)).parents[1]  # where the packages are installed
TRAINING_ONLY = ("onnx", "torch")  # the extra `train`, which only some settings need
REST = "# Settings\n\nThose of [scenes](scene.md) and [tasks](tasks.md) have pages of their own.\n"
SCENES = "# Settings of scenes\n\nWhere each stands in the file: [scenes.md](../scenes.md).\n\n"
GOALS = """# Settings and goals of tasks

What tasks do: [tasks.md](../tasks.md); how: [control.md](../control.md).

"""
DEFINED = re.compile(r"^class \w+\(\w*(Settings|SettingGroups|Goal)\b", re.M)


def bounds(field: dataclasses.Field[Any]) -> str:
    """The range of a setting: its choices, one for all elements, or one for each."""
    if choices := field.metadata.get("choices"):
        return ", ".join(code(choice) for choice in choices)
    lower, upper = field.metadata.get("lower"), field.metadata.get("upper")
    if lower is None and upper is None:
        return ""
    count = max([len(bound) for bound in (lower, upper) if isinstance(bound, tuple | list)], default=1)
    pairs = [
        [bound[k] if isinstance(bound, tuple | list) else bound for bound in (lower, upper)]
        for k in range(count)
    ]
    return ", ".join(dict.fromkeys(range_text(*pair) for pair in pairs))


def fields(kind: type[Settings]) -> str:
    """The table of a settings class."""
    rows = [
        (
            f"`{item.name}`",
            "required" if item.default is dataclasses.MISSING else code(item.default),
            item.metadata.get("unit", ""),
            bounds(item),
            item.metadata.get("doc", ""),
        )
        for item in dataclasses.fields(kind)
    ]
    return table("name | default | unit | range | meaning", rows) if rows else "No settings.\n"


def described(heading: str, kind: type[Settings], level: int = 3) -> str:
    """A section about a settings class."""
    return f"{'#' * level} {heading}\n\n{first_sentences(kind)} (`{kind.__name__}`)\n\n{fields(kind)}\n"


def subclasses(kind: type) -> Iterator[type]:
    """All of them, of every depth."""
    for item in kind.__subclasses__():
        yield item
        yield from subclasses(item)


@functools.cache
def all_settings() -> tuple[list[type[Settings]], list[str]]:
    """Every settings class of our packages, and the modules that need the extra `train` to be read."""
    without = []
    for path in sorted(PACKAGES.glob("tactile_*/**/*.py")):
        name = ".".join(path.relative_to(PACKAGES).with_suffix("").parts)
        if not name.startswith("tactile_msgs") and DEFINED.search(path.read_text()):
            try:
                importlib.import_module(name)
            except ModuleNotFoundError as error:
                if error.name not in TRAINING_ONLY:
                    raise
                without.append(name)
    kinds = {kind for kind in subclasses(Settings) if dataclasses.fields(kind)}
    here = [kind for kind in kinds if kind.__module__.startswith("tactile_")]
    return sorted(here, key=lambda kind: (kind.__module__, kind.__name__)), without


def named(end: str) -> type[Settings]:
    """The settings class whose full name ends so."""
    kinds = [kind for kind in all_settings()[0] if f"{kind.__module__}.{kind.__name__}".endswith(f".{end}")]
    if len(kinds) != 1:
        sys.exit(f"scripts/reference: {len(kinds)} settings classes are called {end}, must be one")
    return kinds[0]


def settings_page() -> str:
    """All settings that no other page shows."""
    kinds, without = all_settings()
    shown = {kind for _, kind in scene_parts()} | {kind for _, kind in shared_groups()}
    shown |= {kind for task in our_tasks().values() for kind in (task.goal_class, own_group(task))}
    rest = [kind for kind in kinds if kind not in shown]
    names = [kind.__name__ for kind in rest]
    text, package = REST, ""
    for kind in rest:
        if kind.__module__.split(".")[0] != package:
            package = kind.__module__.split(".")[0]
            text += f"\n## {package}\n\n"
        several = names.count(kind.__name__) > 1
        text += described(f"{kind.__name__} ({package})" if several else kind.__name__, kind)
    if without:
        text += f"Not shown, since they need the extra `train`: {', '.join(without)}.\n"
    return text


# ---- scenes ----

SCENE = {
    "limits": "ArmLimits",
    "safety": "SafetySettings",
    "tracking": "arm_settings.TrackingSettings",
    "sensor": "SensorSettings",
    "driver external": "ExternalArmSettings",
    "camera external": "ExternalCameraSettings",
}
SIMULATED = {
    "skin": "SkinSettings",
    "contact": "simulated_sensors.ContactSettings",
    "markers": "MarkerSettings",
    "camera": "simulated_sensors.CameraSettings",
    "ideal": "IdealSensorSettings",
    "fitted": "FittedSensorSettings",
}
PLUGGED = {"arm driver": "driver", "camera driver": "camera", "shape": "shape", "body motion": "motion"}


def scene_parts() -> list[tuple[str, type[Settings]]]:
    """Heading and class of each part of a scene that is declared as settings."""
    parts = [(heading, named(kind)) for heading, kind in SCENE.items()]
    for registry in REGISTRIES:
        for name, item in ours(registry).items() if registry.kind in PLUGGED else ():
            kind = getattr(item, "settings_class", None)
            if inspect.isclass(kind) and issubclass(kind, Settings) and dataclasses.fields(kind):
                parts.append((f"{PLUGGED[registry.kind]} {name}", kind))
    return parts + [(f"simulated {name}", named(kind)) for name, kind in SIMULATED.items()]


def scene_page() -> str:
    """All settings that a scene file has."""
    return SCENES + "".join(described(heading, kind, 2) for heading, kind in scene_parts())


# ---- tasks ----


def our_tasks() -> dict[str, Any]:
    """The classes of this package's tasks, by name."""
    return ours(next(registry for registry in REGISTRIES if registry.kind == "task"))


def own_group(task: Any) -> type[Settings] | None:
    """The class of the group `task`, which is the task's own."""
    return type(task.settings_class().group("task")) if "task" in task.settings_class.group_names() else None


def shared_groups() -> list[tuple[str, type[Settings]]]:
    """Heading and class of each group of settings that tasks share."""
    found: dict[type[Settings], str] = {}
    for name, task in our_tasks().items():
        for group in task.settings_class.group_names():
            kind = type(task.settings_class().group(group))
            if group != "task" and kind not in found:
                found[kind] = f"{group} of {name}" if group in found.values() else group
    return [(heading, kind) for kind, heading in found.items()]


def changed_defaults(task: Any) -> str:
    """The defaults of its groups in which a task differs from what the groups' tables say."""
    groups = task.settings_class()
    return ", ".join(
        f"`{name}.{item.name}`: {code(getattr(groups.group(name), item.name)) or 'none'}"
        for name in groups.group_names()
        for item in dataclasses.fields(groups.group(name))
        if item.default is not dataclasses.MISSING and getattr(groups.group(name), item.name) != item.default
    )


def tasks_page() -> str:
    """What tasks take: goals, settings of their own, settings that they share."""
    text, headings = GOALS, {kind: heading for heading, kind in shared_groups()}
    for name, task in our_tasks().items():
        groups = task.settings_class()
        text += f"## {name}\n\n{first_sentences(task)}\n\nPhases: {', '.join(map(code, task.phases))}.\n"
        text += f"\n### Goal of {name}\n\n{fields(task.goal_class)}"
        if own := own_group(task):
            text += f"\n### Group task of {name}\n\n{fields(own)}"
        others = (headings[type(groups.group(group))] for group in groups.group_names() if group != "task")
        links = ", ".join(f"[{heading}](#{heading.replace(' ', '-')})" for heading in others)
        text += f"\nOther groups: {links}.\n"
        if differs := changed_defaults(task):
            text += f"Defaults that differ there: {differs}.\n"
        text += "\n"
    return text + "".join(described(heading, kind, 2) for heading, kind in shared_groups())


def place_of(name: str) -> str:
    """The page and anchor of a settings class."""
    for page, parts in (("scene.md", scene_parts()), ("tasks.md", shared_groups())):
        for heading, kind in parts:
            if kind.__name__ == name:
                return f"{page}#{heading.replace(' ', '-')}"
    return f"settings.md#{name.lower()}"
