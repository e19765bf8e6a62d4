"""How real sensors differ from a model, drawn at random: for networks that learn from simulated images and
are used on real ones.

From image to image: a camera that sits a little elsewhere, a skin that deforms a little differently, markers
of another size, and reflections beside them. All of it is done to the image, so that it costs one look-up per
pixel. And other sensors of the same kind: other gel, pins and lens.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, bounds_of, setting
from tactile_scene.simulated_sensors import TacTipSettings

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
_FULL_DEPTH = 3e-3  # m, from which the skin's field has its full size
_ROUNDS = 4  # each leaves a few percent of the error
_COARSE = 16  # px between the nodes of the displacement field


@dataclass(frozen=True)
class VariationSettings(Settings):
    """Standard deviations and ranges of what differs from image to image."""

    shift: float = setting(1.0, unit="px", lower=0.0, upper=50.0, doc="of the camera, per axis (1 sigma)")
    scale: float = setting(0.003, lower=0.0, upper=0.2, doc="of the image, relative (1 sigma)")
    rotation_deg: float = setting(0.3, unit="deg", lower=0.0, upper=45.0, doc="of the camera (1 sigma)")
    field: float = setting(
        1.0, unit="px", lower=0.0, upper=20.0,
        doc="of a smooth displacement of the markers, per axis (1 sigma), at a depth of 3 mm and more",
    )  # fmt: skip
    field_length: float = setting(
        70.0, unit="px", lower=20.0, upper=500.0, doc="over which that displacement changes"
    )
    marker_growth: float = setting(
        0.5, unit="px", lower=0.0, upper=1.0, doc="most that the markers' edges move in or out"
    )
    gain: tuple[float, ...] = setting(
        (0.8, 1.2), lower=0.1, upper=3.0, length=2, doc="least and largest factor on the gray levels"
    )
    reflections: int = setting(10, lower=0, upper=100, doc="most bright spots outside the markers' circle")
    reflection_radius: tuple[float, ...] = setting(
        (205.0, 245.0), unit="px", lower=0.0, upper=4096.0, length=2,
        doc="where they are, from the middle of the image",
    )  # fmt: skip


def varied(
    image: Image, markers: Array, settings: VariationSettings, depth: float, rng: np.random.Generator
) -> tuple[Image, Array]:
    """The image (rows, columns) with differences drawn from `rng`, and where its markers (n, 2) then are.

    `depth` (m) is that of the contact.
    """
    source = _source(image.shape, settings, float(np.clip(depth / _FULL_DEPTH, 0.0, 1.0)), rng)
    moved = cv2.remap(image, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    grown = _grown(moved, float(rng.uniform(-settings.marker_growth, settings.marker_growth)))
    gain = float(rng.uniform(settings.gain[0], settings.gain[1]))
    bright = np.asarray(cv2.convertScaleAbs(grown, alpha=gain), np.uint8)
    return _with_reflections(bright, settings, rng), _brought(markers, source)


def _source(
    shape: tuple[int, ...], settings: VariationSettings, share: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Where each pixel's content comes from, (rows, columns, 2).

    The image is shifted, scaled and turned about its middle, and displaced by a smooth random field.
    """
    rows, columns = shape
    size = (columns // _COARSE + 2, rows // _COARSE + 2)
    middle = np.array([columns, rows]) / 2
    scale, turn = rng.normal(1.0, settings.scale), np.radians(rng.normal(0.0, settings.rotation_deg))
    shift = rng.normal(0.0, settings.shift, 2)
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    grid = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1) * float(_COARSE) - 0.5
    source = (grid - middle) @ np.array([[c, s], [-s, c]]) + middle + shift
    if settings.field > 0.0:
        source += share * settings.field * _smooth_field(size, settings.field_length / _COARSE, rng)
    fine = cv2.resize(
        source.astype(np.float32), (size[0] * _COARSE, size[1] * _COARSE), interpolation=cv2.INTER_LINEAR
    )
    # resizing puts a node into the middle of its step, half a pixel before pixel `half` for the first one
    half = _COARSE // 2
    return np.ascontiguousarray(fine[half : half + rows, half : half + columns])


