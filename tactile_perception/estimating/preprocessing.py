"""Pre-processing of tactile images: a chain of steps, most of which a model's file may leave out.

Undistort, crop, gray or color, median, difference to the image without contact, adaptive threshold, circle
mask, markers drawn again, resize, [0, 1]. The paper's are crop, median, threshold, mask and resize, for white
markers on black; an image of gel in colored light has nothing to threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting
from tactile_perception.estimating.image import Image, ImageError, check_image, gray
from tactile_perception.markers.detection import detect, redrawn

_THRESHOLD_METHODS = {"mean": cv2.ADAPTIVE_THRESH_MEAN_C, "gaussian": cv2.ADAPTIVE_THRESH_GAUSSIAN_C}
NO_THRESHOLD = "none"
_LUMA = np.array([0.114, 0.587, 0.299], np.float32)  # of blue, green and red (ITU-R BT.601)
MID_GRAY = 128.0  # of a difference, where nothing has changed


@dataclass(frozen=True)
class PreprocessingSettings(Settings):
    """Which steps there are, and how; travels inside a model's metadata.

    The defaults are those of the published TacTip data on the Franka arm (`processed_image_params.json`), the
    five steps of the paper's "Pre- and post-processing".
    """

    raw_width: int = setting(640, unit="px", lower=16, upper=8192, doc="width of the camera's image")
    raw_height: int = setting(480, unit="px", lower=16, upper=8192, doc="height of the camera's image")
    undistort: tuple[float, ...] = setting(
        (), lower=-1e4, upper=1e4,
        doc="fx, fy, cx, cy (px) and k1, k2, p1, p2, k3 of the camera (OpenCV's model), by which its image "
        "is made straight; []: as it is",
    )  # fmt: skip
    bbox: tuple[int, ...] = setting(
        (105, 20, 550, 460), unit="px", lower=0, upper=8192, length=4,
        doc="crop x0, y0, x1, y1; the ends are exclusive",
    )  # fmt: skip
    color: bool = setting(False, doc="keep blue, green and red apart; else the image becomes gray")
    median: int = setting(5, unit="px", choices=(0, 3, 5), doc="side of the median filter; 0: none")
    difference: float = setting(
        0.0, lower=0.0, upper=16.0,
        doc="factor on the difference to the image without contact, about mid-gray; 0: the image as it is",
    )  # fmt: skip
    threshold_method: str = setting(
        "mean",
        choices=(NO_THRESHOLD, "mean", "gaussian"),
        doc="black and white by the mean of a neighborhood, or its weighted mean; none: as it is",
    )
    threshold_block: int = setting(
        61, unit="px", lower=3, upper=1001, doc="side of the threshold's neighborhood, odd"
    )
    threshold_offset: float = setting(
        5.0,
        lower=-255.0,
        upper=255.0,
        doc="gray levels below the neighborhood's mean that still count as white",
    )
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
        if len(self.undistort) not in (0, 9) or (self.undistort and min(self.undistort[:2]) <= 0.0):
            raise SettingError(
                f"undistort = {self.undistort}: must be [], or nine numbers with fx and fy above 0"
            )
        if self.binary and (self.color or self.difference):
            raise SettingError(
                "color, difference: an image in black and white has neither; give threshold_method: none"
            )
        if self.redraw_radius and not self.binary:
            raise SettingError("redraw_radius: markers are found after a threshold; there is none")

    def differences(self, other: PreprocessingSettings) -> str:
        """The settings that another one has otherwise, as "median = 5, not 3"; empty where they agree."""
        pairs = ((name, getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return "; ".join(f"{name} = {ours}, not {theirs}" for name, ours, theirs in pairs if ours != theirs)

    @property
    def binary(self) -> bool:
        """Whether what comes out is black and white, but for what resizing makes of it."""
        return self.threshold_method != NO_THRESHOLD

    @property
    def channels(self) -> int:
        """Of the network's input."""
        return 3 if self.color else 1

    @property
    def raw_shape(self) -> tuple[int, int]:
        """(rows, columns) of a camera image."""
        return self.raw_height, self.raw_width

    @property
    def crop_shape(self) -> tuple[int, int]:
        """(rows, columns) of a cropped image."""
        x0, y0, x1, y1 = self.bbox
        return y1 - y0, x1 - x0

    @property
    def steps(self) -> str:
        """The chain in words."""
        rows, columns = self.crop_shape
        whole = self.crop_shape == self.raw_shape
        block, offset = self.threshold_block, self.threshold_offset
        steps = (
            "undistort" if self.undistort else "",
            f"{columns}x{rows} of {self.raw_width}x{self.raw_height}" if not whole else f"{columns}x{rows}",
            "color" if self.color else "gray",
            f"median {self.median}" if self.median else "",
            f"{self.difference:g} times the difference to no contact" if self.difference else "",
            f"threshold ({self.threshold_method} of {block}, {offset:g})" if self.binary else "",
            f"circle {self.circle_mask_radius}" if self.circle_mask_radius else "",
            f"markers redrawn ({self.redraw_radius:g})" if self.redraw_radius else "",
            f"resize to {self.size}x{self.size}",
        )
        return ", ".join(filter(None, steps))


