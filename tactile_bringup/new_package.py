"""Packages with a plug-in of one's own, from the templates in this folder; `tactile new` writes them."""

from __future__ import annotations

import re
from pathlib import Path
from string import Template

from tactile_base.settings import SettingError, unknown_name

TEMPLATES = Path(__file__).with_name("templates")

#: Kind -> its groups of entry points, with the place that a name leads to.
ENTRY_POINTS = {
    "task": {"tasks": "$name:$Class", "reports": "$name:REPORT"},
    "arm": {"arms": "$name:$Class", "doubles": "tactile_doubles.reported:ReportedDouble"},
    "camera": {"cameras": "$name:$Class"},
    "shape": {"shapes": "$name:$Class"},
    "motion": {"motions": "$name:$Class"},
}
_NAME = re.compile(r"[a-z][a-z0-9_]*")


def write_package(kind: str, name: str, folder: Path) -> list[Path]:
    """Write a package `folder`/`name` with a plug-in of that kind and name, and its tests.

    Returns
    -------
    list of Path
        Its files.

    Raises `SettingError` if there is no such kind, or the name cannot be that of a module; `FileExistsError`
    if there is something of that name already.
    """
    if kind not in ENTRY_POINTS:
        raise SettingError(f"kind: {unknown_name(kind, list(ENTRY_POINTS))}")
    if not _NAME.fullmatch(name):
        raise SettingError(f"name '{name}': must be lower-case letters, digits and _, from a letter")
    words = {"name": name, "Class": "".join(part.capitalize() for part in name.split("_"))}
    points = "".join(
        f'\n[project.entry-points."tactile_servoing.{group}"]\n$name = "{place}"\n'
        for group, place in ENTRY_POINTS[kind].items()
    )
    words["entry_points"] = Template(points).substitute(words)
    package = folder / name
    package.mkdir(parents=True)
    written = []
    for template in (TEMPLATES / "pyproject.toml.in", *sorted((TEMPLATES / kind).iterdir())):
        path = package / template.name.removesuffix(".in").replace("NAME", name)
        path.write_text(Template(template.read_text()).substitute(words))
        written.append(path)
    return written
