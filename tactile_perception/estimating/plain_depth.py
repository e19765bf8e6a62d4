"""PlainDepth: how deep a contact is by a weighted sum of an image's brightness, as a check on a network.

A network is right where its training data are and may say anything elsewhere; a stuck or damaged one goes on
saying something. The depth of a contact is also seen by far simpler means: a ridge regression on the mean
brightness of 16 x 16 fields is right to 0.4 mm (RMS, docs/results/perception.md) and errs for other reasons.
Where both are far apart, the network is not believed::

    plain = PlainDepth.fit(images, depths)     # of the training images
    plain(preprocessor(image)), plain.rms      # m
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.input_file import parse_json
from tactile_perception.estimating.image import Image, gray
from tactile_perception.estimating.preprocessing import brightness

Array = NDArray[np.float64]

FIELDS = 16  # a side
_RIDGES = 0.1 * 10.0 ** (0.5 * np.arange(7))  # the best of these is taken, by leaving one out


class PlainDepthError(ValueError):
    """What is no `PlainDepth`, or cannot be fitted."""


@dataclass(frozen=True)
class PlainDepth:
    """A weighted sum of brightnesses (0 to 1) of fields.

    Attributes
    ----------
    weights : (FIELDS, FIELDS), m
    constant : float
        m.
    rms : float
        Of its errors on images that it was not fitted to, m.
    """

    weights: NDArray[np.float32]
    constant: float
    rms: float

    def __call__(self, prepared: NDArray[np.float32]) -> float:
        """Depth (m) of a contact by the network's input, (size, size) or (1, channels, size, size)."""
        return self.constant + float(np.vdot(self.weights, _fields(brightness(prepared))))

    @classmethod
    def fit(cls, images: Image, depths: ArrayLike) -> PlainDepth:
        """Of prepared images (N, size, size[, 3]), uint8, and their true depths (N,), m.

        Raises `PlainDepthError` for fewer than two images.
        """
        depths = np.asarray(depths, np.float64)
        if len(depths) < 2:
            raise PlainDepthError(f"plain depth: needs at least two images, has {len(depths)}")
        fields = (
            np.array([_fields(gray(image)) for image in images], np.float64).reshape(len(depths), -1) / 255.0
        )
        middle, mean = fields.mean(axis=0), float(depths.mean())
        centered = fields - middle
        scales, axes = np.linalg.eigh(centered.T @ centered)
        scales, parts = np.maximum(scales, 0.0), centered @ axes
        target = parts.T @ (depths - mean)
        rms, coefficients = min(
            (_left_out(parts, depths - mean, target, scales, ridge) for ridge in _RIDGES),
            key=lambda fitted: fitted[0],
        )
        weights = axes @ coefficients
        constant = mean - float(middle @ weights)
        return cls(weights.reshape(FIELDS, FIELDS).astype(np.float32), constant, rms)

    def to_text(self) -> str:
        """As JSON, for a model's metadata; in mm, to a nanometre."""
        values = {
            "weights": np.round(1e3 * self.weights.astype(np.float64), 6).tolist(),
            "constant": 1e3 * self.constant,
            "rms": 1e3 * self.rms,
        }
        return json.dumps(values)

    @classmethod
    def from_text(cls, text: str) -> PlainDepth:
        """The reverse; `PlainDepthError` says what is wrong."""
        try:
            values = parse_json(text)
            weights = 1e-3 * np.array(values["weights"], np.float64)
            constant, rms = 1e-3 * float(values["constant"]), 1e-3 * float(values["rms"])
        except (ValueError, TypeError, KeyError) as error:
            raise PlainDepthError(f"plain depth: must hold weights, constant and rms: {error!r}") from error
        if weights.shape != (FIELDS, FIELDS) or not np.isfinite([*weights.ravel(), constant, rms]).all():
            raise PlainDepthError(
                f"plain depth: weights have the shape {weights.shape}, must be finite and "
                f"({FIELDS}, {FIELDS})"
            )
        return cls(weights.astype(np.float32), constant, rms)


def _fields(image: NDArray) -> NDArray[np.float32]:
    """Mean brightness of the fields of an image (size, size)."""
    image = np.asarray(image, np.float32)
    return np.asarray(cv2.resize(image, (FIELDS, FIELDS), interpolation=cv2.INTER_AREA))


def _left_out(parts: Array, values: Array, target: Array, scales: Array, ridge: float) -> tuple[float, Array]:
    """RMS error of each value predicted from all others, in closed form, and the fit to all of them.

    `parts` (N, n) are the regressors along the axes of their moments, `scales` (n,) these moments.
    """
    coefficients = target / (scales + ridge)
    leverage = 1.0 / len(values) + np.einsum("ij,j,ij->i", parts, 1.0 / (scales + ridge), parts)
    errors = (values - parts @ coefficients) / np.maximum(1.0 - leverage, 1e-9)
    return float(np.sqrt(np.mean(errors**2))), coefficients