class Preprocessor:
    """Turns images into the network's input, with buffers of its own: use one per thread.

    OpenCV is set to one thread for the process: on images this small its threads cost more than they bring,
    and the cores belong to the other nodes.

    Attributes
    ----------
    reference : uint8 of `crop_shape`, or None
        The image without contact, as `processed` gives it, that others are compared with; only for a
        difference.
    """

    def __init__(self, settings: PreprocessingSettings | None = None, reference: Image | None = None) -> None:
        self.settings = settings or PreprocessingSettings()
        cv2.setNumThreads(1)
        depth = (3,) if self.settings.color else ()
        shape, side = self.settings.crop_shape, self.settings.size
        self._smooth = np.empty((*shape, *depth), np.uint8)
        self._done = np.empty((*shape, *depth), np.uint8)
        self._resized = np.empty((side, side, *depth), np.uint8)
        self._last: Image = self._done
        mask = _circle_mask(shape, self.settings.circle_mask_radius)
        self._mask = np.dstack([mask] * 3) if depth else mask
        self._straight = _Undistortion(self.settings) if self.settings.undistort else None
        self.reference = reference

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Camera image -> network input, float32 (1, channels, size, size) in [0, 1].

        Raises `ImageError` if it is not uint8 of `raw_shape`, or of `crop_shape`, as which it is the crop; if
        it is gray where color is wanted; or if there is no reference for a difference.
        """
        return self.from_processed(self._process(image, self._done))

    def from_processed(self, crop: Image) -> NDArray[np.float32]:
        """Image of any size as `processed` gives it -> network input; raises `ImageError` as `resized`."""
        self._last = check_image(crop, None, "processed image", self.settings.color)
        self._finish(self._last, self._resized)
        return as_input(self._resized)

    @property
    def latest(self) -> Image:
        """The processed image of the last call, or of `from_processed`; overwritten by the next."""
        return self._last

    def again(self) -> NDArray[np.float32]:
        """The input that the last call, or `from_processed`, has made."""
        return as_input(self._resized)

    def view(self, side: int) -> Image:
        """A gray picture (side, side), uint8, of what the last call or `from_processed` made an input of."""
        if self.settings.binary and side == self.settings.size:
            return self._resized
        result = np.empty((side, side), np.uint8)
        _shrink(gray(self._last), result)
        return result

    def processed(self, image: Image) -> Image:
        """Camera image -> what `processed_images/` hold, uint8 of `crop_shape`.

        Black and white and masked; without a threshold all steps before the difference.

        Raises `ImageError` as a call does.
        """
        return self._process(image, np.empty_like(self._done))

    def resized(self, crop: Image) -> Image:
        """Processed image, uint8 of any size -> uint8 (size, size[, 3]); what training keeps in memory.

        Other crops than `crop_shape` are what other tools have written: the whole of one is taken.

        Raises `ImageError` if it is not uint8, not of the colors that are wanted, or not of the size of the
        image without contact that it is to be compared with.
        """
        result = np.empty_like(self._resized)
        self._finish(check_image(crop, None, "processed image", self.settings.color), result)
        return result

    def _process(self, image: Image, result: Image) -> Image:
        settings = self.settings
        crop = self.cropped(image)
        if settings.median:
            crop = np.asarray(cv2.medianBlur(crop, settings.median, dst=self._smooth), np.uint8)
        if not settings.binary:
            np.copyto(result, crop)
            return result
        method = _THRESHOLD_METHODS[settings.threshold_method]
        block, offset = settings.threshold_block, settings.threshold_offset
        cv2.adaptiveThreshold(crop, 255, method, cv2.THRESH_BINARY, block, offset, dst=result)
        cv2.bitwise_and(result, self._mask, dst=result)
        return result

    def _finish(self, crop: Image, result: Image) -> None:
        settings = self.settings
        if settings.difference:
            crop = self._compared(crop)
        if settings.circle_mask_radius and not settings.binary and crop.shape == self._mask.shape:
            crop = np.asarray(cv2.bitwise_and(crop, self._mask), np.uint8)
        if settings.redraw_radius:
            shape = (crop.shape[0], crop.shape[1])
            crop = redrawn(detect(crop), shape, settings.redraw_radius)
        _shrink(crop, result)

    def _compared(self, crop: Image) -> Image:
        reference, gain = self.reference, self.settings.difference
        if reference is None:
            raise ImageError("image: there is none without contact that it could be compared with")
        if reference.shape != crop.shape:
            raise ImageError(f"image: has the shape {crop.shape}, the one without contact {reference.shape}")
        return np.asarray(cv2.addWeighted(crop, gain, reference, -gain, MID_GRAY), np.uint8)

    def cropped(self, image: Image) -> Image:
        """The part that the settings want; an image of just that size has been cropped by its camera.

        Raises `ImageError` as a call does.
        """
        settings = self.settings
        image = _row_by_row(check_image(image, None, "camera image", settings.color))
        rows, columns = settings.crop_shape
        shape = image.shape[:2]
        if shape not in (settings.crop_shape, settings.raw_shape):
            raise ImageError(
                f"camera image: must be {settings.raw_width}x{settings.raw_height} pixels, is "
                f"{shape[1]}x{shape[0]}; or {columns}x{rows}, cropped to {settings.bbox} of that"
            )
        if self._straight is not None:
            return self._straight(image, cropped=shape != settings.raw_shape)
        if shape == settings.crop_shape:
            return image
        x0, y0, x1, y1 = settings.bbox
        return image[y0:y1, x0:x1]


class _Undistortion:
    """Makes the crop of a camera's image straight; beyond what the camera has cropped, it is black."""

    def __init__(self, settings: PreprocessingSettings) -> None:
        fx, fy, cx, cy, *coefficients = settings.undistort
        x0, y0 = settings.bbox[:2]
        camera, seen = (
            np.array([[fx, 0.0, u], [0.0, fy, v], [0.0, 0.0, 1.0]]) for u, v in ((cx, cy), (cx - x0, cy - y0))
        )
        size = settings.crop_shape[::-1]
        columns, rows = cv2.initUndistortRectifyMap(
            camera, np.array(coefficients), np.eye(3), seen, size, cv2.CV_32FC1
        )
        self._whole = cv2.convertMaps(columns, rows, cv2.CV_16SC2)
        self._crop = cv2.convertMaps(columns - x0, rows - y0, cv2.CV_16SC2)

    def __call__(self, image: Image, cropped: bool) -> Image:
        maps = self._crop if cropped else self._whole
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8)


