"""Reader of the public tactile data layout: `targets_images.csv` beside `processed_images/`.

A row holds an image's name, the normal contact `pose_*` and the post-contact shear `shear_*` (mm, degrees);
their sum is the Euler surface contact pose. Nothing that is wrong with a folder passes in silence: what is
left out, repaired or assumed is named and counted in a `DatasetReport`.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import read_text
from tactile_base.settings import SettingError
from tactile_perception.datasets import layout, lenient_json
from tactile_perception.datasets.folder import TactileFolder
from tactile_perception.datasets.image_settings import image_settings
from tactile_perception.datasets.layout import DatasetError, DatasetReport, is_sharded
from tactile_perception.datasets.mapping import TableMapping, UnknownTable
from tactile_perception.datasets.shards import ShardedFolder, open_shards
from tactile_perception.datasets.table import Row, read_conventions, read_header, read_table
from tactile_perception.datasets.writer import DatasetWriter
from tactile_perception.estimating.contact_model import SURFACE, ContactModel
from tactile_perception.estimating.image import (
    Image,
    ImageError,
    common_kind,
    handful,
    list_images,
    resolve,
)
from tactile_perception.estimating.labels import EULER_COMPONENTS
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


_FEW = 30  # rows, in which a component may be 0 by chance
_TRIED = 20  # rows whose images tell where all of them are
_OTHERS = ", ".join(f"{name}/" for name in layout.IMAGE_FOLDERS[1:])
_RIGHT = f"a data folder holds {layout.TARGETS_NAME} and {layout.IMAGES_NAME}/ (or {_OTHERS})"


@dataclass
class TactileDataset:
    """A whole data set in memory.

    Attributes
    ----------
    images : uint8 (N, size, size), or in color (N, size, size, 3)
    euler_mm_deg : float64 (N, 6), Euler surface contact pose of X_fs
    force : float64 (N, 3) in N
    labelled : those of their components that are labelled; the others mean nothing
    sha256 : hash over names, labels and image files, in order
    reference : the processed image without contact, where images are compared with it
    rest : as one of `images`, without contact; None where the folder has none, or images are compared with it
    """

    names: list[str]
    images: NDArray[np.uint8]
    euler_mm_deg: NDArray[np.float64]
    force: NDArray[np.float64]
    labelled: tuple[str, ...]
    preprocessing: PreprocessingSettings
    sha256: str
    report: DatasetReport
    reference: Image | None = None
    rest: Image | None = None

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def labels(self) -> NDArray[np.float64]:
        """float64 (N, 6), xi_sf in mm and rad."""
        return self.labels_for(SURFACE)

    def labels_for(self, model: ContactModel) -> NDArray[np.float64]:
        """What a network of this contact model is to say, (N, K); NaN where that is not labelled."""
        try:
            return model.labels(self.euler_mm_deg, self.force, self.labelled)
        except SettingError as error:
            raise DatasetError(f"{self.report.folder}: {error}") from error


def open_folder(
    folder: Path | str,
    preprocessing: PreprocessingSettings | None = None,
    mapping: TableMapping | None = None,
) -> TactileFolder:
    """Read a folder's labels and settings, match rows with images, and report what does not match.

    Raises `DatasetError` if the folder, its table or its images are not there, no row is usable, or camera
    images are not of the size of `preprocessing`.

    Parameters
    ----------
    folder : holds `targets_images.csv` and `processed_images/` (cropped, thresholded) or `images/` (raw), or
        shards
    preprocessing : overrides what `processed_image_params.json` says, as with those of a model; where they
        differ, the report says in what. Processed images may have any one size.
    mapping : how to read the table, if it is not one that public tools write
    """
    folder = Path(folder)
    if is_sharded(folder):
        return open_shards(folder, preprocessing)
    report = DatasetReport(folder)
    tables = _find_tables(folder, mapping, report)
    parameters = _read_parameters(folder, report)
    conventions = read_conventions(folder, report)
    stated = _stated_components(parameters, folder)
    read = [read_table(table, mapping, stated or None, conventions, report) for table in tables]
    rows = [row for part, _ in read for row in part]
    by_hand = mapping is not None and bool(mapping.image)
    labelled = stated or _labelled(rows, read[0][1], by_hand, report)
    image_folder = _find_images(folder, [row.name for row in rows])
    rows = _with_images(rows, image_folder, report)
    rows = _without_duplicates(rows, report)
    if not rows:
        raise DatasetError("\n".join([f"{folder}: no usable sample", *report.lines()]))
    names = [row.name for row in rows]
    kind = common_kind(image_folder, names)
    processed = image_folder.name == layout.IMAGES_NAME
    if not processed and kind is not None and kind.binary:
        report.notes.append("images are binary: taken as processed ones")
        processed = True
    report.samples = len(rows)

    def some_images() -> tuple[list[Image], bool]:
        reference = layout.REFERENCE_NAME not in names and (image_folder / layout.REFERENCE_NAME).exists()
        return handful(image_folder, names, kind), reference

    return TactileFolder(
        folder=folder,
        image_folder=image_folder,
        names=names,
        pose=np.array([row.pose for row in rows]),
        shear=np.array([row.shear for row in rows]),
        force=np.array([row.force for row in rows]),
        sensor=_sensors(names, parameters),
        preprocessing=image_settings(
            preprocessing, parameters, kind, None if processed else some_images, report
        ),
        processed=processed,
        parameters=parameters,
        report=report,
        labelled=labelled,
        forces=read[0][1].forces,
        kind=kind,
    )


def training_part(folder: Path) -> Path:
    """The part for training of a folder of parts, or the folder itself."""
    return layout.parts_of(folder).get("train", folder)


def read_dataset(
    folder: Path | str,
    preprocessing: PreprocessingSettings | None = None,
    changes: Mapping[str, Any] | None = None,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    complete: bool = True,
) -> TactileDataset:
    """Load a data folder into memory, leaving out and reporting images that cannot be used.

    Parameters
    ----------
    preprocessing : if not those that the folder states
    changes : settings of the pre-processing that are to be others, as the size
    limit : take this many samples, spread evenly over the rows (published tables are sorted by depth)
    progress : called with (done, total)
    complete : refuse data of which not all six components of the pose are labelled
    """
    source = open_folder(folder, preprocessing)
    if complete:
        source.check_labelled()
    source.preprocessing = source.preprocessing.replaced(**(changes or {}))
    chosen = np.arange(len(source))
    if limit is not None and limit < len(source):
        chosen = np.linspace(0, len(source) - 1, limit).round().astype(int)
        source.report.notes.append(f"took {limit} of {len(source)} samples, spread over the table")
    return read_rows(source, chosen, progress)


def read_rows(
    source: TactileFolder, chosen: NDArray[np.int64], progress: Callable[[int, int], None] | None = None
) -> TactileDataset:
    """Load some samples of an opened folder, as above."""
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
    whole, preprocessor = len(chosen) == len(source), source.preprocessor()
    source.report.samples = len(kept)
    if not kept:
        raise DatasetError("\n".join([f"{source.folder}: no readable image", *source.report.lines()]))
    return TactileDataset(
        names=[source.names[index] for index in kept],
        images=np.stack(images),
        euler_mm_deg=source.euler_mm_deg[kept],
        force=source.force[kept],
        labelled=(*source.labelled, *source.forces),
        preprocessing=source.preprocessing,
        sha256=source.sha256 if isinstance(source, ShardedFolder) and whole else digest.hexdigest(),
        report=source.report,
        reference=preprocessor.reference,
        rest=_at_rest(source, preprocessor),
    )


def _at_rest(source: TactileFolder, preprocessor: Preprocessor) -> Image | None:
    """The image without contact, pre-processed to uint8 (size, size[, 3]); None where it is of no use."""
    image = None if source.preprocessing.difference else source.reference()
    if image is None:
        return None
    try:
        return preprocessor.resized(image if source.processed else preprocessor.processed(image))
    except ImageError:  # of another size or kind than the others, which do without it
        return None


def _loaded(source: TactileFolder, chosen: list[int]) -> Iterator[tuple[int, Image | ImageError, str]]:
    """(index, pre-processed image or what is wrong with it, SHA-256 of its file), on all cores, in order."""
    own_preprocessor = source.preprocessor_of_thread()

    def load(index: int) -> tuple[int, Image | ImageError, str]:
        try:
            data = source.stored(index)
            image = source.resized(index, own_preprocessor(), data)
        except ImageError as error:
            return index, error, ""
        return index, image, hashlib.sha256(data).hexdigest()

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(load, chosen)


def _find_tables(folder: Path, mapping: TableMapping | None, report: DatasetReport) -> list[Path]:
    """The label tables, or an error that says what is there and what the layout is."""
    if not folder.is_dir():
        raise DatasetError(f"{folder}: is not a folder")
    names = (mapping.table,) if mapping and mapping.table else layout.TARGETS_NAMES
    tables = [folder / name for name in names if (folder / name).is_file()][:1]
    if (folder / layout.JOURNAL_NAME).is_file():
        note = "the collection of this folder was not finished; read as well"
        report.notes.append(f"{layout.JOURNAL_NAME}: {note}")
        tables.append(folder / layout.JOURNAL_NAME)
    if tables:
        return tables
    missing = f"has no {', '.join(names)}"
    if parts := layout.parts_of(folder):
        raise DatasetError(
            f"{folder}: {missing}; name one of its parts {', '.join(map(str, parts.values()))}"
        )
    others = sorted(path for path in folder.glob("*.csv") if path.is_file())
    if others:
        raise UnknownTable(others[0], f"{folder} {missing}", read_header(others[0]))
    raise DatasetError(f"{folder}: {missing}; {_RIGHT}")


def _find_images(folder: Path, names: list[str]) -> Path:
    """The folder in which the images of a table are, or from which it names them by a path."""
    there = [folder / name for name in layout.IMAGE_FOLDERS if (folder / name).is_dir()]
    for candidate in (*there, folder):
        present = list_images(candidate)
        if any(resolve(candidate, name, present) for name in names[:: max(1, len(names) // _TRIED)]):
            return candidate
    if not there:
        raise DatasetError(f"{folder}: has neither {layout.IMAGES_NAME}/ nor {_OTHERS}; {_RIGHT}")
    return there[0]


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


def _stated_components(parameters: dict[str, Any], folder: Path) -> tuple[str, ...]:
    """What the folder itself says is labelled; nothing where it does not say."""
    if layout.LABELS_NAME not in parameters:
        return ()
    stated = parameters[layout.LABELS_NAME]
    names = stated.get("components") if isinstance(stated, dict) else None
    if not isinstance(names, list) or not names or not set(map(str, names)) <= set(EULER_COMPONENTS):
        raise DatasetError(
            f"{folder / layout.LABELS_NAME}: components = {names!r}: must be a list of some of "
            f"{', '.join(EULER_COMPONENTS)}"
        )
    return tuple(name for name in EULER_COMPONENTS if name in names)


def _labelled(
    rows: list[Row], mapping: TableMapping, by_hand: bool, report: DatasetReport
) -> tuple[str, ...]:
    """Components that the table has; of one that is 0 in every row only a mapping by hand can say so."""
    empty: set[str] = set()
    if len(rows) >= _FEW and not by_hand:
        labels = np.array([row.pose + row.shear for row in rows])
        empty = {name for name, values in zip(EULER_COMPONENTS, labels.T, strict=True) if not values.any()}
    found = tuple(name for name in mapping.labelled if name not in empty)
    if missing := [name for name in EULER_COMPONENTS if name not in found]:
        report.notes.append(f"{', '.join(missing)} not labelled: without a column, or 0 in every row")
    return found


def _sensors(names: list[str], parameters: dict[str, Any]) -> NDArray[np.int64]:
    """Which of several simulated sensors, which take turns, each image is of."""
    made = parameters.get(layout.PARAMETERS_NAME)
    count = made.get("sensors", 1) if isinstance(made, dict) else 1
    return np.array([layout.image_number(name) % count if count > 1 else 0 for name in names])


def _without_duplicates(rows: list[Row], report: DatasetReport) -> list[Row]:
    """One row an image: repeated rows are dropped; where their labels disagree, all of them are."""
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        by_name.setdefault(row.name, []).append(row)
    kept: list[Row] = []
    for name, same in by_name.items():
        labels = [row.pose + row.shear for row in same]
        if any(not np.array_equal(labels[0], other) for other in labels[1:]):
            report.add("image with rows that disagree (all left out)", name)
            continue
        if len(same) > 1:
            report.add("repeated row (first kept)", name)
        kept.append(same[0])
    return kept


def _with_images(rows: list[Row], image_folder: Path, report: DatasetReport) -> list[Row]:
    """The rows that have an image, in the table's order, named after the file."""
    present = list_images(image_folder)
    found: list[Row] = []
    for row in rows:
        file = resolve(image_folder, row.name, present)
        if file is None:
            report.add("row without its image", Path(row.name).name)
        else:
            found.append(row._replace(name=file))
    named = {Path(row.name).name for row in rows}.union(*report.problems.values())
    for name in sorted(present - named - {layout.REFERENCE_NAME}):
        report.add("image without its row", name)
    return found
