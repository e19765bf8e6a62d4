"""Contact presence: has the image changed against the sensor's own no-contact image?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import SettingError, Settings, setting

Prepared = NDArray[np.float32]
#: Spreads of the score without contact that the thresholds stay away from, however small they are set.
_NOISE_MARGIN = 6.0
#: Side of the images in which the window is given, in pixels, and the largest window in any.
_WINDOW_REFERS_TO = 128
_LARGEST_WINDOW = 129
#: Standard deviations of a pixel without contact that do not count as change.
_PIXEL_NOISE_MARGIN = np.float32(2.0)


@dataclass(frozen=True)
class PresenceSettings(Settings):
    """Thresholds of the change score, which runs from 0 (no change) to 1."""

    on: float = setting(0.02, lower=0.0, upper=1.0, doc="score at and above which contact begins")
    off: float = setting(0.012, lower=0.0, upper=1.0, doc="score below which contact ends")
    window: int = setting(
        17,
        unit="px",
        lower=1,
        upper=129,
        doc="side of the patch whose mean change counts, in an image of 128x128; scaled to others",
    )
    reference_frames: int = setting(
        10, lower=2, upper=1000, doc="first frames, without contact, for the reference"
    )
    reference_depth: float = setting(
        0.0012, lower=0.0, upper=0.05, unit="m",
        doc="images in which the network sees a deeper contact are no reference; without contact it says "
        "about the least depth that it was trained for",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.off > self.on:
            raise SettingError(f"off = {self.off:g}: must not be above on = {self.on:g}")


@dataclass(frozen=True)
class Presence:
    """Answer to one image; `score` is NaN and `in_contact` None while the reference is being captured.

    `refused` says why the frames that were captured are no reference; else it is empty.
    """

    score: float
    in_contact: bool | None
    refused: str = ""


class ContactPresence:
    """Compares prepared images (the preprocessor's output) with a no-contact reference, with hysteresis.

    The score is the largest mean absolute change over a patch of the image, less what noise makes of it.
    Each pixel's change counts only as far as it exceeds the pixel's own noise: where a threshold meets an
    even ground, whole areas flicker without any contact. The first `reference_frames` images make the
    reference and the noise level, unless `set_reference` gives them::

        presence = ContactPresence(PresenceSettings())
        answer = presence.update(estimator.preprocessor(image))

    Attributes
    ----------
    objection : callable
        Says of a prepared image why it cannot be one without contact; empty if it can. Frames that end with
        such an image are refused.
    """

    def __init__(self, settings: PresenceSettings | None = None) -> None:
        self.settings = settings or PresenceSettings()
        self.objection: Callable[[Prepared], str] = lambda prepared: ""
        self.reset()

    def reset(self) -> None:
        """Forget the reference; the next frames, which must be without contact, make a new one."""
        self._reference: Prepared | None = None
        self._noise: Prepared | None = None
        self._floor = self._spread = 0.0
        self.capture()

    def capture(self, compare: bool = True) -> None:
        """Have the next frames, which must be without contact, make a new reference.

        With `compare` they are refused if contact would be seen in them by the reference that is there. If
        they are refused that one stays; where there is none, the frames after them are captured.
        """
        self._captured: list[Prepared] = []
        self._capturing, self._compare = True, compare
        self._in_contact = False

    @property
    def ready(self) -> bool:
        """A reference is there, and no other one is being captured."""
        return not self._capturing

    @property
    def touched(self) -> bool:
        """Whether there was contact in the last image."""
        return self._in_contact

    @property
    def reference(self) -> Prepared | None:
        """Mean no-contact image, (size, size) or in color (size, size, 3), or None."""
        return self._reference

    def configure(self, settings: PresenceSettings) -> None:
        """Use other thresholds from the next image on; another window needs a new reference."""
        other, self.settings = settings.window != self.settings.window, settings
        if other:
            self.capture()

    def set_reference(self, images: ArrayLike) -> None:
        """Make the reference from prepared images without contact, N >= 2 of them, each as for `update`.

        Raises `ValueError` with fewer than two images: the noise could not be estimated.
        """
        stack = np.asarray(images, dtype=np.float32)
        if stack.ndim < 3 or len(stack) < 2:
            raise ValueError(f"presence reference: must be at least two images, has the shape {stack.shape}")
        stack = np.stack([_picture(image) for image in stack])
        self._in_contact = self._capturing = False
        # Frames judged by a reference that they are part of would look calmer than new ones: each half is
        # judged by the other.
        halves = (stack[::2], stack[1::2])
        scores = []
        for own, other in (halves, halves[::-1]):
            self._reference, self._noise = _mean_and_noise(other)
            scores += [self._change(image) for image in own]
        self._floor = float(np.median(scores))
        self._spread = float(np.std(scores, ddof=1))
        self._reference, self._noise = _mean_and_noise(stack)

    def update(self, prepared: Prepared) -> Presence:
        """Score one prepared image (size, size) or (1, channels, size, size).

        Raises `ValueError` if its size is not the reference's.
        """
        if self._capturing:
            self._captured.append(prepared.copy())
            if len(self._captured) >= self.settings.reference_frames:
                return Presence(float("nan"), None, self._take_captured(prepared))
            return Presence(float("nan"), None)
        assert self._reference is not None
        image = _picture(prepared)
        if image.shape != self._reference.shape:
            raise ValueError(f"presence: image is {image.shape}, the reference {self._reference.shape}")
        score = self._score(image)
        self._in_contact = score >= self._threshold(self._in_contact)
        return Presence(score, self._in_contact)

    def _take_captured(self, last: Prepared) -> str:
        """Make the reference of what was captured; or why that is none."""
        captured, self._captured = self._captured, []
        refused = self.objection(last)
        if not refused and self._compare and self._reference is not None:
            score, threshold = self._score(_picture(np.mean(captured, axis=0))), self._threshold(False)
            if score >= threshold:
                refused = f"its change against the last one is {score:.3f}, must be below {threshold:.3f}"
        if not refused:
            self.set_reference(captured)
        self._capturing = self._reference is None
        return refused

    def _score(self, image: Prepared) -> float:
        return max(0.0, self._change(image) - self._floor)

    def _threshold(self, in_contact: bool) -> float:
        """The score from which on there is contact, where there was or was not before."""
        margin = _NOISE_MARGIN * self._spread
        return max(self.settings.off if in_contact else self.settings.on, margin)

    def _change(self, image: Prepared) -> float:
        """Largest patch mean of the absolute change beyond each pixel's noise."""
        assert self._reference is not None and self._noise is not None
        window = round(self.settings.window * len(image) / _WINDOW_REFERS_TO)
        window = min(max(window, 1), _LARGEST_WINDOW)
        return largest_change(image, self._reference, self._noise, window)


def largest_change(image: Prepared, reference: Prepared, noise: Prepared, window: int) -> float:
    """Largest mean over window x window pixels of max(0, |image - reference| - noise).

    All are (rows, cols) or (rows, cols, colors), of which the largest counts, and within 0 and 1. A change of
    more than 1, or NaN, counts as 1.
    """
    change = np.abs(image - reference) - noise
    np.fmin(change, np.float32(1.0), out=change)  # of NaN and 1 that is 1
    np.maximum(change, np.float32(0.0), out=change)
    return float(cv2.blur(change, (window, window), borderType=cv2.BORDER_REFLECT_101).max())


def _picture(prepared: Prepared) -> Prepared:
    """A network's input as (size, size), or in color (size, size, 3)."""
    if prepared.ndim < 3 or prepared.shape[-3] == 1:
        return prepared.reshape(prepared.shape[-2:])
    return np.ascontiguousarray(np.moveaxis(prepared.reshape(prepared.shape[-3:]), 0, -1))


def _mean_and_noise(stack: Prepared) -> tuple[Prepared, Prepared]:
    """Mean image of a stack, and what each pixel strays from it by noise."""
    return stack.mean(axis=0), _PIXEL_NOISE_MARGIN * stack.std(axis=0)