def _shrink(crop: Image, result: Image) -> None:
    """The mean over areas, into `result` (side, side)."""
    size = result.shape[1], result.shape[0]
    cv2.resize(_row_by_row(crop), size, dst=result, interpolation=cv2.INTER_AREA)


def _row_by_row(image: Image) -> Image:
    """The image, copied unless it lies in memory as OpenCV takes it."""
    adjacent = image[0].flags.c_contiguous and image.strides[0] >= image[0].size
    return image if adjacent else np.ascontiguousarray(image)


def as_input(resized: Image) -> NDArray[np.float32]:
    """Images uint8 as `resized` makes them, one or (N, ...) -> float32 (N, channels, size, size) in [0, 1].

    One is (size, size) or (size, size, 3).
    """
    color = resized.shape[-1] == 3
    stack = resized if resized.ndim == 3 + color else resized[np.newaxis]
    stack = np.moveaxis(stack, -1, 1) if color else stack[:, np.newaxis]
    return np.multiply(stack, np.float32(1.0 / 255.0), dtype=np.float32)


def brightness(prepared: NDArray) -> NDArray:
    """Luma (size, size) of a network's input (size, size) or (1, channels, size, size)."""
    if prepared.ndim < 3 or prepared.shape[-3] == 1:
        return prepared.reshape(prepared.shape[-2:])
    return np.tensordot(_LUMA, prepared.reshape(prepared.shape[-3:]), 1)


def _circle_mask(shape: tuple[int, int], radius: int) -> Image:
    """255 within the circle, or everywhere if the radius is 0."""
    if radius == 0:
        return np.full(shape, 255, np.uint8)
    mask = np.zeros(shape, np.uint8)
    center = (shape[1] // 2, shape[0] // 2)
    return np.asarray(cv2.circle(mask, center, radius, 255, thickness=-1), np.uint8)
