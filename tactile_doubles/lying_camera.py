"""Cameras that lie: images that do not show what the sensor feels now, for tests of what believes them.

Each has a name in `LYING_CAMERAS`, and is called with a true image, gray (rows, columns) uint8, for the
one that it gives in its place. It may remember what it was shown before it began to lie (`see`)::

    camera = LYING_CAMERAS["frozen"](seed=1)
    camera.see(image)                       # while it still tells the truth
    image = camera(image)                   # from then on

A run without ROS, held against the cell's truth (`tactile_doubles.lies`)::

    lies = ImageLies("mirrored", begins=6.0)
    run_arms_offline("plane", options=OfflineOptions(fidelity="image", lies=lies))
    lies.witness["arm"].deepest                          # m

None of them needs ROS; between a camera's node and an estimator, a node that passes each image through one
does. What they give is fixed by the seed and by what they were shown.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from typing import ClassVar

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from tactile_doubles.lies import Lies

Image = NDArray[np.uint8]
_PACKET = 1024  # bytes of a USB packet that is lost
_SENSOR_NOISE = 2.0  # standard deviation, gray levels


Lie = Callable[["LyingCamera", Image], Image]


class LyingCamera:
    """What it gives for an image `lie` says; one that remembers overrides `__call__` and `see`."""

    def __init__(self, seed: int = 0, lie: Lie | None = None) -> None:
        self.random, self._lie = np.random.default_rng(seed), lie

    def see(self, image: Image) -> None:
        """Take a true image before the lie begins."""

    def __call__(self, image: Image) -> Image:
        """What it gives for a true image."""
        return image if self._lie is None else self._lie(self, image)

    def noisy(self, image: NDArray) -> Image:
        """Gray levels with the noise of a camera's sensor, anew each time."""
        noise = self.random.normal(0.0, _SENSOR_NOISE, image.shape)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _turned_90(camera: LyingCamera, image: Image) -> Image:
    """About the image's middle, as large as before: what lies outside is lost, what is missing is black."""
    rows, columns = image.shape
    turn = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), 90.0, 1.0)
    return np.asarray(cv2.warpAffine(image, turn, (columns, rows)), np.uint8)


def _patch(level: float) -> Lie:
    """A seventh of the image, in its middle, shows nothing but a gray level."""

    def lie(camera: LyingCamera, image: Image) -> Image:
        rows, columns = image.shape
        side = round((rows * columns / 7.0) ** 0.5)
        top, left = (rows - side) // 2, (columns - side) // 2
        result = image.copy()
        result[top : top + side, left : left + side] = camera.noisy(np.full((side, side), level))
        return result

    return lie


def _shifted(camera: LyingCamera, image: Image) -> Image:
    shift = np.array([[1.0, 0.0, 40.0], [0.0, 1.0, 30.0]])
    return np.asarray(cv2.warpAffine(image, shift, image.shape[::-1]), np.uint8)


def _torn(camera: LyingCamera, image: Image) -> Image:
    data = torn(jpeg(image), camera.random)
    return simplejpeg.decode_jpeg(data, "GRAY", strict=False)[:, :, 0]


