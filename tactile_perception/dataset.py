"""Reader of the public tactile data layout: `targets_images.csv` beside `processed_images/`.

A row holds an image's name, the normal contact `pose_*` and the post-contact shear `shear_*` (mm, degrees);
their sum is the Euler surface contact pose. Nothing that is wrong with a folder passes in silence: what is
left out, repaired or assumed is named and counted in a `DatasetReport`.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_filter.settings import SettingError
from tactile_perception import lenient_json
from tactile_perception.dataset_layout import (
    IMAGE_COLUMNS,
    IMAGE_PARAMS_NAME,
    IMAGES_NAME,
    POSE_COLUMNS,
    RAW_IMAGES_NAME,
    SHEAR_COLUMNS,
    TARGETS_NAME,
    DatasetError,
    DatasetReport,
)
from tactile_perception.dataset_writer import DatasetWriter
from tactile_perception.labels import labels_from_euler
from tactile_perception.preprocessing import Image, ImageError, PreprocessingSettings, Preprocessor

__all__ = [
    "DatasetError",
    "DatasetReport",
    "DatasetWriter",
    "TactileDataset",
    "TactileFolder",
    "open_folder",
    "read_dataset",
]

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


@dataclass
class TactileFolder:
    """A data folder's rows and settings, images still on disk: `names[i]` has the label `euler_mm_deg[i]`."""

    folder: Path
    image_folder: Path
    names: list[str]
    euler_mm_deg: NDArray[np.float64]
    preprocessing: PreprocessingSettings
    processed: bool
    parameters: dict[str, Any]
    report: DatasetReport

    def __len__(self) -> int:
        return len(self.names)

    def image(self, index: int) -> Image:
        """Image `index` as stored, gray; `ImageError` if it cannot be read or has the wrong size."""
        path = self.image_folder / self.names[index]
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise ImageError(f"{path}: is not a readable image (truncated or of another format)")
        expected = self.preprocessing.crop_shape if self.processed else self.preprocessing.raw_shape
        if image.shape != expected:
            found, right = f"{image.shape[1]}x{image.shape[0]}", f"{expected[1]}x{expected[0]}"
            raise ImageError(f"{path}: is {found}, must be {right}")
        return np.asarray(image, np.uint8)

    def resized(self, index: int, preprocessor: Preprocessor) -> Image:
        """Image `index` pre-processed to uint8 (size, size)."""
        image = self.image(index)
        return preprocessor.resized(image if self.processed else preprocessor.binary(image))


@dataclass
class TactileDataset:
    """A whole data set in memory.

    Attributes
    ----------
    images : uint8 (N, size, size)
    euler_mm_deg : float64 (N, 6), Euler surface contact pose of X_fs
    labels : float64 (N, 6), xi_sf in mm and rad
    sha256 : hash over names, labels and image files, in order
    """

    names: list[str]
    images: NDArray[np.uint8]
    euler_mm_deg: NDArray[np.float64]
    labels: NDArray[np.float64]
    preprocessing: PreprocessingSettings
    sha256: str
    report: DatasetReport

    def __len__(self) -> int:
        return len(self.names)


def open_folder(folder: Path | str, preprocessing: PreprocessingSettings | None = None) -> TactileFolder:
    """Read a folder's labels and settings, match rows with images, and report what does not match.

    Parameters
    ----------
    folder : path
        Holds `targets_images.csv` and `processed_images/` (cropped, thresholded) or `images/` (raw).
    preprocessing : PreprocessingSettings, optional
        Overrides what `processed_image_params.json` says.

    Raises
    ------
    DatasetError
        If the folder, its table or its images are not there, or no row is usable.
    """
    folder = Path(folder)
    report = DatasetReport(folder)
    targets, image_folder = _find_parts(folder)
    parameters = _read_parameters(folder, report)
    settings = preprocessing or _preprocessing(parameters.get(IMAGE_PARAMS_NAME), report)
    rows = _read_rows(targets, report)
    rows = _without_duplicates(rows, report)
    rows = _with_images(rows, image_folder, report)
    if not rows:
        raise DatasetError("\n".join([f"{folder}: no usable sample", *report.lines()]))
    report.samples = len(rows)
    return TactileFolder(
        folder=folder,
        image_folder=image_folder,
        names=[name for name, _ in rows],
        euler_mm_deg=np.array([euler for _, euler in rows]),
        preprocessing=settings,
        processed=image_folder.name == IMAGES_NAME,
        parameters=parameters,
        report=report,
    )


