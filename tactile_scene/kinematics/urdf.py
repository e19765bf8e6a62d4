"""A URDF file: the chain of joints between two of its links, and where all its links are."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import read_text
from tactile_geometry import se3

Array = NDArray[np.float64]


class UrdfError(ValueError):
    """A URDF that has no such chain; the message says why."""


@dataclass(frozen=True)
class LinkJoint:
    """A joint: its child in its parent at angle 0, `T` (4, 4), and what it turns about; None: it is fixed."""

    name: str
    parent: str
    child: str
    T: Array
    axis: Array | None

    def at(self, angle: float) -> Array:
        """The child in the parent (4, 4) at an angle, rad."""
        return self.T if self.axis is None else self.T @ se3.exp([0.0, 0.0, 0.0, *(angle * self.axis)])


@dataclass(frozen=True)
class Description:
    """All of a URDF that it takes to show the arm.

    Attributes
    ----------
    path : of the file, beside which its meshes may lie
    text : the whole file
    root : its first link
    T_base_root : ndarray (4, 4)
        That link in the chain's base.
    joints : of all links; what slides is taken as fixed
    """

    path: Path
    text: str
    root: str
    T_base_root: Array
    joints: tuple[LinkJoint, ...]


@dataclass(frozen=True)
class UrdfChain:
    """As in `chain.Chain`."""

    names: tuple[str, ...]
    steps: Array
    lower: Array
    upper: Array
    velocity: Array
    description: Description


def read_urdf(path: Path, base: str, flange: str) -> UrdfChain:
    """The joints from one link to another below it; fixed ones count as parts of the links.

    Raises
    ------
    OSError
        If the file cannot be read.
    UrdfError
        If it is none, has no such links, or a joint on the way slides.
    """
    try:
        root = ElementTree.fromstring(text := read_text(path))
    except ElementTree.ParseError as error:
        raise UrdfError(f"{path}: not valid XML: {error}") from error
    if root.tag != "robot":
        raise UrdfError(f"{path}: holds <{root.tag}>, must hold <robot>; xacro has to be expanded")
    steps, turning, T = [], [], np.eye(4)
    for joint in _way(path, root, base, flange):
        T = T @ origin_of(joint)
        kind = joint.get("type")
        if kind in ("revolute", "continuous"):
            to_axis = _z_to(three_numbers(joint.find("axis"), "xyz", "1 0 0"))
            steps.append(T @ to_axis)
            turning.append(joint)
            T = se3.inverse(to_axis)
        elif kind != "fixed":
            raise UrdfError(f"{path}: joint '{joint.get('name')}' is {kind}; joints here turn or are fixed")
    if not turning:
        raise UrdfError(f"{path}: no joint turns between '{base}' and '{flange}'")
    limits = np.array([_limits(joint) for joint in turning])
    names = tuple(str(joint.get("name")) for joint in turning)
    described = _description(path, text, root, base)
    return UrdfChain(names, np.array([*steps, T]), limits[:, 0], limits[:, 1], limits[:, 2], described)


def _description(path: Path, text: str, root: ElementTree.Element, base: str) -> Description:
    """Where all links are; the root's place in `base` is that at angle 0 of the joints between."""
    whole = [joint for joint in root.iter("joint") if _link(joint, "parent") and _link(joint, "child")]
    parents = {_link(joint, "child"): _link(joint, "parent") for joint in whole}
    first = base
    while first in parents:
        first = parents.pop(first)
    T_root_base = np.eye(4)
    for joint in _way(path, root, first, base):
        T_root_base = T_root_base @ origin_of(joint)
    return Description(path, text, first, se3.inverse(T_root_base), tuple(map(_link_joint, whole)))


def _link_joint(joint: ElementTree.Element) -> LinkJoint:
    axis = None
    if joint.get("type") in ("revolute", "continuous"):
        axis = _z_to(three_numbers(joint.find("axis"), "xyz", "1 0 0"))[:3, 2]
    name, parent, child = str(joint.get("name")), _link(joint, "parent"), _link(joint, "child")
    return LinkJoint(name, parent, child, origin_of(joint), axis)


def _way(path: Path, root: ElementTree.Element, base: str, flange: str) -> list[ElementTree.Element]:
    """Joints from `base` down to `flange`."""
    above = {_link(joint, "child"): joint for joint in root.iter("joint") if joint.find("child") is not None}
    way: list[ElementTree.Element] = []
    link = flange
    while link != base:
        if link not in above or len(way) > len(above):
            links = ", ".join(str(item.get("name")) for item in root.findall("link"))
            raise UrdfError(f"{path}: no way from link '{base}' to '{flange}'; links: {links}")
        way.append(above[link])
        link = _link(above[link], "parent")
    return way[::-1]


def _link(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return str(element.get("link")) if element is not None else ""


def origin_of(item: ElementTree.Element) -> Array:
    """The pose (4, 4) that the <origin> of a joint or a visual says; `UrdfError` where it is none."""
    origin = item.find("origin")
    xyz, rpy = (three_numbers(origin, key, "0 0 0") for key in ("xyz", "rpy"))
    return se3.pose_from_euler([*xyz, *rpy])


def three_numbers(element: ElementTree.Element | None, key: str, default: str) -> Array:
    """Those of an attribute (3,), by default those of a text; `UrdfError` where they are none."""
    text = default if element is None else element.get(key, default)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.full(3, np.nan)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise UrdfError(f'{key}="{text}": must be 3 finite numbers')
    return numbers


def _limits(joint: ElementTree.Element) -> tuple[float, float, float]:
    """Range and largest speed; a continuous joint may turn once to each side."""
    limit = joint.find("limit")
    name = joint.get("name")
    if limit is None:
        raise UrdfError(f"joint '{name}' has no <limit>, which must give lower, upper and velocity")
    lower, upper = ("-6.2832", "6.2832") if joint.get("type") == "continuous" else ("nan", "nan")
    texts = limit.get("lower", lower), limit.get("upper", upper), limit.get("velocity", "nan")
    try:
        low, high, speed = map(float, texts)
    except ValueError:
        low = high = speed = np.nan
    if not (low < high and speed > 0.0):
        raise UrdfError(f"joint '{name}': <limit> must give lower below upper, and velocity above 0")
    return low, high, speed


def _z_to(axis: Array) -> Array:
    """A rotation (4, 4) that takes z to an axis."""
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise UrdfError("an axis must not be zero")
    z = axis / length
    angle = float(np.arccos(np.clip(z[2], -1.0, 1.0)))
    about = np.array([-z[1], z[0], 0.0])  # z axis x z
    norm = float(np.linalg.norm(about))
    about = about / norm if norm > 0.0 else np.array([1.0, 0.0, 0.0])
    return se3.exp([0.0, 0.0, 0.0, *(angle * about)])
