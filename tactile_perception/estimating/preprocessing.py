"""Pre-processing of tactile images: crop, median, adaptive threshold, circle mask, resize, [0, 1].

Where `redraw_radius` says so, the markers of the thresholded image are found and drawn again before it is
resized.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_perception.estimating.image import Image, ImageError, check_image
from tactile_perception.markers.detection import detect, redrawn

_THRESHOLD_METHODS = {"mean": cv2.ADAPTIVE_THRESH_MEAN_C, "gaussian": cv2.ADAPTIVE_THRESH_GAUSSIAN_C}


@dataclass(frozen=True)
class PreprocessingSettings(Settings):
    """The five steps of the paper's "Pre- and post-processing"; travels inside a model's metadata.

    The defaults are those of the published TacTip data on the Franka arm (`processed_image_params.json`).
    """

    raw_width: int = setting(640, unit="px", lower=16, upper=8192, doc="width of the camera's image")
    raw_height: int = setting(480, unit="px", lower=16, upper=8192, doc="height of the camera's image")
    bbox: tuple[int, ...] = setting(
        (105, 20, 550, 460), unit="px", lower=0, upper=8192, length=4,
        doc="crop x0, y0, x1, y1; the ends are exclusive",
    )  # fmt: skip
    median: int = setting(5, unit="px", choices=(0, 3, 5), doc="side of the median filter; 0: none")
    threshold_block: int = setting(
        61, unit="px", lower=3, upper=1001, doc="side of the threshold's neighborhood, odd"
    )
    threshold_offset: float = setting(
        5.0,
        lower=-255.0,
        upper=255.0,
        doc="gray levels below the neighborhood's mean that still count as white",
    )
    threshold_method: str = setting("mean", choices=("mean", "gaussian"), doc="weights of the neighborhood")
    circle_mask_radius: int = setting(
        230, unit="px", lower=0, upper=8192,
        doc="black outside this circle around the crop's center; 0: no mask",
    )  # fmt: skip
    redraw_radius: float = setting(
        0.0,
        unit="px",
        lower=0.0,
        upper=50.0,
        doc="find the markers and draw them again as discs of this radius: networks trained on simulated "
        "images; 0: the image as it is",
    )
    size: int = setting(128, unit="px", lower=16, upper=512, doc="side of the network's square input")

    def __post_init__(self) -> None:
        super().__post_init__()
        x0, y0, x1, y1 = self.bbox
        if not (x0 < x1 <= self.raw_width and y0 < y1 <= self.raw_height):
            raise SettingError(
                f"bbox = {self.bbox}: needs x0 < x1 <= {self.raw_width} and y0 < y1 <= {self.raw_height}"
            )
        if self.threshold_block % 2 == 0:
            raise SettingError(f"threshold_block = {self.threshold_block}: must be odd")

    def differences(self, other: PreprocessingSettings) -> str:
        """The settings that another one has otherwise, as "median = 5, not 3"; empty where they agree."""
        pairs = ((name, getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return "; ".join(f"{name} = {ours}, not {theirs}" for name, ours, theirs in pairs if ours != theirs)

    @property
    def raw_shape(self) -> tuple[int, int]:
        """(rows, columns) of a camera image."""
        return self.raw_height, self.raw_width

    @property
    def crop_shape(self) -> tuple[int, int]:
        """(rows, columns) of a cropped image."""
        x0, y0, x1, y1 = self.bbox
        return y1 - y0, x1 - x0


class Preprocessor:
    """Turns images into the network's input, with buffers of its own: use one per thread.

    OpenCV is set to one thread for the process: on images this small its threads cost more than they bring,
    and the cores belong to the other nodes.
    """

    def __init__(self, settings: PreprocessingSettings | None = None) -> None:
        self.settings = settings or PreprocessingSettings()
        cv2.setNumThreads(1)
        shape = self.settings.crop_shape
        self._smooth = np.empty(shape, np.uint8)
        self._binary = np.empty(shape, np.uint8)
        self._resized = np.empty((self.settings.size, self.settings.size), np.uint8)
        self._last: Image = self._binary
        self._mask = _circle_mask(shape, self.settings.circle_mask_radius)

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Camera image -> network input, float32 (1, 1, size, size) in [0, 1].

        Raises `ImageError` if it is not uint8 of `raw_shape`, or of `crop_shape`, as which it is the crop.
        """
        self._last = self._binary
        self._binarize(image, self._binary)
        self._resize(self._binary, self._resized)
        return as_input(self._resized)

    def from_processed(self, crop: Image) -> NDArray[np.float32]:
        """Already cropped and thresholded image, uint8 of any size -> network input."""
        self._last = check_image(crop, None, "processed image")
        self._resize(self._last, self._resized)
        return as_input(self._resized)

    def view(self, side: int) -> Image:
        """What the last call, or `from_processed`, made an input of, at another size: uint8 (side, side)."""
        if side == self.settings.size:
            return self._resized
        result = np.empty((side, side), np.uint8)
        _shrink(self._last, result)
        return result

    def binary(self, image: Image) -> Image:
        """Camera image -> cropped, thresholded and masked image, uint8 0 or 255 of `crop_shape`.

        Raises `ImageError` as a call does.
        """
        result = np.empty(self.settings.crop_shape, np.uint8)
        self._binarize(image, result)
        return result

    def resized(self, crop: Image) -> Image:
        """Processed crop, uint8 of any size -> uint8 (size, size); what training keeps in memory.

        Other crops than `crop_shape` are what other tools have written: the whole of one is taken.

        Raises `ImageError` if the crop is not gray and uint8.
        """
        result = np.empty_like(self._resized)
        self._resize(check_image(crop, None, "processed image"), result)
        return result

    def _binarize(self, image: Image, result: Image) -> None:
        settings = self.settings
        crop = self.cropped(image)
        if settings.median:
            crop = np.asarray(cv2.medianBlur(crop, settings.median, dst=self._smooth), np.uint8)
        method = _THRESHOLD_METHODS[settings.threshold_method]
        block, offset = settings.threshold_block, settings.threshold_offset
        cv2.adaptiveThreshold(crop, 255, method, cv2.THRESH_BINARY, block, offset, dst=result)
        cv2.bitwise_and(result, self._mask, dst=result)

    def cropped(self, image: Image) -> Image:
        """The part that the settings want; an image of just that size has been cropped by its camera.

        Raises `ImageError` as a call does.
        """
        settings = self.settings
        image = _row_by_row(check_image(image, None, "camera image"))
        if image.shape == settings.crop_shape:
            return image
        if image.shape != settings.raw_shape:
            rows, columns = settings.crop_shape
            raise ImageError(
                f"camera image: must be {settings.raw_width}x{settings.raw_height} pixels, is "
                f"{image.shape[1]}x{image.shape[0]}; or {columns}x{rows}, cropped to {settings.bbox} of that"
            )
        x0, y0, x1, y1 = settings.bbox
        return image[y0:y1, x0:x1]

    def _resize(self, crop: Image, result: Image) -> None:
        if self.settings.redraw_radius:
            shape = (crop.shape[0], crop.shape[1])
            crop = redrawn(detect(crop), shape, self.settings.redraw_radius)
        _shrink(crop, result)


def _shrink(crop: Image, result: Image) -> None:
    """The mean over areas, into `result` (side, side)."""
    cv2.resize(_row_by_row(crop), result.shape, dst=result, interpolation=cv2.INTER_AREA)


def _row_by_row(image: Image) -> Image:
    """The image, copied unless it lies in memory as OpenCV takes it."""
    adjacent = image.strides[1] == 1 and image.strides[0] >= image.shape[1]
    return image if adjacent else np.ascontiguousarray(image)


def as_input(resized: Image) -> NDArray[np.float32]:
    """uint8 (size, size) or (N, size, size) -> float32 (N, 1, size, size) in [0, 1]."""
    stack = resized if resized.ndim == 3 else resized[np.newaxis]
    return np.multiply(stack[:, np.newaxis], np.float32(1.0 / 255.0), dtype=np.float32)


def _circle_mask(shape: tuple[int, int], radius: int) -> Image:
    """255 within the circle, or everywhere if the radius is 0."""
    if radius == 0:
        return np.full(shape, 255, np.uint8)
    mask = np.zeros(shape, np.uint8)
    center = (shape[1] // 2, shape[0] // 2)
    return np.asarray(cv2.circle(mask, center, radius, 255, thickness=-1), np.uint8)
