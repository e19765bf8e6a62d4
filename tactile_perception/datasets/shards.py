"""Reader of a data set in shards: Parquet files of some thousand samples each, for what no folder holds.

A row is a sample: its processed image as it is stored elsewhere (a PNG), pose, shear and force. Rows lie in
random order and in groups, which are read whole. Of each file's metadata the key `tactile_servoing` holds, as
JSON, what a folder has beside its table: how images become inputs, what is labelled, the image without
contact. `tactile data shard` writes them (`sharding.write_shards`); every command that reads data folders
reads them, and training streams those that do not fit into memory.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_perception.datasets.folder import Array, TactileFolder
from tactile_perception.datasets.image_settings import image_settings
from tactile_perception.datasets.layout import SHARD_SUFFIX, DatasetError, DatasetReport
from tactile_perception.estimating.image import Image, ImageKind, unpacked
from tactile_perception.estimating.preprocessing import PreprocessingSettings

if TYPE_CHECKING:
    from pyarrow import ChunkedArray, Table
    from pyarrow.parquet import ParquetFile

METADATA_KEY = b"tactile_servoing"
IMAGE, NAME, POSE, SHEAR, FORCE, SENSOR = "image", "name", "pose", "shear", "force", "sensor"
MARKERS = "markers"  # only where a simulator knows them
#: What all files of a data set must have in common.
COMMON = ("preprocessing", "kind", "labelled", "forces", "reference")
_AT_HAND = 4  # groups of images that were read last
_MOST_SENSORS = 1_000_000  # of one data set


def parquet() -> Any:
    """The module `pyarrow.parquet`; `DatasetError` says how to get it."""
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise DatasetError("shards need pyarrow: pip install 'tactile_servoing[parquet]'") from error
    return parquet


@dataclass(frozen=True)
class Group:
    """Rows [start, stop) of the data set, which are row group `number` of a file."""

    path: Path
    number: int
    start: int
    stop: int

    def column(self, name: str) -> ChunkedArray:
        """What the rows have of it, as the images; `DatasetError` for a damaged file."""
        with _opened(self.path) as file:
            return _read(self.path, partial(file.read_row_group, self.number, columns=[name]))[name]


@dataclass
class ShardedFolder(TactileFolder):
    """A data set in shards, as a data folder whose images are processed.

    Attributes
    ----------
    groups : of rows that are read together
    sha256 : hash over names, labels and image files
    """

    groups: list[Group] = field(default_factory=list)
    sha256: str = ""
    packed_reference: str | None = None
    has_markers: bool = False

    def __post_init__(self) -> None:
        self._starts = np.array([group.start for group in self.groups])
        self._recent: OrderedDict[tuple[int, str], ChunkedArray] = OrderedDict()
        self._lock = threading.Lock()

    def stored(self, index: int) -> bytes:
        data: bytes = self._value(index, IMAGE)
        return data

    def markers(self, index: int) -> Array | None:
        if not self.has_markers:
            return None
        return np.array(self._value(index, MARKERS), np.float64).reshape(-1, 2)

    def _value(self, index: int, column: str) -> Any:
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        key = number, column
        with self._lock:
            if key not in self._recent:
                self._recent[key] = self.groups[number].column(column)
                if len(self._recent) > _AT_HAND:
                    self._recent.popitem(last=False)
            values = self._recent[key]
        return values[index - self.groups[number].start].as_py()

    def reference(self) -> Image | None:
        return self._reference

    @cached_property
    def _reference(self) -> Image | None:
        packed = self.packed_reference
        return None if packed is None else unpacked(packed, str(self.folder), self.preprocessing.color)


def open_shards(folder: Path, preprocessing: PreprocessingSettings | None = None) -> ShardedFolder:
    """Read labels and settings of all shards of a folder.

    Raises `DatasetError` for a file that is damaged or no shard of ours, for files that are missing, and for
    some that do not belong together.
    """
    paths = sorted(folder.glob(f"*{SHARD_SUFFIX}"))
    said, tables, groups = _contents(paths)
    _check_together(paths, said)
    if not groups:
        raise DatasetError(f"{folder}: no usable sample in its shards")
    first = said[0]
    report = DatasetReport(folder, groups[-1].stop, groups[-1].stop, notes=[f"shards: {len(paths)} files"])
    kind = ImageKind(tuple(first["kind"][0]), *first["kind"][1:])
    parameters = common_part([one["parameters"] for one in said])
    settings = PreprocessingSettings.from_mapping(first["preprocessing"], where=str(paths[0]))
    if preprocessing is not None:
        settings = image_settings(preprocessing, parameters, kind, None, report)

    def numbers(column: str) -> NDArray[np.float64]:
        return np.concatenate([_matrix(table[column]) for table in tables])

    plans = list(dict.fromkeys(one["plan"] for one in said))
    sets = [plans.index(one["plan"]) for one in said]
    sensors = [_MOST_SENSORS * k + table[SENSOR].to_numpy() for k, table in zip(sets, tables, strict=True)]
    names = [table[NAME].to_pylist() for table in tables]
    if len(plans) > 1:
        names = [[f"{k}/{name}" for name in some] for k, some in zip(sets, names, strict=True)]
    return ShardedFolder(
        folder=folder,
        image_folder=folder,
        names=[name for some in names for name in some],
        pose=numbers(POSE),
        shear=numbers(SHEAR),
        force=numbers(FORCE),
        sensor=np.concatenate(sensors),
        preprocessing=settings,
        processed=True,
        parameters=parameters,
        report=report,
        labelled=tuple(first["labelled"]),
        forces=tuple(first["forces"]),
        kind=kind,
        groups=groups,
        sha256=hashlib.sha256("".join(s["sha256"] for s in said).encode()).hexdigest(),
        packed_reference=first["reference"],
        has_markers=all(one["markers"] for one in said),
    )


def common_part(parameters: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What is the same in all of them."""
    first, *others = parameters
    return {
        name: value
        for name, value in first.items()
        if all(name in other and other[name] == value for other in others)
    }