def read_dataset(
    folder: Path | str,
    preprocessing: PreprocessingSettings | None = None,
    size: int | None = None,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TactileDataset:
    """Load a data folder into memory, leaving out and reporting images that cannot be used.

    Parameters
    ----------
    size : int, optional
        Side of the pre-processed images, if not the folder's.
    limit : int, optional
        Take this many samples, spread evenly over the rows (published tables are sorted by depth).
    progress : callable, optional
        Called with (done, total).
    """
    source = open_folder(folder, preprocessing)
    if size is not None:
        source.preprocessing = source.preprocessing.replaced(size=size)
    chosen = np.arange(len(source))
    if limit is not None and limit < len(source):
        chosen = np.linspace(0, len(source) - 1, limit).round().astype(int)
        source.report.notes.append(f"took {limit} of {len(source)} samples, spread over the table")
    preprocessor = Preprocessor(source.preprocessing)
    kept: list[int] = []
    images: list[Image] = []
    content = Counter[str]()
    digest = hashlib.sha256()
    for count, index in enumerate(chosen.tolist()):
        try:
            images.append(source.resized(index, preprocessor))
        except ImageError as error:
            source.report.add("unusable image", str(error))
            continue
        kept.append(index)
        file_hash = hashlib.sha256((source.image_folder / source.names[index]).read_bytes()).hexdigest()
        content[file_hash] += 1
        if content[file_hash] > 1:
            source.report.add("image identical to an earlier one (kept)", source.names[index])
        digest.update(_sample_key(source.names[index], source.euler_mm_deg[index], file_hash))
        if progress is not None:
            progress(count + 1, len(chosen))
    source.report.samples = len(kept)
    if not kept:
        raise DatasetError("\n".join([f"{source.folder}: no readable image", *source.report.lines()]))
    euler = source.euler_mm_deg[kept]
    return TactileDataset(
        names=[source.names[index] for index in kept],
        images=np.stack(images),
        euler_mm_deg=euler,
        labels=labels_from_euler(euler),
        preprocessing=source.preprocessing,
        sha256=digest.hexdigest(),
        report=source.report,
    )


def _sample_key(name: str, euler: NDArray[np.float64], file_hash: str) -> bytes:
    return name.encode() + b"\0" + np.ascontiguousarray(euler, dtype="<f8").tobytes() + file_hash.encode()


def _find_parts(folder: Path) -> tuple[Path, Path]:
    """The label table and the image folder, or an error that says what the layout is."""
    if not folder.is_dir():
        raise DatasetError(f"{folder}: is not a folder")
    layout = f"a data folder holds {TARGETS_NAME} and {IMAGES_NAME}/ (or {RAW_IMAGES_NAME}/)"
    targets = next(
        (folder / name for name in (TARGETS_NAME, "targets.csv") if (folder / name).is_file()), None
    )
    if targets is None:
        raise DatasetError(f"{folder}: has no {TARGETS_NAME}; {layout}")
    for name in (IMAGES_NAME, RAW_IMAGES_NAME):
        if (folder / name).is_dir():
            return targets, folder / name
    raise DatasetError(f"{folder}: has neither {IMAGES_NAME}/ nor {RAW_IMAGES_NAME}/; {layout}")


def _read_parameters(folder: Path, report: DatasetReport) -> dict[str, Any]:
    """The contents of every JSON file of the folder; one that cannot be repaired is named and left out."""
    parameters: dict[str, Any] = {}
    for path in sorted(folder.glob("*.json")):
        try:
            parameters[path.name], repairs = lenient_json.loads(path.read_text(), path.name)
        except (lenient_json.JsonError, UnicodeDecodeError) as error:
            report.add("unreadable JSON file (ignored)", f"{path.name}: {error}")
            continue
        report.notes += repairs
    return parameters


def _preprocessing(params: Any, report: DatasetReport) -> PreprocessingSettings:
    """Pre-processing settings of a folder from its `processed_image_params.json`."""
    if not isinstance(params, dict):
        report.notes.append(f"no {IMAGE_PARAMS_NAME}: assumed the default crop and threshold")
        return PreprocessingSettings()
    values: dict[str, Any] = {}
    if params.get("bbox") is not None:
        values["bbox"] = params["bbox"]
    if params.get("thresh") is not None:
        values["threshold_block"], offset = params["thresh"]
        values["threshold_offset"] = float(offset)
    if params.get("circle_mask_radius") is not None:
        values["circle_mask_radius"] = params["circle_mask_radius"]
    values.update({name: params[name] for name in ("median", "threshold_method") if name in params})
    try:
        return PreprocessingSettings.from_mapping(values, where=IMAGE_PARAMS_NAME)
    except SettingError as error:
        raise DatasetError(f"{report.folder}: {error}") from error


Row = tuple[str, NDArray[np.float64]]


def _read_rows(targets: Path, report: DatasetReport) -> list[Row]:
    """(image name, Euler pose) of each row with finite labels."""
    rows: list[Row] = []
    with targets.open(newline="") as file:
        reader = csv.DictReader(file)
        columns = list(reader.fieldnames or [])
        image_column, label_columns = _columns(columns, targets, report)
        for row in reader:
            report.rows += 1
            name = Path((row.get(image_column) or "").strip()).name
            where = name or f"line {reader.line_num}"
            try:
                values = [float(row[column]) for column in label_columns]
            except (TypeError, ValueError):
                report.add("row with a label that is missing or not a number", where)
                continue
            if not all(map(math.isfinite, values)):
                report.add("row with a non-finite label", where)
            elif not name:
                report.add("row without an image name", where)
            else:
                rows.append((name, np.array(values).reshape(-1, 6).sum(axis=0)))
    return rows


def _columns(columns: list[str], targets: Path, report: DatasetReport) -> tuple[str, tuple[str, ...]]:
    """The image column, and the label columns in the order that sums over (pose, shear)."""
    image_column = next((name for name in IMAGE_COLUMNS if name in columns), None)
    missing = [name for name in POSE_COLUMNS if name not in columns]
    if image_column is None:
        missing.insert(0, " or ".join(IMAGE_COLUMNS))
    if missing or image_column is None:
        raise DatasetError(
            f"{targets}: has no column {', '.join(missing)}; its columns: {', '.join(columns)}"
        )
    shear = [name for name in SHEAR_COLUMNS if name in columns]
    if len(shear) == len(SHEAR_COLUMNS):
        return image_column, POSE_COLUMNS + SHEAR_COLUMNS
    if shear:
        absent = [name for name in SHEAR_COLUMNS if name not in columns]
        raise DatasetError(f"{targets}: has only some shear columns; missing {', '.join(absent)}")
    report.notes.append(
        f"{targets.name} has no shear_* columns: pose_* taken as the whole surface contact pose"
    )
    return image_column, POSE_COLUMNS


def _without_duplicates(rows: list[Row], report: DatasetReport) -> list[Row]:
    """One row an image: repeated rows are dropped; where their labels disagree, all of them are."""
    by_name: dict[str, list[NDArray[np.float64]]] = {}
    for name, euler in rows:
        by_name.setdefault(name, []).append(euler)
    kept: list[Row] = []
    for name, labels in by_name.items():
        if any(not np.array_equal(labels[0], other) for other in labels[1:]):
            report.add("image with rows that disagree (all left out)", name)
            continue
        if len(labels) > 1:
            report.add("repeated row (first kept)", name)
        kept.append((name, labels[0]))
    return kept


def _with_images(rows: list[Row], image_folder: Path, report: DatasetReport) -> list[Row]:
    """The rows that have an image, in the table's order."""
    present = {path.name for path in image_folder.iterdir() if path.suffix.lower() in _IMAGE_SUFFIXES}
    for name, _ in rows:
        if name not in present:
            report.add("row without its image", name)
    with_rows = {name for name, _ in rows}
    named = with_rows.union(*report.problems.values()) if report.problems else with_rows
    for name in sorted(present - named):
        report.add("image without its row", name)
    return [row for row in rows if row[0] in present]
