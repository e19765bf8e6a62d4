"""The label table of a data folder: its columns in the names that public tools use, and its rows.

A row's label is the sum of its contact pose and its shear, in mm and degrees. Where a lab's signs or units
are others, a file `conventions.json` in the folder says so, and every reader applies it::

    {"flip": ["x", "y", "gamma"], "length_unit": "mm", "angle_unit": "deg"}
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json, read_text
from tactile_base.settings import SettingError, Settings, setting
from tactile_perception.datasets import layout
from tactile_perception.datasets.layout import AXES, DatasetError, DatasetReport
from tactile_perception.datasets.mapping import Column, TableMapping, UnknownTable
from tactile_perception.estimating.labels import EULER_COMPONENTS

Array = NDArray[np.float64]

CONVENTIONS_NAME = "conventions.json"
#: Tools with these columns touch at pose - move, some at pose + move, which signs tell, go to the pose, and
#: take the image there (`collect_data` of dexterousrobot/tactile_servo_control and what it came from).
MOVES = tuple(f"move_{k}" for k in range(1, 7))
_SHEARED = (0, 1, 5)  # x, y and gamma; depth and tilt are those of the pose
#: Columns of pose, and of the shear that may go with it, in the names of several generations of tools.
COLUMN_SETS: tuple[tuple[tuple[str, ...], tuple[tuple[str, ...], ...]], ...] = (
    (layout.POSE_COLUMNS, (layout.SHEAR_COLUMNS,)),
    (
        tuple(f"pose_{k}" for k in range(1, 7)),
        (tuple(f"shear_{k}" for k in range(1, 7)), MOVES),
    ),
    (AXES, (tuple(f"d{axis}" for axis in AXES),)),
)
#: Columns that say nothing of the label.
_KNOWN_OTHERS = ("object_", "target_", "base_sensor_", "stamp_ns", "obj_", "pose_id", "sensor_video")


@dataclass(frozen=True)
class ConventionSettings(Settings):
    """How a lab's labels differ from the paper's: what is read is turned into mm, degrees and its signs."""

    flip: tuple[str, ...] = setting((), choices=EULER_COMPONENTS, doc="components with the opposite sign")
    length_unit: str = setting("mm", choices=("mm", "m"), doc="unit of x, y, z in the table")
    angle_unit: str = setting("deg", choices=("deg", "rad"), doc="unit of alpha, beta, gamma in the table")

    def factors(self) -> NDArray[np.float64]:
        """What to multiply a row's numbers (6,) with to get mm and degrees."""
        length = 1e3 if self.length_unit == "m" else 1.0
        angle = math.degrees(1.0) if self.angle_unit == "rad" else 1.0
        signs = np.where([name in self.flip for name in EULER_COMPONENTS], -1.0, 1.0)
        return signs * np.array([length] * 3 + [angle] * 3)


def read_conventions(folder: Path, report: DatasetReport) -> ConventionSettings:
    """What `conventions.json` says, the paper's conventions where there is none.

    Raises `DatasetError` if the file is there and cannot be used: labels would be wrong without it.
    """
    path = folder / CONVENTIONS_NAME
    if not path.exists():
        return ConventionSettings()
    try:
        values = parse_json(read_text(path))
        if not isinstance(values, dict):
            raise SettingError("must hold names and values")
        conventions = ConventionSettings.from_mapping(values)
    except (ValueError, OSError) as error:
        raise DatasetError(f"{path}: {error}") from error
    flipped = ", ".join(conventions.flip) or "no signs"
    report.notes.append(
        f"{CONVENTIONS_NAME}: flipped {flipped}; lengths in {conventions.length_unit}, "
        f"angles in {conventions.angle_unit}"
    )
    return conventions


class Row(NamedTuple):
    """A sample: its label is `pose` + `shear`, (6,) in mm and degrees; `force` (3,) in N."""

    name: str
    pose: Array
    shear: Array
    force: Array


def read_table(
    path: Path, mapping: TableMapping | None, labelled: Sequence[str] | None,
    conventions: ConventionSettings, report: DatasetReport,
) -> tuple[list[Row], TableMapping]:  # fmt: skip
    """The rows with usable labels, and which columns they are from; what is not usable is reported.

    Raises `DatasetError` if columns that are needed are not there.

    Parameters
    ----------
    mapping : None, or without columns, for those that public tools write
    labelled : components that the folder says are labelled, if it does: others need no column
    """
    names: list[str] = []
    numbers: list[Array] = []
    before = 0
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        lines = _lines(_reader(file), path, report)
        _, columns = next(lines, (0, []))
        columns = [name.strip() for name in columns]
        if mapping is None or not mapping.image:
            known = _known_mapping(columns, path, labelled, report)
            mapping = replace(mapping, **known) if mapping else TableMapping(**known)
        if mapping.lacking:
            raise DatasetError(
                f"{path}: {', '.join(mapping.lacking)} must be there to turn poses ({mapping.convention}) "
                "into ours; where it was held at a value, write {value: 0} for it in the mapping file"
            )
        _check_columns(columns, mapping, path, report)
        place = {name: k for k, name in enumerate(columns)}
        for number, fields in lines:
            report.rows += 1
            before = len(names)
            name = fields[place[mapping.image]].strip() if place[mapping.image] < len(fields) else ""
            values = _numbers(fields, mapping, place, name or f"line {number}", report)
            if values is None:
                continue
            if not name:
                report.add("row without an image name", f"line {number}")
            else:
                names.append(name)
                numbers.append(values)
    if len(names) > before and not _ended(path):  # the table's last row is among them
        report.add("last row without a line end, so that it may be cut (left out)", names.pop())
        numbers.pop()
    whole = np.array(numbers).reshape(-1, 15)
    factors = conventions.factors()  # signs and units first: a conversion takes what they make of the table
    pose, shear = mapping.converted(factors * whole[:, :6], factors * whole[:, 6:12])
    _settle_sums(path, pose, shear, mapping.moves, report)
    return list(map(Row, names, pose, shear, whole[:, 12:])), mapping


