"""Shapes of bodies as signed distance functions, each in its own frame and a file of its own.

Distances are exact (Euclidean), positive outside, in metres; normals are unit, outward, and equal the
gradient of the distance. All functions take many points at once::

    surface = make_surface("ramp", {"height": 0.03})
    distance, normal = surface.query(points)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from tactile_base.contract import Contract
from tactile_base.registry import Registry
from tactile_base.settings import SettingError

if TYPE_CHECKING:
    from tactile_scene.shapes.surface import Surface


def _surface() -> type:
    from tactile_scene.shapes.surface import Surface

    return Surface


SHAPES: Registry[type[Surface]] = Registry(
    "shape",
    "tactile_servoing.shapes",
    {
        "plane": "tactile_scene.shapes.plane:Plane",
        "ramp": "tactile_scene.shapes.ramp:Ramp",
        "dome": "tactile_scene.shapes.dome:Dome",
        "box": "tactile_scene.shapes.box:Box",
        "cylinder": "tactile_scene.shapes.cylinder:Cylinder",
        "sphere": "tactile_scene.shapes.sphere:Sphere",
        "prism": "tactile_scene.shapes.prism:Prism",
    },
    Contract(("settings",), {"query": ("points",), "grid": ("n",)}, settings=True, base=_surface),
)


def make_surface(kind: str, parameters: Mapping[str, Any] | None = None, where: str = "") -> Surface:
    """The surface of the given kind, a name of `SHAPES`, from named parameters.

    Raises `SettingError`, which names `where` (a file and line), for an unknown kind or a bad parameter.
    """
    try:
        shape = SHAPES.load(kind)
    except SettingError as error:
        raise SettingError(f"{where}: {error}" if where else str(error)) from error
    return shape(shape.settings_class.from_mapping(parameters or {}, where))
