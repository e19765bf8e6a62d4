"""A data folder that has been opened: its labels and settings in memory, its images where they are stored."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import check_regular
from tactile_perception.datasets import layout
from tactile_perception.datasets.layout import DatasetError, DatasetReport
from tactile_perception.estimating.image import Image, ImageError, ImageKind, check_image, decoded
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor

Array = NDArray[np.float64]


@dataclass
class TactileFolder:
    """A data folder's labels and settings, images still on disk.

    Attributes
    ----------
    names : of the images
    pose, shear : (N, 6) mm and degrees; the label is their sum. Components that are not among `labelled` are
        0 and mean nothing.
    force : (N, 3) N, of which `forces` are those that the table has
    sensor : (N,) which sensor an image is of, where there are several
    """

    folder: Path
    image_folder: Path
    names: list[str]
    pose: Array
    shear: Array
    force: Array
    sensor: NDArray[np.int64]
    preprocessing: PreprocessingSettings
    processed: bool
    parameters: dict[str, Any]
    report: DatasetReport
    labelled: tuple[str, ...]
    forces: tuple[str, ...]
    kind: ImageKind | None

    @cached_property
    def euler_mm_deg(self) -> Array:
        """The labels (N, 6), Euler surface contact poses of X_fs."""
        return self.pose + self.shear

    def __len__(self) -> int:
        return len(self.names)

    def path(self, index: int) -> Path:
        """Where image `index` is, for whoever looks for it."""
        return self.image_folder / self.names[index]

    def stored(self, index: int) -> bytes:
        """The file of image `index`; `ImageError` if it cannot be read."""
        try:
            check_regular(self.path(index))
            return self.path(index).read_bytes()
        except OSError as error:
            raise ImageError(f"{self.path(index)}: cannot be read: {error}") from error

    def image(self, index: int, data: bytes | None = None) -> Image:
        """Image `index` as stored; `ImageError` if it cannot be read or has the wrong size or colors.

        `data` are its bytes where they have been read.
        """
        settings, what = self.preprocessing, str(self.path(index))
        image = decoded(self.stored(index) if data is None else data, what, settings.color)
        cropped = self.processed or image.shape[:2] == settings.crop_shape  # by its camera
        shape = settings.crop_shape if cropped else settings.raw_shape
        return check_image(image, shape, what, settings.color)

    def reference(self) -> Image | None:
        """The image without contact, which tools keep as number 0; None where there is no usable one."""
        path = self.image_folder / layout.REFERENCE_NAME
        try:
            if layout.REFERENCE_NAME in self.names or not path.exists():
                return None
            return decoded(path.read_bytes(), str(path), self.preprocessing.color)
        except (ImageError, OSError):
            return None

    def markers(self, index: int) -> Array | None:
        """Where the markers are in camera image `index` (n, 2), column and row; None where nobody tells.

        `DatasetError` for a file that is damaged.
        """
        folder = self.folder / layout.MARKERS_NAME
        if not folder.is_dir():
            return None
        path = (folder / Path(self.names[index]).name).with_suffix(".npy")
        try:
            return np.asarray(np.load(path), np.float64)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path}: cannot be read: {error}") from error

    def preprocessor(self) -> Preprocessor:
        """For its images, with the one without contact where they are compared with that.

        Raises `DatasetError` where there is none.
        """
        result = Preprocessor(self.preprocessing)
        if self.preprocessing.difference:
            reference = self.reference()
            if reference is None:
                raise DatasetError(
                    f"{self.folder}: has no {self.image_folder.name}/{layout.REFERENCE_NAME}, the image "
                    "without contact that others are to be compared with (preprocessing.difference)"
                )
            result.reference = reference if self.processed else result.processed(reference)
        return result

    def preprocessor_of_thread(self) -> Callable[[], Preprocessor]:
        """What gives each thread that calls it a preprocessor of its own, as these have buffers."""
        own = threading.local()

        def give() -> Preprocessor:
            if not hasattr(own, "preprocessor"):
                own.preprocessor = self.preprocessor()
            return own.preprocessor

        return give

    def check_labelled(self) -> None:
        """`DatasetError` unless all six components are labelled."""
        if missing := [name for name in EULER_COMPONENTS if name not in self.labelled]:
            said = json.dumps({"components": EULER_COMPONENTS})
            raise DatasetError(
                f"{self.folder}: {', '.join(missing)} not labelled, only {', '.join(self.labelled)}: this "
                f"needs all six. Where they were truly 0, write {said} into its {layout.LABELS_NAME}"
            )

    def resized(self, index: int, preprocessor: Preprocessor, data: bytes | None = None) -> Image:
        """Image `index` pre-processed to uint8 (size, size[, 3])."""
        image = self.image(index, data)
        return preprocessor.resized(image if self.processed else preprocessor.processed(image))
