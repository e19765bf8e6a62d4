"""Writer of the public tactile data layout, one sample at a time; what is written survives an interruption.

Each sample's row goes to a journal as soon as its image is on disk; `finish` turns the journal into
`targets_images.csv`, sorted by sample number. Opening the same folder again goes on where it ended::

    with DatasetWriter("data/train", PreprocessingSettings()) as writer:
        for number in sorted(set(range(1, 6001)) - writer.done):
            writer.add(number, camera_image, euler_mm_deg)
        writer.finish()
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.whole_file import only_writer, whole_file
from tactile_perception.datasets import layout
from tactile_perception.datasets.layout import DatasetError, image_name, image_number
from tactile_perception.estimating.image import Image, ImageError
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor

IMAGE_KINDS = ("processed", "raw", "both")
_COLUMNS = ("sensor_image", *layout.POSE_COLUMNS, *layout.SHEAR_COLUMNS)


class DatasetWriter:
    """See the module's text; `DatasetError` if another process is writing to the folder.

    Parameters
    ----------
    folder : is made if it is not there; one process at a time may write to it
    preprocessing : crops and thresholds camera images, and is kept with them
    images : which images to keep: processed (`processed_images/`), raw (camera images in `images/`), or both
    extra : further columns of the table, whose values `add` takes; readers of the layout ignore them
    durable : whether each sample is on the disk itself, not only in the system's memory, before `add`
        returns: it then survives a loss of power too
    """

    def __init__(
        self,
        folder: Path | str,
        preprocessing: PreprocessingSettings,
        images: str = "processed",
        extra: Sequence[str] = (),
        durable: bool = False,
    ) -> None:
        if images not in IMAGE_KINDS:
            raise ValueError(f"images = {images!r}: must be one of {', '.join(IMAGE_KINDS)}")
        self.folder = Path(folder)
        self.preprocessing = preprocessing
        self.kind = images
        self.extra = tuple(extra)
        self._durable = durable
        self._columns = [*_COLUMNS, *self.extra]
        self._journal = self.folder / layout.JOURNAL_NAME
        self._preprocessor = Preprocessor(preprocessing)
        for name in self._image_folders():
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        try:
            self._lock = only_writer(self.folder)
        except BlockingIOError as error:
            raise DatasetError(str(error)) from error
        self._drop_cut_row()
        self._write_image_params()

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Let others write to the folder; what is in the journal stays there."""
        if not self._lock.closed:
            self._lock.close()

    @property
    def done(self) -> set[int]:
        """Numbers of the samples that are already there, finished or in the journal."""
        return {image_number(row["sensor_image"]) for row in self._rows()}

    def add(
        self,
        number: int,
        image: Image,
        euler_mm_deg: Iterable[float],
        extra: Mapping[str, float | int] | None = None,
    ) -> None:
        """Store camera image `number` (from 1) with its Euler surface contact pose in mm and degrees."""
        self.add_image(number, image)
        self.add_row(number, euler_mm_deg, extra)

    def add_image(self, number: int, image: Image) -> None:
        """Store a camera image; 0 is the number of the image without contact, which has no row."""
        if self.kind != "raw":
            write_processed(self.folder, number, as_png(self._preprocessor.processed(image)), self._durable)
        if self.kind != "processed":
            path = self.folder / layout.RAW_IMAGES_NAME / image_name(number)
            _write(path, as_png(image), self._durable)

    def add_row(
        self, number: int, euler_mm_deg: Iterable[float], extra: Mapping[str, float | int] | None = None
    ) -> None:
        """Store the label of an image that is already written."""
        x, y, z, alpha, beta, gamma = (repr(float(value)) for value in euler_mm_deg)
        row = [image_name(number), "0", "0", z, alpha, beta, "0", x, y, "0", "0", "0", gamma]
        values = [(extra or {})[name] for name in self.extra]
        row += [repr(float(value) if isinstance(value, float) else int(value)) for value in values]
        new = not self._journal.exists() or self._journal.stat().st_size == 0
        with self._journal.open("a", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            if new:
                writer.writerow(self._columns)
            writer.writerow(row)
            _sync(file, self._durable)

    def finish(self) -> Path:
        """Write `targets_images.csv` from everything recorded so far and remove the journal."""
        rows = sorted(self._rows(), key=lambda row: image_number(row["sensor_image"]))
        path = self.folder / layout.TARGETS_NAME
        with whole_file(path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(
                file, self._columns, restval="", lineterminator="\n", extrasaction="ignore"
            )
            writer.writeheader()
            writer.writerows(rows)
            _sync(file, self._durable)
        self._journal.unlink(missing_ok=True)
        return path

    def _rows(self) -> Iterator[dict[str, str]]:
        """Rows written so far whose images exist, each once."""
        seen: set[str] = set()
        for path in (self.folder / layout.TARGETS_NAME, self._journal):
            if not path.exists():
                continue
            with path.open(newline="") as file:
                for row in csv.DictReader(file):
                    name = row["sensor_image"]
                    if name not in seen and self._has_images(name):
                        seen.add(name)
                        yield row

    def _has_images(self, name: str) -> bool:
        return all((self.folder / folder / name).exists() for folder in self._image_folders())

    def _image_folders(self) -> list[str]:
        folders = {"processed": [layout.IMAGES_NAME], "raw": [layout.RAW_IMAGES_NAME]}
        return folders.get(self.kind, [layout.IMAGES_NAME, layout.RAW_IMAGES_NAME])

    def _drop_cut_row(self) -> None:
        """Remove a last row that an interruption cut short; it could still look like numbers."""
        if self._journal.exists():
            whole = self._journal.read_bytes().rfind(b"\n") + 1
            os.truncate(self._journal, whole)

    def _write_image_params(self) -> None:
        settings = self.preprocessing
        params = {
            "type": "standard",
            "gray": not settings.color,
            "thresh": [settings.threshold_block, settings.threshold_offset],
            "threshold_method": settings.threshold_method,
            "difference": settings.difference,
            "median": settings.median,
            "circle_mask_radius": settings.circle_mask_radius,
            "bbox": list(settings.bbox),
            "dims": [settings.raw_width, settings.raw_height],
            "undistort": list(settings.undistort),
        }
        (self.folder / layout.IMAGE_PARAMS_NAME).write_text(json.dumps(params, indent=2) + "\n")


def write_processed(folder: Path | str, number: int, png: bytes, durable: bool = False) -> None:
    """Write one cropped and thresholded image of the public layout, whole or not at all."""
    _write(Path(folder) / layout.IMAGES_NAME / image_name(number), png, durable)


def write_markers(folder: Path | str, number: int, positions: NDArray[np.float64]) -> None:
    """Write where the markers are in a camera image, (n, 2) column and row."""
    path = Path(folder) / layout.MARKERS_NAME / Path(image_name(number)).with_suffix(".npy")
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.save(file, positions.astype(np.float32))


def as_png(image: Image) -> bytes:
    """An image as it is stored."""
    ok, encoded = cv2.imencode(".png", image)
    if not ok:
        raise ImageError(f"an image of {image.shape} {image.dtype} cannot be encoded as PNG")
    return bytes(encoded)


def _write(path: Path, data: bytes, durable: bool) -> None:
    with whole_file(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        _sync(file, durable)


def _sync(file: IO[Any], durable: bool) -> None:
    if durable:
        file.flush()
        os.fsync(file.fileno())
