"""Writer of shards: one or more data folders, their samples in random order, as Parquet files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.whole_file import check_folder, whole_file
from tactile_perception.datasets import shards
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.folder import TactileFolder
from tactile_perception.datasets.layout import FORCE_COLUMNS, SHARD_SUFFIX, DatasetError
from tactile_perception.datasets.writer import as_png
from tactile_perception.estimating.image import ImageError, packed
from tactile_perception.estimating.labels import EULER_COMPONENTS

GROUP_ROWS = 500  # some megabytes: of these, streams mix a few
FILE_ROWS = 5000  # held in memory while they are written
_AT_ONCE = 64  # images


@dataclass(frozen=True)
class ShardSettings:
    """How samples are spread over files; the same give the same files."""

    name: str = "shard"
    group_rows: int = GROUP_ROWS
    file_rows: int = FILE_ROWS
    seed: int = 0


def write_shards(
    sources: list[Path],
    out: Path,
    settings: ShardSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Write shards of the samples of data folders; returns lines on what was found in these.

    Files that are there from an interrupted call are kept, each is whole. Under another name, a folder gets
    the shards of one more data set. Images that cannot be used are left out and named.

    Raises `DatasetError` for folders that cannot be read or do not belong together, and if `out` has other
    shards of this name.
    """
    settings = settings or ShardSettings()
    check_folder(out)
    folders = [open_folder(source) for source in sources]
    said = _said(folders)
    pairs = np.array([(k, row) for k, folder in enumerate(folders) for row in range(len(folder))])
    pairs = np.random.default_rng(settings.seed).permutation(pairs)
    parts = np.array_split(pairs, max(1, round(len(pairs) / settings.file_rows)))
    said |= {"files": len(parts), "plan": _plan(folders, settings)}
    said["markers"] = all(folder.markers(0) is not None for folder in folders)
    sensors = _numbered([folder.sensor for folder in folders])
    out.mkdir(parents=True, exist_ok=True)
    done = 0
    for number, part in enumerate(parts):
        path = out / f"{settings.name}-{number:05d}-of-{len(parts):05d}{SHARD_SUFFIX}"
        if not _is_there(path, said["plan"]):
            rows = []
            for row in _rows(folders, part, sensors):
                rows.append(row)
                done += 1
                if progress is not None:
                    progress(done, len(pairs))
            _write(path, [row for row in rows if row is not None], said, settings.group_rows)
        else:
            done += len(part)
    return [line for folder in folders for line in folder.report.lines()]


def _said(folders: list[TactileFolder]) -> dict[str, Any]:
    """What all shards say beside their rows."""
    first = folders[0]
    said = [
        {
            "preprocessing": asdict(folder.preprocessing),
            "kind": _kind(folder),
            "labelled": folder.labelled,
            "forces": folder.forces,
            "reference": _reference(folder),
        }
        for folder in folders
    ]
    for folder, other in zip(folders, said, strict=True):
        if differ := [name for name in shards.COMMON if other[name] != said[0][name]]:
            raise DatasetError(
                f"{folder.folder} and {first.folder} differ in {', '.join(differ)}: they do not go together"
            )
    return {**said[0], "parameters": shards.common_part([folder.parameters for folder in folders])}


def _kind(folder: TactileFolder) -> list[Any]:
    """(rows, columns), binary, channels of the processed images."""
    settings = folder.preprocessing
    binary = folder.kind.binary if folder.processed and folder.kind is not None else settings.binary
    return [list(settings.crop_shape), bool(binary), 3 if settings.color else 1]


def _reference(folder: TactileFolder) -> str | None:
    reference = folder.reference()
    if reference is None:
        return None
    return packed(reference if folder.processed else folder.preprocessor().processed(reference))


def _plan(folders: list[TactileFolder], settings: ShardSettings) -> str:
    """A hash of what the shards will hold, in which order."""
    digest = hashlib.sha256(json.dumps(asdict(settings)).encode())
    for folder in folders:
        digest.update(json.dumps([folder.names, asdict(folder.preprocessing)]).encode())
        digest.update(np.hstack([folder.euler_mm_deg, folder.force]).astype("<f8").tobytes())
    return digest.hexdigest()


