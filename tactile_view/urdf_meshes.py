"""UrdfMeshes: an arm as its URDF draws it: a mesh or a solid at each link, which follow the joints.

Meshes are read by trimesh, which viser needs anyway; of COLLADA (.dae) it needs pycollada besides.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_base.input_file import check_regular
from tactile_base.raised import in_short
from tactile_scene.kinematics.urdf import Description, LinkJoint, UrdfError, origin_of, three_numbers
from tactile_view.drawing import place

Array = NDArray[Any]
Color = tuple[int, int, int]

LARGEST_MESH = 100_000_000  # bytes of a file
_PACKAGE = "package://"


class UrdfMeshes:
    """See the module's text; `UrdfError` or `OSError` where a mesh cannot be shown: then none is."""

    def __init__(self, scene3d: Any, root: str, description: Description, color: Color) -> None:
        drawn = list(_visuals(description, color))
        if not drawn:
            raise UrdfError(f"{description.path}: draws no link: no <visual> has a <geometry>")
        place(scene3d.add_frame(f"{root}/urdf", show_axes=False), description.T_base_root)
        self._turning: list[tuple[LinkJoint, Any]] = []
        paths = {description.root: f"{root}/urdf"}
        for joint in _downwards(description):
            paths[joint.child] = f"{paths[joint.parent]}/{len(paths)}"
            frame = scene3d.add_frame(paths[joint.child], show_axes=False)
            place(frame, joint.T)
            if joint.axis is not None:
                self._turning.append((joint, frame))
        for number, (link, T, glb) in enumerate(drawn):
            if link in paths:
                place(scene3d.add_glb(f"{paths[link]}/visual{number}", glb), T)

    def show(self, names: Sequence[str], angles: Array) -> None:
        """Have the links follow angles (n,), rad, of joints with these names; others stay at zero."""
        known = dict(zip(names, angles.tolist(), strict=True))
        for joint, frame in self._turning:
            if joint.name in known:
                place(frame, joint.at(known[joint.name]))


def _downwards(description: Description) -> Iterator[LinkJoint]:
    """Joints from the root on, each after that of its parent."""
    reached, left = {description.root}, list(description.joints)
    while found := [joint for joint in left if joint.parent in reached]:
        for joint in found:
            left.remove(joint)
            if joint.child not in reached:
                reached.add(joint.child)
                yield joint


def _visuals(description: Description, color: Color) -> Iterator[tuple[str, Array, bytes]]:
    """Link, pose in it (4, 4), and what is drawn there, as GLB."""
    robot = ElementTree.fromstring(description.text)
    colors = {item.get("name"): item.find("color") for item in robot.findall("material")}
    for link in robot.findall("link"):
        for visual in link.findall("visual"):
            geometry = visual.find("geometry")
            if geometry is None or not len(geometry):
                continue
            material = visual.find("material")
            named = None if material is None else material.find("color")
            if named is None and material is not None:
                named = colors.get(material.get("name"))
            rgba = color if named is None else _rgba(named)
            yield str(link.get("name")), origin_of(visual), _glb(description.path, geometry[0], rgba)


def _glb(urdf: Path, shape: ElementTree.Element, color: Sequence[int]) -> bytes:
    """A mesh, with the colors of its own file if it has any, or a solid."""
    if shape.tag != "mesh":
        return _colored(trimesh.Scene(_solid(urdf, shape)), color)
    path, scale = mesh_path(urdf, shape.get("filename", "")), three_numbers(shape, "scale", "1 1 1")
    check_regular(path)
    if (size := path.stat().st_size) > LARGEST_MESH:
        raise UrdfError(f"{path}: has {size} bytes, at most {LARGEST_MESH} are shown")
    try:
        scene = trimesh.load_scene(str(path))
        if scene.is_empty:
            raise UrdfError("it is empty")
        return _colored(scene.apply_transform(np.diag([*scale, 1.0])), color)
    except ImportError as error:
        raise UrdfError(f"{path}: {error}; 'tactile_servoing[view]' brings it") from error
    except Exception as error:  # whatever a parser makes of it
        raise UrdfError(f"{path}: is no mesh that can be read: {in_short(error)}") from error


def _colored(scene: trimesh.Scene, color: Sequence[int]) -> bytes:
    """As GLB; what has no color gets this one."""
    for mesh in scene.geometry.values():
        if isinstance(mesh, trimesh.Trimesh) and not (mesh.visual and mesh.visual.defined):
            mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=color)
    return bytes(scene.export(file_type="glb"))


def _solid(urdf: Path, shape: ElementTree.Element) -> trimesh.Trimesh:
    if shape.tag == "box":
        return trimesh.creation.box(three_numbers(shape, "size", ""))
    radius, length = (float(shape.get(key, "nan")) for key in ("radius", "length"))
    if shape.tag == "cylinder":
        return trimesh.creation.cylinder(radius, length)
    if shape.tag == "sphere":
        return trimesh.creation.icosphere(2, radius)
    raise UrdfError(f"{urdf}: <{shape.tag}> in a <geometry>: must be mesh, box, cylinder or sphere")


def _rgba(color: ElementTree.Element) -> list[int]:
    return [round(255.0 * float(part)) for part in color.get("rgba", "").split()]


def mesh_path(urdf: Path, name: str) -> Path:
    """Where a mesh lies that a URDF names: beside it, or in a ROS package; `UrdfError` for one not found."""
    if not name.startswith(_PACKAGE):
        return urdf.parent / name.removeprefix("file://")
    package, _, rest = name.removeprefix(_PACKAGE).partition("/")
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    places = [Path(prefix) / "share" / package for prefix in prefixes]
    places += [above for above in urdf.absolute().parents if above.name == package]
    for folder in places:
        if (folder / rest).exists():
            return folder / rest
    raise UrdfError(
        f"{urdf}: {name} is nowhere: neither in the packages of the sourced ROS 2 nor in a folder "
        f"'{package}' above that file"
    )
