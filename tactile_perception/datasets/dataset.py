"""Reader of the public tactile data layout: `targets_images.csv` beside `processed_images/`.

A row holds an image's name, the normal contact `pose_*` and the post-contact shear `shear_*` (mm, degrees);
their sum is the Euler surface contact pose. Nothing that is wrong with a folder passes in silence: what is
left out, repaired or assumed is named and counted in a `DatasetReport`.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import read_text
from tactile_base.settings import SettingError
from tactile_perception.datasets import layout, lenient_json
from tactile_perception.datasets.layout import DatasetError, DatasetReport
from tactile_perception.datasets.table import Row, read_conventions, read_table
from tactile_perception.datasets.writer import DatasetWriter
from tactile_perception.estimating.image import (
    Image,
    ImageError,
    check_image,
    common_shape,
    list_images,
    read_image,
    resolve,
)
from tactile_perception.estimating.labels import labels_from_euler
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor

__all__ = [
    "DatasetError",
    "DatasetReport",
    "DatasetWriter",
    "TactileDataset",
    "TactileFolder",
    "open_folder",
    "read_dataset",
]


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
        expected = self.preprocessing.crop_shape if self.processed else self.preprocessing.raw_shape
        return check_image(read_image(path), expected, str(path))

    def reference(self) -> Image | None:
        """The image without contact, which tools keep as number 0; None where there is no usable one."""
        path = self.image_folder / layout.REFERENCE_NAME
        try:
            return read_image(path) if path.exists() else None
        except ImageError:
            return None

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

    Raises `DatasetError` if the folder, its table or its images are not there, or no row is usable.

    Parameters
    ----------
    folder : holds `targets_images.csv` and `processed_images/` (cropped, thresholded) or `images/` (raw)
    preprocessing : overrides what `processed_image_params.json` says, as with those of a model; where they
        differ, the report says in what. Processed images may have any one size.
    """
    folder = Path(folder)
    report = DatasetReport(folder)
    tables, image_folder = _find_parts(folder, report)
    parameters = _read_parameters(folder, report)
    conventions = read_conventions(folder, report)
    processed = image_folder.name == layout.IMAGES_NAME
    rows = [row for table in tables for row in read_table(table, conventions, report)]
    rows = _with_images(rows, image_folder, report)
    rows = _without_duplicates(rows, report)
    if not rows:
        raise DatasetError("\n".join([f"{folder}: no usable sample", *report.lines()]))
    names = [name for name, _ in rows]
    settings = preprocessing or _preprocessing(parameters, processed, report)
    if preprocessing and processed:
        _note_differences(preprocessing, parameters, report)
    if processed or preprocessing is None:  # a model's settings say what camera images must be
        settings = _suited(settings, common_shape(image_folder, names), processed, report)
    report.samples = len(rows)
    return TactileFolder(
        folder=folder,
        image_folder=image_folder,
        names=names,
        euler_mm_deg=np.array([euler for _, euler in rows]),
        preprocessing=settings,
        processed=processed,
        parameters=parameters,
        report=report,
    )


def training_part(folder: Path) -> Path:
    """The part `train` of a folder of splits, or the folder itself."""
    return folder / "train" if (folder / "train").is_dir() else folder