def read_header(path: Path) -> list[str]:
    """The names of a table's columns."""
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        return [name.strip() for name in next(_reader(file), [])]


def _reader(file: Iterable[str]) -> Iterator[list[str]]:
    """The fields of each line, between commas, semicolons or tabs, whichever its header has most of."""
    lines = (line.replace("\0", "") for line in file)  # as a crash of the machine may leave in a file
    header = next(iter(lines), "")
    separator = max(",;\t", key=header.count)
    return csv.reader(itertools.chain([header], lines), delimiter=separator, skipinitialspace=True)


def _lines(reader: Iterator[list[str]], path: Path, report: DatasetReport) -> Iterator[tuple[int, list[str]]]:
    """Number and fields of each line that csv can read; what it cannot is reported."""
    for number in itertools.count(1):
        try:
            fields = next(reader)
        except StopIteration:
            return
        except csv.Error as error:
            report.add("line that cannot be read", f"{path.name} line {number}: {error}")
            continue
        if fields:
            yield number, fields


def _numbers(
    fields: list[str], mapping: TableMapping, place: dict[str, int], where: str, report: DatasetReport
) -> Array | None:
    """Pose, shear and force (15,) of a row; None where it has no label, with the reason reported.

    What has no column is 0; a force that is missing or not a number is NaN.
    """
    if len(fields) > len(place):
        report.add("row with more fields than there are columns", where)
        return None

    def number(column: Column | None) -> float:
        if column is None or not column.name:
            return column.value if column else 0.0
        return column.factor * float(fields[place[column.name]])

    try:
        label = [number(column) for column in (*mapping.pose, *mapping.shear)]
    except (IndexError, ValueError):
        report.add("row with a label that is missing or not a number", where)
        return None
    if not np.isfinite(label).all():
        report.add("row with a non-finite label", where)
        return None
    try:
        force = [number(column) for column in mapping.force]
    except (IndexError, ValueError):
        report.add("row with a force that is missing or not a number (kept, without it)", where)
        force = [math.nan] * 3
    return np.array(label + force)


def _known_mapping(
    columns: list[str], path: Path, labelled: Sequence[str] | None, report: DatasetReport
) -> dict[str, Any]:
    """The columns that public tools write, as far as a table has them; `UnknownTable` if it has others."""
    image = next((name for name in layout.IMAGE_COLUMNS if name in columns), None)
    pose, shears = max(COLUMN_SETS, key=lambda item: sum(name in columns for name in item[0]))
    shear = max(shears, key=lambda names: sum(name in columns for name in names))
    wanted = [k for k, name in enumerate(EULER_COMPONENTS) if labelled is None or name in labelled]
    missing = [pose[k] for k in wanted if pose[k] not in columns]
    if image is None or (labelled is None and pose[2] in missing):
        absent = [*([] if image else [" or ".join(layout.IMAGE_COLUMNS)]), *missing]
        raise UnknownTable(path, f"has no column {', '.join(absent)}", columns)
    absent = [shear[k] for k in wanted if shear[k] not in columns]
    if 0 < len(absent) < len(wanted):
        raise DatasetError(f"{path}: has only some shear columns; missing {', '.join(absent)}")
    if absent:
        report.notes.append(
            f"{path.name} has no shear_* columns: pose_* taken as the whole surface contact pose"
        )

    def found(names: Sequence[str]) -> tuple[Column | None, ...]:
        return tuple(Column(name) if name in columns else None for name in names)

    sheared = found(shear)
    if shear == MOVES:
        sheared = tuple(column if k in _SHEARED else None for k, column in enumerate(sheared))
    if pose != layout.POSE_COLUMNS:
        used = [name for name in (*pose, *shear) if name in columns]
        report.notes.append(f"{path.name}: labels read from {', '.join(used)}")
    force = found(layout.FORCE_COLUMNS)
    return {"image": image, "pose": found(pose), "shear": sheared, "force": force, "moves": shear == MOVES}


def _check_columns(columns: list[str], mapping: TableMapping, path: Path, report: DatasetReport) -> None:
    """`UnknownTable` unless the table has the columns that it is to be read by; those not used are noted."""
    used = [mapping.image, *(column.name for group in mapping.groups for column in group if column)]
    if missing := [name for name in used if name and name not in columns]:
        raise UnknownTable(path, f"has no column {', '.join(missing)}", columns)
    others = [name for name in columns if name not in used and not name.startswith(_KNOWN_OTHERS)]
    if others:
        report.notes.append(f"{path.name}: columns not used: {', '.join(others)}")


def _ended(path: Path) -> bool:
    """Whether the last row has a line end: a table that was cut may end within a number."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 1))
        return file.read(1) in (b"\n", b"\r", b"")


def _settle_sums(path: Path, pose: Array, shear: Array, moves: bool, report: DatasetReport) -> None:
    """Say which components come from both pose and shear; of moves, the pose is where they ended."""
    if not len(pose):
        return
    both = (np.ptp(pose, axis=0) > 0) & (np.ptp(shear, axis=0) > 0)
    if not both.any():
        return
    names = ", ".join(name for name, moving in zip(EULER_COMPONENTS, both, strict=True) if moving)
    if moves:
        shear[:, both] = 0.0
        report.notes.append(f"{path.name}: {names} of the pose, where the move had ended")
    else:
        report.notes.append(f"{path.name}: pose and shear both vary in {names}; their sum is taken")