def _contents(paths: list[Path]) -> tuple[list[dict[str, Any]], list[Table], list[Group]]:
    """Of each shard what it says and its columns but for the images; and all groups of rows."""
    said, tables, groups = [], [], []
    start = 0
    for path in paths:
        with _opened(path) as file:
            said.append(_metadata(path, file))
            for number in range(file.num_row_groups):
                stop = start + file.metadata.row_group(number).num_rows
                groups.append(Group(path, number, start, stop))
                start = stop
            columns = [NAME, POSE, SHEAR, FORCE, SENSOR]
            tables.append(_read(path, partial(file.read, columns=columns)))
    return said, tables, groups


def read_metadata(path: Path) -> dict[str, Any]:
    """What a shard says beside its rows; `DatasetError` unless it is a whole shard of ours."""
    with _opened(path) as file:
        return _metadata(path, file)


def _metadata(path: Path, file: ParquetFile) -> dict[str, Any]:
    content = (file.schema_arrow.metadata or {}).get(METADATA_KEY)
    if content is None:
        raise DatasetError(f"{path}: is no shard of tactile data; `tactile data shard` writes such")
    said: dict[str, Any] = json.loads(content)
    return said


def _check_together(paths: list[Path], said: list[dict[str, Any]]) -> None:
    """`DatasetError` unless all shards are there and say the same."""
    for path, one in zip(paths, said, strict=True):
        if differ := [name for name in COMMON if one[name] != said[0][name]]:
            raise DatasetError(f"{path}: has another {', '.join(differ)} than {paths[0]}")
        there = sum(other["plan"] == one["plan"] for other in said)
        if there != one["files"]:
            raise DatasetError(
                f"{path.parent}: holds {there} of {one['files']} shards of one data set, as {path.name}: the "
                "same `tactile data shard` goes on where it was interrupted"
            )


def _opened(path: Path) -> ParquetFile:
    """`page_checksum_verification`: a damaged image must not be trained on."""
    module = parquet()
    opened: ParquetFile = _read(path, partial(module.ParquetFile, path, page_checksum_verification=True))
    return opened


def _read(path: Path, read: Callable[[], Any]) -> Any:
    from pyarrow import ArrowException

    try:
        return read()
    except (ArrowException, OSError) as error:
        first = str(error).partition("\n")[0]
        raise DatasetError(f"{path}: is damaged, or no Parquet file ({first})") from error


def _matrix(column: ChunkedArray) -> NDArray[np.float64]:
    """A column of lists of one length as an array (N, length)."""
    length = column.type.list_size
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.asarray(flat, np.float64).reshape(-1, length)
