"""Does an image show the sensor? What is looked for in every image before anything is concluded from it.

A network answers to any image, and so does a comparison with an earlier one. What cannot be an image of this
sensor is refused, whoever sends it: as if it had not come, so that the arm rests as when a camera is silent.

- Of the camera's image: it repeats none of the latest bit for bit, and its gray levels vary.
- Of the same after the threshold, against the sensor's own image without contact: as many markers, and
  as much of it white; where there is no threshold, as bright.
- Of images that follow one another: each is like the one before it, or like the image without contact. One
  that is mirrored, turned, shifted or another one from one image to the next has as many markers, all of them
  elsewhere; those of a skin that is pressed, or springs back, move by a part of their distance.
- Of an estimate, against the depth that the brightness of the image's parts has (`plain_depth`).
- Of what the network sees of it: it is like the images that the network was trained on (`novelty.Novelty`).
- Of the image without contact, against the mean of the images that the network was trained on: no mirrored or
  turned form of that fits better (`layout.Layout`).

That an image shows a touch which is long over it cannot tell alone. Of images that show nothing but noise
for a second it says so (`still`, `stillness`): where the arm moves, that is a contradiction. A recording that
is longer than what is remembered the arm's own motion has to contradict.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.exposures import Exposures, objection
from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import NANOSECOND
from tactile_perception.estimating.image import Image, ImageError
from tactile_perception.estimating.stillness import FRAMES, Stillness

#: Side of the images in which markers are counted, whatever the network's: in smaller ones they merge.
SIDE = 128
_KERNEL = np.ones((3, 3), np.uint8)
_BRIGHT = 100  # gray level of a marker's middle, smoothed; between markers it is below
_PERIOD = 1.0 / 60.0  # s, between images
_FEWEST = 20  # markers of a reference that can be counted: other sensors have no separate ones

MARKERS, CHANGE = "no image of the sensor", "another picture at once"
FOREIGN = "unlike the images of the training"


class ImageRefused(ImageError):
    """An image that cannot show the sensor; the text begins with the kind of fault, which is counted."""

    @property
    def kind(self) -> str:
        """What it is counted as."""
        return str(self).split(":")[0]


@dataclass(frozen=True)
class ImageCheckSettings(Settings):
    """What is refused. Markers and white are relative to the image without contact of the reference."""

    repeats: bool = setting(False, doc="take an image that equals one of the latest bit for bit")
    least_contrast: float = setting(
        4.0, lower=0.0, upper=255.0,
        doc="standard deviation of gray levels below which a camera's image shows nothing; 0: none does",
    )  # fmt: skip
    fewest_markers: float = setting(0.8, lower=0.0, upper=1.0, doc="of those without contact; 0: any number")
    most_markers: float = setting(1.25, lower=1.0, upper=100.0, doc="of those without contact")
    least_white: float = setting(0.8, lower=0.0, upper=1.0, doc="of the white without contact")
    most_white: float = setting(
        1.3, lower=1.0, upper=100.0, doc="of the white without contact; more is blurred, or no markers"
    )
    least_likeness: float = setting(
        0.45, lower=-1.0, upper=1.0,
        doc="correlation with the image without contact that an image has where there was no contact in the "
        "one before it; -1: any. A contact that is 2 mm deep at once has 0.6, one of 3 mm 0.3 (simulated)",
    )  # fmt: skip
    least_continuity: float = setting(
        0.4, lower=-1.0, upper=1.0,
        doc="correlation in contact with the image before it, or with that without contact, 1/60 s later; "
        "for longer times in inverse proportion. Skin that moves by 0.5 mm has 0.47 at least (simulated)",
    )  # fmt: skip
    most_novelty: float = setting(
        1.0, lower=0.0, upper=1e6,
        doc="how unlike the training images an image may be, as a part of the limit in the model's file; "
        "0: any",
    )  # fmt: skip
    depth_difference: float = setting(
        0.0013, lower=0.0, upper=0.05, unit="m",
        doc="an estimate whose depth is, in two images on end, further than this and than four RMS errors "
        "from that of the image's brightness is refused; 0: none is",
    )  # fmt: skip
    still_images: int = setting(
        64, lower=2 * FRAMES, upper=6000,
        doc="so many images with nothing new but noise are said to stand still",
    )  # fmt: skip
    still_change: float = setting(
        0.013, lower=0.0, upper=1.0,
        doc="part of the noise by which means of images vary more where something moves; 0: nothing is "
        "still. In a contact that an arm follows it is 0.023 at least within 0.4 s, of a frozen scene below "
        "0.01 (simulated)",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_markers <= self.fewest_markers or self.most_white <= self.least_white:
            raise SettingError("the most markers and white must be more than the least")


@dataclass(frozen=True)
class _Reference:
    """What is known of the image without contact: markers, mean gray level, its direction."""

    markers: int
    white: float
    direction: NDArray[np.float32]


class ImageCheck:
    """Refuses images; see the module's text.

    Used by `Perceiver` in the order: `exposure`, `look`, `foreign`, `capture` or `take` of the reference,
    `remember`.

    Attributes
    ----------
    settings : ImageCheckSettings
        `configure` replaces them between two images.
    binary : bool
        Whether what is looked at has been through a threshold, so that markers can be counted.
    """

    def __init__(self, settings: ImageCheckSettings | None = None) -> None:
        self._exposures = Exposures()
        self._stillness = Stillness()
        self.configure(settings or ImageCheckSettings())
        self._reference: _Reference | None = None
        self._before = np.zeros(SIDE * SIDE, np.float32)
        self._stamp_ns: int | None = None
        self._captured: list[Image] = []
        self.binary = True

    def configure(self, settings: ImageCheckSettings) -> None:
        """Look for what these say from the next image on."""
        self.settings = settings
        self._stillness.configure(settings.still_images, settings.still_change)

    @property
    def still(self) -> bool:
        """Whether the camera's latest images have shown nothing but noise, where that means something.

        Gel without markers that slides along a smooth surface looks the same all the while.
        """
        return self.binary and self._stillness.still

    def exposure(self, image: Image) -> None:
        """Of a camera's image (rows, columns); raises `ImageRefused`."""
        if not self.settings.repeats and (repeats := self._exposures.repeats(image)):
            raise ImageRefused(repeats)
        if why := objection(image, self.settings.least_contrast):
            raise ImageRefused(why)

    def foreign(self, novelty: float) -> str:
        """Why an image of this novelty, NaN: not known, is not believed; else empty."""
        most = self.settings.most_novelty
        if not most or not novelty > most:
            return ""
        return (
            f"{FOREIGN}: by {novelty:.2f}, must be at most {most:g}: is the model this sensor's, the camera "
            "as it was in training, its lens clean, and the light the same?"
        )

    def remember(self, image: Image) -> None:
        """Take a camera's image for what only several of them show; this can wait a while."""
        self._stillness.add(image)

    def look(self, view: Image, touched: bool, stamp_ns: int | None = None) -> None:
        """Of an image as `Preprocessor.view` shows it, uint8 (SIDE, SIDE), that is no part of a reference.

        `touched` says whether there was contact in the last image that was not refused, `stamp_ns` when this
        one was exposed, None: right after the one before it. Raises `ImageRefused`; without a reference
        nothing can be said.
        """
        reference, settings = self._reference, self.settings
        if reference is None:
            return
        gap, self._stamp_ns = self._gap(stamp_ns), stamp_ns
        white = float(view.mean()) / reference.white if reference.white else 1.0
        if not settings.least_white <= white <= settings.most_white:
            what = "as much of it is white" if self.binary else "as bright"
            raise ImageRefused(
                f"{MARKERS}: {white:.2f} times {what} as without contact, must be "
                f"{settings.least_white:g} to {settings.most_white:g}: is it sharp, and the lens free?"
            )
        if self.binary and reference.markers >= _FEWEST:
            self._count(count_markers(view), reference.markers)
        direction = _direction(view)
        self._compare(direction, reference, gap if touched else None)
        self._before = direction

    def _gap(self, stamp_ns: int | None) -> float:
        """Seconds since the last image that could be looked at; at least `_PERIOD`."""
        if stamp_ns is None or self._stamp_ns is None:
            return _PERIOD
        return max(_PERIOD, (stamp_ns - self._stamp_ns) * NANOSECOND)

    def _count(self, found: int, expected: int) -> None:
        fewest = round(self.settings.fewest_markers * expected)
        most = round(self.settings.most_markers * expected)
        if not fewest <= found <= most:
            raise ImageRefused(f"{MARKERS}: {found} markers, must be {fewest} to {most}")

    def _compare(self, direction: NDArray[np.float32], reference: _Reference, gap: float | None) -> None:
        """`gap` is the time since the image before, in contact; None: there was none."""
        likeness, least = float(direction @ reference.direction), self.settings.least_likeness
        if gap is not None:
            likeness = max(likeness, float(direction @ self._before))
            least = min(1.0, _PERIOD / gap) * self.settings.least_continuity
        if likeness < least:
            raise ImageRefused(
                f"{CHANGE}: its likeness to the last good image, or to that without contact, is "
                f"{likeness:.2f}, must be {least:.2f}: was the camera turned, moved, or changed?"
            )

    # ---- the reference ----

    def capture(self, view: Image) -> None:
        """Keep an image, uint8 (SIDE, SIDE), that becomes a part of the reference, if that is one."""
        self._captured.append(view.copy())

    def take(self, good: bool) -> None:
        """What was captured is the reference from now on, or is none and forgotten."""
        captured, self._captured = self._captured, []
        if not good or not captured:
            return
        mean = np.mean(captured, axis=0)
        view = np.rint(mean).astype(np.uint8)
        self._reference = _Reference(count_markers(view), float(mean.mean()), _direction(mean))
        self._before = self._reference.direction


def count_markers(view: Image) -> int:
    """Markers of an image after the threshold, uint8 (SIDE, SIDE): its smoothed summits.

    Markers that touch each other are counted one by one, as `markers.detection.detect` does, in a hundredth
    of the time and to within 6 % of their number.
    """
    smooth = cv2.GaussianBlur(view, (3, 3), 0)
    summits = (smooth == cv2.dilate(smooth, _KERNEL)) & (smooth > _BRIGHT)
    return cv2.connectedComponents(summits.view(np.uint8), connectivity=8)[0] - 1


def _direction(view: NDArray) -> NDArray[np.float32]:
    """Pixels less their mean, of length 1; zero for an image that is even."""
    pixels = np.asarray(view, np.float32).ravel()
    pixels = pixels - pixels.mean()
    length = float(np.linalg.norm(pixels))
    return pixels / np.float32(length) if length else pixels