def _numbered(sensors: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """Sensors of several folders, so that none has the number of another folder's."""
    first = np.cumsum([0, *(int(of.max()) + 1 for of in sensors)])
    return [of + start for of, start in zip(sensors, first, strict=False)]


def _is_there(path: Path, plan: str) -> bool:
    if not path.exists():
        return False
    if shards.read_metadata(path)["plan"] != plan:
        raise DatasetError(f"{path}: is a shard of other data; choose another folder, or another --name")
    return True


def _rows(
    folders: list[TactileFolder], part: NDArray[np.int64], sensors: list[NDArray[np.int64]]
) -> Iterator[dict[str, Any] | None]:
    """Rows of a shard, in order; None for an image that cannot be used, and the folder's report names it."""
    preprocessors = [folder.preprocessor_of_thread() for folder in folders]

    def load(pair: NDArray[np.int64]) -> bytes | ImageError:
        folder, row = folders[pair[0]], int(pair[1])
        try:
            data = folder.stored(row)
            image = folder.image(row, data)  # whether it is one
            return data if folder.processed else as_png(preprocessors[pair[0]]().processed(image))
        except ImageError as error:
            return error

    with ThreadPoolExecutor() as pool:
        for start in range(0, len(part), _AT_ONCE):
            pairs = part[start : start + _AT_ONCE]
            for (k, row), data in zip(pairs.tolist(), pool.map(load, pairs), strict=True):
                folder = folders[k]
                if isinstance(data, ImageError):
                    folder.report.add("unusable image", str(data))
                    folder.report.samples -= 1
                    yield None
                    continue
                markers = folder.markers(row)
                yield {
                    shards.NAME: folder.names[row] if len(folders) == 1 else f"{k}/{folder.names[row]}",
                    shards.IMAGE: data,
                    shards.POSE: folder.pose[row],
                    shards.SHEAR: folder.shear[row],
                    shards.FORCE: folder.force[row],
                    shards.SENSOR: sensors[k][row],
                    shards.MARKERS: None if markers is None else markers.ravel(),
                }


def _write(path: Path, rows: list[dict[str, Any]], said: dict[str, Any], group_rows: int) -> None:
    """Write a shard, group by group."""
    import pyarrow

    def vector(length: int) -> pyarrow.DataType:
        return pyarrow.list_(pyarrow.float64(), length)

    fields = {
        shards.NAME: pyarrow.string(),
        shards.IMAGE: pyarrow.binary(),
        shards.POSE: vector(len(EULER_COMPONENTS)),
        shards.SHEAR: vector(len(EULER_COMPONENTS)),
        shards.FORCE: vector(len(FORCE_COLUMNS)),
        shards.SENSOR: pyarrow.int64(),
        shards.MARKERS: pyarrow.list_(pyarrow.float32()),
    }
    digest = hashlib.sha256()
    for row in rows:
        digest.update(_row_hash(row))
    said = {**said, "sha256": digest.hexdigest()}
    schema = pyarrow.schema(fields, {shards.METADATA_KEY: json.dumps(said)})
    how = {"compression": "none", "write_page_checksum": True}  # images are compressed
    with whole_file(path) as temporary, shards.parquet().ParquetWriter(temporary, schema, **how) as file:
        for start in range(0, len(rows), group_rows):
            group = rows[start : start + group_rows]
            file.write_table(pyarrow.Table.from_pylist(group, schema), row_group_size=len(group))


def _row_hash(row: dict[str, Any]) -> bytes:
    digest = hashlib.sha256(row[shards.NAME].encode() + b"\0" + row[shards.IMAGE])
    for name in (shards.POSE, shards.SHEAR, shards.FORCE):
        digest.update(np.ascontiguousarray(row[name], "<f8").tobytes())
    return digest.digest()
