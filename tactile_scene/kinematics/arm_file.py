"""Reading an arm's file: joints by Denavit and Hartenberg or from a URDF, flange and capsules.

What stands in one is in docs/kinematics.md; those of known arms lie in config/arms.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import named_file
from tactile_base.settings import SettingError
from tactile_base.yaml_file import Section, read_yaml
from tactile_geometry import se3
from tactile_scene.kinematics.capsules import Capsules
from tactile_scene.kinematics.chain import Chain
from tactile_scene.kinematics.urdf import UrdfError, read_urdf

Array = NDArray[np.float64]

_BASE = "base"


class ArmFileError(SettingError):
    """An arm's file that cannot be read or means nothing; the message says file and line."""


def load_arm(name_or_path: str | Path) -> Chain:
    """The chain from base to flange of an arm by its name, or by the path of a .yaml file.

    Raises
    ------
    ArmFileError
        With file, line and what would be valid.
    """
    try:
        root = read_yaml(named_file("arm", name_or_path), ArmFileError)
    except FileNotFoundError as error:
        raise ArmFileError(str(error)) from error
    if "urdf" in root.values:
        root.allow("description", "urdf", "base", "flange", "acceleration", "ready_deg", "capsules")
        chain = _from_urdf(root)
    else:
        root.allow("description", "convention", "joints", "flange", "capsules")
        chain = _from_parameters(root)
    return _checked(root, chain)


def _from_parameters(root: Section) -> Chain:
    """Joints by their parameters a, d, alpha: "modified" as Craig's, or "standard"."""
    modified = root.choice("convention", ("modified", "standard")) == "modified"
    joints = root.sections("joints")
    if not joints:
        root.fail("joints: an arm must have at least one")
    steps, last, ranges = [], np.eye(4), []
    for section in joints.values():
        section.allow("a", "d", "alpha_deg", "range", "velocity", "acceleration", "ready_deg")
        twist = se3.pose_from_euler([0, 0, 0, np.radians(section.number("alpha_deg")), 0, 0])
        along_x, along_z = _shift(section.number("a"), 0.0), _shift(0.0, section.number("d"))
        before = twist @ along_x @ along_z if modified else np.eye(4)
        steps.append(last @ before)
        last = np.eye(4) if modified else along_z @ along_x @ twist
        ranges.append(section.numbers("range", 2))
    lower, upper = np.array(ranges).T

    def all_of(key: str) -> Array:
        return np.array([section.number(key) for section in joints.values()])

    return Chain(
        path=root.path,
        names=tuple(joints),
        steps=np.array([*steps, last @ _pose(root.section("flange"))]),
        lower=lower,
        upper=upper,
        velocity=all_of("velocity"),
        acceleration=all_of("acceleration"),
        ready=np.radians(all_of("ready_deg")),
        links=_capsules(root, tuple(joints)),
    )


def _from_urdf(root: Section) -> Chain:
    """Joints between two links of a URDF, which says nothing of accelerations and good postures."""
    try:
        found = read_urdf(root.path.parent / root.text("urdf"), root.text("base"), root.text("flange"))
    except (OSError, UrdfError) as error:
        root.fail(f"urdf: {error}", "urdf")
    count = len(found.names)
    return Chain(
        path=root.path,
        names=found.names,
        steps=found.steps,
        lower=found.lower,
        upper=found.upper,
        velocity=found.velocity,
        acceleration=np.array(root.numbers("acceleration", count)),
        ready=np.radians(root.numbers("ready_deg", count)),
        links=_capsules(root, found.names),
        description=found.description,
    )


def _capsules(root: Section, joints: tuple[str, ...]) -> Capsules:
    ends, radii, at = [], [], []
    for section in root.sections("capsules").values():
        section.allow("joint", "from", "to", "radius")
        at.append((_BASE, *joints).index(section.choice("joint", (_BASE, *joints))))
        ends.append([section.numbers("from", 3), section.numbers("to", 3)])
        radii.append(section.number("radius"))
        if radii[-1] <= 0.0:
            section.fail(f"{section.name}.radius = {radii[-1]:g} m: must be above 0", "radius")
    return Capsules(np.array(ends).reshape(-1, 2, 3), np.array(radii), np.array(at, dtype=np.intp))


def _checked(root: Section, chain: Chain) -> Chain:
    for i, name in enumerate(chain.names):
        if not chain.lower[i] < chain.ready[i] < chain.upper[i]:
            low, high, ready = np.degrees([chain.lower[i], chain.upper[i], chain.ready[i]])
            root.fail(f"{name}: ready_deg = {ready:g} must lie in its range, {low:.1f} to {high:.1f} degrees")
        if min(chain.velocity[i], chain.acceleration[i]) <= 0.0:
            root.fail(f"{name}: velocity and acceleration must be above 0")
    return chain


def _shift(x: float, z: float) -> Array:
    return se3.pose_from_euler([x, 0, z, 0, 0, 0])


def _pose(section: Section) -> Array:
    section.allow("position", "rotation_deg")
    zero = (0.0, 0.0, 0.0)
    angles = np.radians(section.numbers("rotation_deg", 3, zero))
    return se3.pose_from_euler([*section.numbers("position", 3, zero), *angles])
