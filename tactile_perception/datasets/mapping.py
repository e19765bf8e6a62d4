"""How the columns of any label table are to be read: a YAML file for tables of other labs, made by hand.

    table: labels.csv                 # in the folder
    image: frame                      # column with the image's name, or its path from the folder
    pose_of: sensor in surface        # or: surface in sensor, which is inverted
    euler: extrinsic xyz              # or: intrinsic zyx, ..
    flip: [gamma]                     # as sign: -1 of its columns; signs come before what turns poses
    pose:
      z: {column: depth, unit: mm}
      alpha: {column: roll, unit: rad, sign: -1}
      beta: {value: 0}                # not in the table, but known
    shear:                            # what came after the contact, added to the pose
      x: {column: slide_x, unit: m}
    force:
      Fz: {column: load}

What it leaves out is not labelled.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_base.yaml_file import Section, read_yaml
from tactile_perception.datasets.layout import FORCE_COLUMNS, DatasetError
from tactile_perception.estimating.labels import EULER_COMPONENTS

Array = NDArray[np.float64]

_FACTORS = {"mm": 1.0, "m": 1000.0, "deg": 1.0, "rad": float(np.degrees(1.0)), "N": 1.0}
_UNITS: dict[str, tuple[str, ...]] = dict(
    zip(EULER_COMPONENTS, [("mm", "m")] * 3 + [("deg", "rad")] * 3, strict=True)
)
_UNITS |= dict.fromkeys(FORCE_COLUMNS, ("N",))
_ORDERS = tuple(
    f"{kind} {''.join(axes)}" for kind in ("extrinsic", "intrinsic") for axes in itertools.permutations("xyz")
)
_EXTRINSIC, _INVERTED = "extrinsic xyz", "surface in sensor"
POSES = ("sensor in surface", _INVERTED)


@dataclass(frozen=True)
class Column:
    """One number of each row: a column times a factor, in mm, degrees or N; without a name one constant."""

    name: str
    factor: float = 1.0
    value: float = 0.0


@dataclass(frozen=True)
class TableMapping:
    """Which column of a table is what; None for what is not there.

    Attributes
    ----------
    image : column of the image's name; "" for a mapping without columns, of a table with known ones
    pose, shear : (6,) of x, y, z, alpha, beta, gamma; a label is their sum
    moves : whether shears are motions that ended at the pose, which counts where both vary
    force : (3,)
    flip : components whose sign is changed first
    euler : in which order the angles turn about their axes
    inverted : whether the table has the surface in the sensor
    table : name of the file; "": the known one
    """

    image: str = ""
    pose: tuple[Column | None, ...] = (None,) * 6
    shear: tuple[Column | None, ...] = (None,) * 6
    force: tuple[Column | None, ...] = (None,) * 3
    flip: tuple[str, ...] = ()
    euler: str = _EXTRINSIC
    inverted: bool = False
    table: str = ""
    moves: bool = False

    @property
    def groups(self) -> tuple[tuple[Column | None, ...], ...]:
        """Pose, shear and force."""
        return self.pose, self.shear, self.force

    @property
    def labelled(self) -> tuple[str, ...]:
        """Components that the table has."""
        pairs = zip(EULER_COMPONENTS, self.pose, self.shear, strict=True)
        return tuple(name for name, *columns in pairs if any(columns))

    @property
    def lacking(self) -> list[str]:
        """Components without which poses cannot be converted."""
        mixed = EULER_COMPONENTS[3:] if self.euler != _EXTRINSIC else ()
        return [name for name in (EULER_COMPONENTS if self.inverted else mixed) if name not in self.labelled]

    @property
    def convention(self) -> str:
        """Whose pose the table has, and how its angles turn."""
        return f"{POSES[self.inverted]}, {self.euler}"

    @property
    def forces(self) -> tuple[str, ...]:
        """Forces that the table has."""
        return tuple(name for name, column in zip(FORCE_COLUMNS, self.force, strict=True) if column)

    def converted(self, pose: Array, shear: Array) -> tuple[Array, Array]:
        """Pose and shear (n, 6), mm and degrees as the table means them, as pose and shear of X_fs.

        Their sum is that of the table, converted as one pose; what is left of it beside the pose is shear.
        """
        signs = np.where([name in self.flip for name in EULER_COMPONENTS], -1.0, 1.0)
        pose, shear = signs * pose, signs * shear
        if self.euler == _EXTRINSIC and not self.inverted:
            return pose, shear
        contact = self._surface_contact_pose(pose)
        return contact, self._surface_contact_pose(pose + shear) - contact

    def _surface_contact_pose(self, euler_mm_deg: Array) -> Array:
        """Poses (n, 6) as the table means them -> of the sensor in the surface, extrinsic xyz."""
        kind, axes = self.euler.split()
        angles = euler_mm_deg[:, [3 + "xyz".index(axis) for axis in axes]]
        order = axes.upper() if kind == "intrinsic" else axes
        rotation, position = Rotation.from_euler(order, angles, degrees=True), euler_mm_deg[:, :3]
        if self.inverted:
            rotation = rotation.inv()
            position = -rotation.apply(position)
        return np.hstack([position, rotation.as_euler("xyz", degrees=True)])


def read_mapping(path: Path) -> TableMapping:
    """A mapping file; `SettingError` says what is wrong in it, and in which line."""
    root = read_yaml(path)
    root.allow("table", "image", "flip", "pose_of", "euler", "pose", "shear", "force")
    mapping = TableMapping(
        image=root.text("image", ""),
        pose=_columns(root.section("pose"), EULER_COMPONENTS),
        shear=_columns(root.section("shear"), EULER_COMPONENTS),
        force=_columns(root.section("force"), FORCE_COLUMNS),
        flip=root.names("flip", list(EULER_COMPONENTS), ()),
        euler=root.choice("euler", _ORDERS, _EXTRINSIC),
        inverted=root.choice("pose_of", POSES, POSES[0]) == _INVERTED,
        table=root.text("table", ""),
    )
    used = [column.name for group in mapping.groups for column in group if column and column.name]
    if twice := sorted({name for name in used if used.count(name) > 1}):
        root.fail(f"column {', '.join(twice)} is used more than once")
    if mapping.labelled and not mapping.image:
        root.fail("image is missing: the column with the image's name")
    if mapping.image and not mapping.labelled:
        root.fail("pose and shear name no column: at least one component must be labelled", "pose")
    if not mapping.image and (mapping.euler, mapping.inverted, mapping.flip) == (_EXTRINSIC, False, ()):
        root.fail("says nothing: neither image and pose, nor flip, euler or pose_of that are not ours")
    return mapping


def _columns(section: Section, names: Sequence[str]) -> tuple[Column | None, ...]:
    section.allow(*names)
    return tuple(_column(section.section(name), name) if name in section.values else None for name in names)


def _column(section: Section, name: str) -> Column:
    section.allow("column", "unit", "sign", "value")
    if "value" in section.values:
        section.allow("value")
        return Column("", value=section.number("value"))
    sign = section.number("sign", 1)
    if sign not in (1, -1):
        section.fail(f"sign = {sign:g}: must be 1 or -1", "sign")
    units = _UNITS[name]
    return Column(section.text("column"), sign * _FACTORS[section.choice("unit", units, units[0])])


def template(table: str, columns: Sequence[str]) -> str:
    """A mapping file to be filled in, for a table with these columns."""

    def lines(names: Sequence[str]) -> list[str]:
        return [f"#  {name}: {{column: NAME, unit: {_UNITS[name][0]}, sign: 1}}" for name in names]

    return "\n".join(
        [
            f"# How {table} is to be read. Its columns: {', '.join(columns)}",
            "# Take the # from the lines of what it holds and name the column; the others are not labelled.",
            "# Units: mm or m, deg or rad, N. {value: 0} in place of a column: held there.",
            f"table: {table}",
            "#image: NAME    # column with the image's name, or its path from the folder",
            f"pose_of: {POSES[0]}    # or: {_INVERTED}",
            f"euler: {_EXTRINSIC}    # or: intrinsic zyx, ..",
            "pose:    # z into the surface, 0 at first touch; alpha, beta, gamma about x, y, z",
            *lines(EULER_COMPONENTS),
            "shear:    # what came after the contact, where it is apart; it is added to the pose",
            *lines(EULER_COMPONENTS),
            "force:",
            *lines(FORCE_COLUMNS),
            "",
        ]
    )


class UnknownTable(DatasetError):
    """A table whose columns are none of the known ones; `template` is a mapping file for it."""

    def __init__(self, path: Path, complaint: str, columns: Sequence[str]) -> None:
        self.template = template(path.name, columns)
        found = ", ".join(columns) or "none"
        super().__init__(
            f"{path}: {complaint}; its columns: {found}; `tactile data import` reads any by a mapping file"
        )