class Frozen(LyingCamera):
    """A driver or a frame grabber that hands out one buffer for ever, with fresh stamps."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self._kept: Image | None = None

    def see(self, image: Image) -> None:
        self._kept = image.copy()

    def __call__(self, image: Image) -> Image:
        if self._kept is None:
            self._kept = image.copy()
        return self._kept.copy()


class FrozenNoisy(Frozen):
    """A scene that stands still before a camera that works: the tip has come off, or a mirror is stuck."""

    def __call__(self, image: Image) -> Image:
        return self.noisy(super().__call__(image))


class Replayed(LyingCamera):
    """A recording in place of the camera: the last second before the lie, over and over."""

    length: ClassVar[int] = 60

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        self._tape: deque[Image] = deque(maxlen=self.length)
        self._shown = 0

    def see(self, image: Image) -> None:
        self._tape.append(image.copy())

    def __call__(self, image: Image) -> Image:
        if not self._tape:
            return image
        shown = self._tape[self._shown % len(self._tape)]
        self._shown += 1
        return shown.copy()


def _of(lie: Lie) -> Callable[..., LyingCamera]:
    return functools.partial(LyingCamera, lie=lie)


#: By name; what leads to such images in a real cell stands beside.
LYING_CAMERAS: dict[str, Callable[..., LyingCamera]] = {
    "mirrored": _of(lambda camera, image: image[:, ::-1].copy()),  # `hflip`, another idea of columns
    "upside_down": _of(lambda camera, image: image[::-1].copy()),  # `vflip`
    "turned_180": _of(lambda camera, image: image[::-1, ::-1].copy()),  # mounted the other way round
    "turned_90": _of(_turned_90),
    "frozen": Frozen,
    "frozen_noisy": FrozenNoisy,
    # an analog input without a signal
    "noise": _of(lambda camera, image: camera.random.integers(0, 256, image.shape, dtype=np.uint8)),
    "black": _of(lambda camera, image: camera.noisy(np.zeros(image.shape))),  # a lamp or a lens cap
    # a covered lens, a saturated sensor
    "grey": _of(lambda camera, image: camera.noisy(np.full(image.shape, 128.0))),
    "patch": _of(_patch(10.0)),  # dirt on the lens, a drop of gel
    "glare": _of(_patch(240.0)),  # a lamp that is mirrored in the gel
    # a lens that has turned: edges blurred by 4 px, where 2 are still called sharp (docs/own_camera.md)
    "defocused": _of(lambda camera, image: camera.noisy(cv2.GaussianBlur(image, (0, 0), 4.0))),
    "shifted": _of(_shifted),  # another crop, or a camera that was knocked
    "torn": _of(_torn),  # a USB packet of each JPEG was lost, and the decoder says nothing of it
    "replayed": Replayed,
}


class ImageLies(Lies):
    """A run without ROS whose camera lies from a moment on.

    Parameters
    ----------
    kind : str
        One of `LYING_CAMERAS`.
    begins, arm
        As of `Lies`.
    ends : float
        When it tells the truth again, s of the cell's time.
    seed : int
        Of each arm's lying camera.
    """

    def __init__(
        self, kind: str, begins: float = 0.0, arm: str = "", ends: float = float("inf"), seed: int = 0
    ) -> None:
        super().__init__(begins, arm)
        self._ends, self._kind, self._seed = ends, LYING_CAMERAS[kind], seed
        self._cameras: dict[str, LyingCamera] = {}

    def image(self, name: str, stamp_ns: int, image: Image) -> Image:
        """See `Lies`."""
        camera = self._cameras.setdefault(name, self._kind(self._seed))
        if self.begun(stamp_ns, name) and stamp_ns * 1e-9 < self._ends:
            return camera(image)
        camera.see(image)
        return image


def jpeg(image: Image, quality: int = 90) -> bytes:
    """An image as a camera in the format MJPG sends it: in Y'CbCr with half the columns of color."""
    options = [
        cv2.IMWRITE_JPEG_QUALITY, quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    ]  # fmt: skip
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), options)
    assert done
    return data.tobytes()


def torn(data: bytes, random: np.random.Generator, lost: int = _PACKET) -> bytes:
    """A JPEG of whose scan a packet is lost somewhere; begin and end are there, so that it looks whole.

    Where the scan begins: ITU-T T.81, B.1.1.3 and B.2.3: segments with their lengths, up to that of the
    marker SOS, 0xFFDA.
    """
    at = 2
    while data[at + 1] != 0xDA:
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    scan = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    gap = int(random.integers(scan, max(scan + 1, len(data) - 2 - lost)))
    return data[:gap] + data[gap + lost :]
