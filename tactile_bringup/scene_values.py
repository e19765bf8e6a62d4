"""What commands find out of a cell, written into its scene file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tactile_base.yaml_edit import with_values
from tactile_bringup.staged_arm import arm_of
from tactile_scene.scene_file import load_scene


def write_into(path: Path, arm: str | None, values: dict[str, Any]) -> None:
    """Set values of the sensor of an arm in a scene file, which stays as it was unless it is a scene then.

    Raises `ValueError` or `OSError` with what is wrong.
    """
    name = arm_of(load_scene(path), arm).name
    candidate = path.with_name(f".{path.stem}.new.yaml")
    try:
        candidate.write_text(with_values(path.read_text(), ["arms", name, "sensor"], values))
        load_scene(candidate)
        candidate.replace(path)
    finally:
        candidate.unlink(missing_ok=True)