def _brought(points: Array, source: NDArray[np.float32]) -> Array:
    """Where the content of `points` (n, 2) is, once each pixel has that of `source`; its shifts are small."""
    rows, columns = source.shape[:2]
    shift = source - np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float32)
    place = points.astype(np.float32)
    for _ in range(_ROUNDS if len(points) else 0):
        x, y = np.ascontiguousarray(place.T)
        there = cv2.remap(shift, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        place = points.astype(np.float32) - there[:, 0]
    return place.astype(np.float64)


def _smooth_field(size: tuple[int, int], length: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random vectors (rows, columns, 2) of unit variance with Gaussian correlation over `length` nodes."""
    margin = int(np.ceil(2 * length))
    noise = rng.normal(size=(size[1] + 2 * margin, size[0] + 2 * margin, 2))
    sigma = length / np.sqrt(2)
    smooth = cv2.GaussianBlur(noise, (0, 0), sigma)[margin : margin + size[1], margin : margin + size[0]]
    return np.asarray(smooth * (2 * np.sqrt(np.pi) * sigma))


def _grown(image: Image, by: float) -> Image:
    """Bright parts grown (or, for a negative `by`, shrunk) by a part of a pixel."""
    change = cv2.dilate if by > 0 else cv2.erode
    whole = change(image, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.addWeighted(image, 1 - abs(by), whole, abs(by), 0.0), np.uint8)


def _with_reflections(image: Image, settings: VariationSettings, rng: np.random.Generator) -> Image:
    rows, columns = image.shape
    inner, outer = settings.reflection_radius
    for _ in range(int(rng.integers(0, settings.reflections + 1))):
        angle, radius = rng.uniform(0, 2 * np.pi), rng.uniform(inner, outer)
        center = (int(columns / 2 + radius * np.cos(angle)), int(rows / 2 + radius * np.sin(angle)))
        axes = (int(rng.integers(2, 16)), int(rng.integers(2, 9)))
        gray = int(rng.integers(60, 255))
        cv2.ellipse(image, center, axes, float(np.degrees(angle) + 90.0), 0, 360, gray, -1, cv2.LINE_AA)
    return image


#: Standard deviations of the logarithms of what differs between sensors of one kind, by group and name.
_SPREAD = {
    "skin": {"stiffness_ratio": 0.5, "poisson_ratio": 0.3},
    "markers": {"pitch_deg": 0.04, "pin_length": 0.3},
    "camera": {"focal_length": 0.04, "distance": 0.04, "marker_radius": 0.15},
}
_CENTER = 4.0  # px, standard deviation of where the optical axis is


def other_sensors(sensor: TacTipSettings, count: int, seed: int) -> tuple[TacTipSettings, ...]:
    """`count` sensors of the kind of `sensor`, with other gel, pins and lens; the first is itself."""
    rng = np.random.default_rng([seed, count])
    return (sensor, *(_other_sensor(sensor, rng) for _ in range(count - 1)))


def _other_sensor(sensor: TacTipSettings, rng: np.random.Generator) -> TacTipSettings:
    groups = {}
    for name, spread in _SPREAD.items():
        group = getattr(sensor, name)
        bounds = {each.name: bounds_of(each.metadata, 0) for each in fields(group)}
        changes = {key: getattr(group, key) * np.exp(sigma * rng.normal()) for key, sigma in spread.items()}
        groups[name] = group.replaced(**{key: np.clip(value, *bounds[key]) for key, value in changes.items()})
    camera = groups["camera"]
    column, row = np.array([camera.center_column, camera.center_row]) + rng.normal(0.0, _CENTER, 2)
    groups["camera"] = camera.replaced(center_column=column, center_row=row)
    return replace(sensor, **groups)
