"""The label table of a data folder: its columns in the names that public tools use, and its rows.

A row's label is the sum of its contact pose and its shear, in mm and degrees. Where a lab's signs or units
are others, a file `conventions.json` in the folder says so, and every reader applies it::

    {"flip": ["x", "y", "gamma"], "length_unit": "mm", "angle_unit": "deg"}
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json, read_text
from tactile_base.settings import SettingError, Settings, setting
from tactile_perception.datasets import layout
from tactile_perception.datasets.layout import AXES, DatasetError, DatasetReport
from tactile_perception.estimating.labels import EULER_COMPONENTS

CONVENTIONS_NAME = "conventions.json"
#: Columns of pose, and of the shear that may go with it, in the names of several generations of tools.
COLUMN_SETS: tuple[tuple[tuple[str, ...], tuple[tuple[str, ...], ...]], ...] = (
    (layout.POSE_COLUMNS, (layout.SHEAR_COLUMNS,)),
    (
        tuple(f"pose_{k}" for k in range(1, 7)),
        (tuple(f"shear_{k}" for k in range(1, 7)), tuple(f"move_{k}" for k in range(1, 7))),
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


Row = tuple[str, NDArray[np.float64]]


def read_table(path: Path, conventions: ConventionSettings, report: DatasetReport) -> list[Row]:
    """(image name, Euler pose in mm and degrees) of each row with usable labels; the rest is reported.

    Raises `DatasetError` if the columns of image and pose are not there.
    """
    rows: list[Row] = []
    parts: list[NDArray[np.float64]] = []
    factors = conventions.factors()
    before = 0
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        # A crash of the machine may leave zero bytes in a file.
        lines = _lines(csv.reader(line.replace("\0", "") for line in file), path, report)
        _, columns = next(lines, (0, []))
        image_column, groups = _columns(columns, path, report)
        place = {name: k for k, name in enumerate(columns)}
        for number, fields in lines:
            report.rows += 1
            before = len(rows)
            name = fields[place[image_column]].strip() if place[image_column] < len(fields) else ""
            values = _numbers(fields, columns, groups, place, name or f"line {number}", report)
            if values is None:
                continue
            if not name:
                report.add("row without an image name", f"line {number}")
            else:
                rows.append((name, factors * values.sum(axis=0)))
                parts.append(values)
    if len(rows) > before:  # the table's last row is among them
        _drop_unended(path, rows, report)
    _note_sums(path, parts, report)
    return rows


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
    fields: list[str],
    columns: list[str],
    groups: list[list[str | None]],
    place: dict[str, int],
    where: str,
    report: DatasetReport,
) -> NDArray[np.float64] | None:
    """The numbers of a row, one line a group of columns; None where it has none, with the reason reported."""
    if len(fields) > len(columns):
        report.add("row with more fields than there are columns", where)
        return None
    try:
        values = np.array(
            [[0.0 if name is None else float(fields[place[name]]) for name in group] for group in groups]
        )
    except (IndexError, ValueError):
        report.add("row with a label that is missing or not a number", where)
        return None
    if not np.isfinite(values).all():
        report.add("row with a non-finite label", where)
        return None
    return values


def _columns(columns: list[str], path: Path, report: DatasetReport) -> tuple[str, list[list[str | None]]]:
    """The image column, and the label columns in groups to be added up; None for one that counts as zero."""
    image = next((name for name in layout.IMAGE_COLUMNS if name in columns), None)
    pose, shears = max(COLUMN_SETS, key=lambda item: sum(name in columns for name in item[0]))
    missing = [name for name in pose if name not in columns]
    if image is None or pose[2] in missing:
        absent = [*([] if image else [" or ".join(layout.IMAGE_COLUMNS)]), *missing]
        found = ", ".join(columns) or "none"
        raise DatasetError(f"{path}: has no column {', '.join(absent)}; its columns: {found}")
    if missing:
        report.notes.append(f"{path.name} has no column {', '.join(missing)}: taken as 0")
    groups: list[list[str | None]] = [[name if name in columns else None for name in pose]]
    shear = max(shears, key=lambda names: sum(name in columns for name in names))
    absent = [name for name in shear if name not in columns]
    if not absent:
        groups.append(list(shear))
    elif len(absent) < len(shear):
        raise DatasetError(f"{path}: has only some shear columns; missing {', '.join(absent)}")
    else:
        report.notes.append(
            f"{path.name} has no shear_* columns: pose_* taken as the whole surface contact pose"
        )
    _note_other_names(path, columns, [image, *pose, *shear], report)
    return image, groups


def _note_other_names(path: Path, columns: list[str], used: list[str], report: DatasetReport) -> None:
    if "pose_x" not in used:
        report.notes.append(f"{path.name}: labels read from {', '.join(c for c in columns if c in used[1:])}")
    others = [name for name in columns if name not in used and not name.startswith(_KNOWN_OTHERS)]
    if others:
        report.notes.append(f"{path.name}: columns not used: {', '.join(others)}")


def _drop_unended(path: Path, rows: list[Row], report: DatasetReport) -> None:
    """Leave out a last row that has no line end: a table that was cut may end within a number."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - 1))
        ended = file.read(1) in (b"\n", b"\r", b"")
    if not ended:
        name, _ = rows.pop()
        report.add("last row without a line end, so that it may be cut (left out)", name)


def _note_sums(path: Path, parts: list[NDArray[np.float64]], report: DatasetReport) -> None:
    """Say which components come from both pose and shear: tools differ in what that means."""
    if not parts or len(parts[0]) < 2:
        return
    spread = np.ptp(np.array(parts), axis=0)
    both = [name for name, moves in zip(EULER_COMPONENTS, (spread > 0).all(axis=0), strict=True) if moves]
    if both:
        report.notes.append(f"{path.name}: pose and shear both vary in {', '.join(both)}; their sum is taken")