def read_dataset(
    folder: Path | str,
    preprocessing: PreprocessingSettings | None = None,
    changes: Mapping[str, Any] | None = None,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TactileDataset:
    """Load a data folder into memory, leaving out and reporting images that cannot be used.

    Parameters
    ----------
    preprocessing : if not those that the folder states
    changes : settings of the pre-processing that are to be others, as the size
    limit : take this many samples, spread evenly over the rows (published tables are sorted by depth)
    progress : called with (done, total)
    """
    source = open_folder(folder, preprocessing)
    source.preprocessing = source.preprocessing.replaced(**(changes or {}))
    chosen = np.arange(len(source))
    if limit is not None and limit < len(source):
        chosen = np.linspace(0, len(source) - 1, limit).round().astype(int)
        source.report.notes.append(f"took {limit} of {len(source)} samples, spread over the table")
    kept: list[int] = []
    images: list[Image] = []
    content = Counter[str]()
    digest = hashlib.sha256()
    for count, (index, image, file_hash) in enumerate(_loaded(source, chosen.tolist())):
        if isinstance(image, ImageError):
            source.report.add("unusable image", str(image))
            continue
        images.append(image)
        kept.append(index)
        content[file_hash] += 1
        if content[file_hash] > 1:
            source.report.add("image identical to an earlier one (kept)", source.names[index])
        label = np.ascontiguousarray(source.euler_mm_deg[index], dtype="<f8").tobytes()
        digest.update(source.names[index].encode() + b"\0" + label + file_hash.encode())
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


def _loaded(source: TactileFolder, chosen: list[int]) -> Iterator[tuple[int, Image | ImageError, str]]:
    """(index, pre-processed image or what is wrong with it, SHA-256 of its file), on all cores, in order."""
    own = threading.local()

    def load(index: int) -> tuple[int, Image | ImageError, str]:
        if not hasattr(own, "preprocessor"):
            own.preprocessor = Preprocessor(source.preprocessing)
        try:
            image = source.resized(index, own.preprocessor)
        except ImageError as error:
            return index, error, ""
        file = (source.image_folder / source.names[index]).read_bytes()
        return index, image, hashlib.sha256(file).hexdigest()

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(load, chosen)


def _find_parts(folder: Path, report: DatasetReport) -> tuple[list[Path], Path]:
    """The label tables and the image folder, or an error that says what the layout is."""
    if not folder.is_dir():
        raise DatasetError(f"{folder}: is not a folder")
    others = ", ".join(f"{name}/" for name in layout.IMAGE_FOLDERS[1:])
    right = f"a data folder holds {layout.TARGETS_NAME} and {layout.IMAGES_NAME}/ (or {others})"
    tables = [folder / name for name in layout.TARGETS_NAMES if (folder / name).is_file()][:1]
    if (folder / layout.JOURNAL_NAME).is_file():
        note = "the collection of this folder was not finished; read as well"
        report.notes.append(f"{layout.JOURNAL_NAME}: {note}")
        tables.append(folder / layout.JOURNAL_NAME)
    if not tables:
        raise DatasetError(f"{folder}: has no {layout.TARGETS_NAME}; {right}")
    for name in layout.IMAGE_FOLDERS:
        if (folder / name).is_dir():
            return tables, folder / name
    raise DatasetError(f"{folder}: has neither {layout.IMAGES_NAME}/ nor {others}; {right}")


def _read_parameters(folder: Path, report: DatasetReport) -> dict[str, Any]:
    """The contents of every JSON file of the folder; one that cannot be repaired is named and left out."""
    parameters: dict[str, Any] = {}
    for path in sorted(folder.glob("*.json")):
        try:
            parameters[path.name], repairs = lenient_json.loads(read_text(path), path.name)
        except (lenient_json.JsonError, UnicodeDecodeError, OSError) as error:
            report.add("unreadable JSON file (ignored)", f"{path.name}: {error}")
            continue
        report.notes += repairs
    return parameters


def _preprocessing(
    parameters: dict[str, Any], processed: bool, report: DatasetReport
) -> PreprocessingSettings:
    """Pre-processing settings of a folder from the JSON file that holds them."""
    names = layout.IMAGE_PARAMS_NAMES + (() if processed else layout.CAMERA_PARAMS_NAMES)
    name = next((name for name in names if isinstance(parameters.get(name), dict)), None)
    if name is None:
        report.notes.append(f"no {layout.IMAGE_PARAMS_NAME}: assumed the default crop and threshold")
        return PreprocessingSettings()
    params = parameters[name]
    values = {key: params[key] for key in ("bbox", "circle_mask_radius") if params.get(key) is not None}
    values |= {key: params[key] for key in ("median", "threshold_method") if key in params}
    if params.get("thresh") is not None:
        block_and_offset = params["thresh"]
        if not isinstance(block_and_offset, list) or len(block_and_offset) != 2:
            raise DatasetError(
                f"{report.folder}: {name}: thresh = {block_and_offset!r}: must be a block and an offset"
            )
        values["threshold_block"], values["threshold_offset"] = block_and_offset
    try:
        return PreprocessingSettings.from_mapping(values, where=name)
    except SettingError as error:
        raise DatasetError(f"{report.folder}: {error}") from error


def _note_differences(
    wanted: PreprocessingSettings, parameters: dict[str, Any], report: DatasetReport
) -> None:
    """Say in which settings the images of a folder are not those that a model was trained on."""
    if any(name in parameters for name in layout.IMAGE_PARAMS_NAMES):
        stated = _preprocessing(parameters, True, report)
        stated = stated.replaced(size=wanted.size, redraw_radius=wanted.redraw_radius)
        if stated != wanted:
            report.notes.append(f"images pre-processed otherwise than wanted: {stated.differences(wanted)}")


def _suited(
    settings: PreprocessingSettings, shape: tuple[int, int] | None, processed: bool, report: DatasetReport
) -> PreprocessingSettings:
    """Settings for the size that most images have, where that is another than the settings say."""
    expected = settings.crop_shape if processed else settings.raw_shape
    if shape is None or shape == expected:
        return settings
    rows, columns = shape
    found, right = f"{columns}x{rows}", f"{expected[1]}x{expected[0]}"
    if processed:
        report.notes.append(
            f"processed images are {found}, not {right} as the settings say: taken as they are; the crop "
            "of the camera image is unknown"
        )
    else:
        report.notes.append(f"camera images are {found}, not {right}: taken whole, without a mask")
    return settings.replaced(
        bbox=(0, 0, columns, rows),
        raw_width=columns if not processed else max(columns, settings.raw_width),
        raw_height=rows if not processed else max(rows, settings.raw_height),
        circle_mask_radius=settings.circle_mask_radius if processed else 0,
    )


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
    """The rows that have an image, in the table's order, named after the file."""
    present = list_images(image_folder)
    found: list[Row] = []
    for name, euler in rows:
        file = resolve(image_folder, name, present)
        if file is None:
            report.add("row without its image", Path(name).name)
        else:
            found.append((file, euler))
    named = {Path(name).name for name, _ in rows}.union(*report.problems.values())
    for name in sorted(present - named - {layout.REFERENCE_NAME}):
        report.add("image without its row", name)
    return found
