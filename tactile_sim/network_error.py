"""How a network errs on simulated images: bias, spread and stated uncertainty by contact, and how they last.

What a network says of a soft tip is wrong by a smooth function of the contact (its bias), and by what that
function does not know: the way on which the contact came about, friction, curvature. The latter stays while
the contact stays as it is, and changes on the way to another one; only a small part is new in each image.
`tactile fit network-error` fits all of it to a network's answers and writes the file that is loaded here::

    errors = NetworkError(load_error_model(), seed=1)
    errors.begin()                                   # a new contact
    estimate = errors.estimate(T_fs, slips=False)    # Gaussian over X_sf, as the network would state it
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]

SHIPPED = Path(__file__).parent / "data" / "network_error.npz"
#: m of way for each m, and for each rad at the tip's radius, of (x, y, z, alpha, beta, gamma).
WAY = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
_ARRAYS = ("lower", "upper", "coefficients", "way", "noise", "start", "doubt", "justified")
_FIRST, _SECOND = np.triu_indices(7)


@dataclass(frozen=True)
class ErrorModel:
    """Coefficients; errors are log(X_sf stated  X_sf true^-1), rho in m and phi in rad.

    Attributes
    ----------
    lower, upper : (6,)
        Of the Euler contact pose (x, y, z, alpha, beta, gamma) of X_fs (m, rad) in the data; beyond, the
        model goes on as at the border.
    coefficients : (49, 18)
        From `features` to bias (6, m and rad), log of the spread (6) and log of the stated standard
        deviation (6).
    way : (6,)
        Length (m) on which what is beside the bias is forgotten, see `WAY`.
    noise : (6,)
        Standard deviation of what is new in each image.
    start : (6,)
        Part of the spread that a contact begins with, straight from the air.
    doubt : (6,)
        Standard deviation of the log of what is stated, about what the features say: it lasts as the rest.
    justified : (6,)
        How far the log of the spread goes along with that: 1 where all doubt is justified, 0 where none.
    touch, leave : float
        Depths (m) at which contact presence begins and ends.
    """

    lower: Array
    upper: Array
    coefficients: Array
    way: Array
    noise: Array
    start: Array
    doubt: Array
    justified: Array
    touch: float
    leave: float

    def features(self, pose: Array, slips: Array | float) -> Array:
        """Features (..., 49) of contact poses (..., 6) that slip (1) or stick (0): quadratic in the pose;
        linear where it slips, and that times the depth; linear times the depth squared.
        """
        middle, half = 0.5 * (self.upper + self.lower), 0.5 * (self.upper - self.lower)
        scaled = np.minimum(np.maximum((pose - middle) / half, -1.0), 1.0)
        linear = np.concatenate([np.ones((*scaled.shape[:-1], 1)), scaled], axis=-1)
        depth = scaled[..., 2:3]
        slipping = linear * np.asarray(slips, dtype=np.float64)[..., None]
        quadratic = linear[..., _FIRST] * linear[..., _SECOND]
        return np.concatenate([quadratic, slipping, slipping * depth, linear * depth * depth], axis=-1)

    def save(self, path: Path, **about: str) -> None:
        """Write all of it, and texts about where it is from, into an .npz file."""
        np.savez(path, **vars(self), **about)  # type: ignore[arg-type]


@functools.cache
def load_error_model(path: Path = SHIPPED) -> ErrorModel:
    """Read what `ErrorModel.save` wrote."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in _ARRAYS}
        return ErrorModel(**arrays, touch=float(file["touch"]), leave=float(file["leave"]))


class NetworkError:
    """Draws answers of a network for true contacts, one after the other; deterministic by seed.

    With a shape, for so many contacts side by side.
    """

    def __init__(self, model: ErrorModel, seed: int = 0, shape: tuple[int, ...] = ()) -> None:
        self.model = model
        self._random = np.random.default_rng(seed)
        self._rest, self._doubt, self._pose = np.empty((3, *shape, 6))
        self.begin()

    def begin(self, which: NDArray[np.bool_] | None = None) -> None:
        """A new contact, side by side where `which` says so: what lasted of the last one is forgotten."""
        new = ... if which is None else which
        rest, doubt = self._random.standard_normal((2, *self._pose.shape))
        self._rest[new] = (rest * self.model.start)[new]
        self._doubt[new] = doubt[new]
        self._pose[new] = np.nan

    def errors(self, pose: Array, slips: Array | float) -> tuple[Array, Array]:
        """Errors (..., 6) for Euler contact poses (..., 6) of X_fs, and logs of the stated deviations."""
        known = self.model.features(pose, slips) @ self.model.coefficients
        bias, spread, sigma = np.moveaxis(known.reshape(*pose.shape[:-1], 3, 6), -2, 0)
        fresh = self._random.standard_normal((3, *pose.shape))
        way = np.linalg.norm(WAY * (pose - self._pose), axis=-1, keepdims=True)
        kept = np.exp(-np.nan_to_num(way) / self.model.way)  # none yet where a contact is new
        new = np.sqrt(1.0 - kept * kept)
        self._rest = kept * self._rest + new * fresh[0]
        self._doubt = kept * self._doubt + new * fresh[1]
        self._pose = np.array(pose)
        doubt = self.model.doubt * self._doubt
        rest = np.exp(spread + self.model.justified * doubt) * self._rest
        return bias + rest + self.model.noise * fresh[2], sigma + doubt

    def estimate(self, T_fs: Array, slips: bool) -> PoseGaussian:
        """A Gaussian over X_sf about what the network would say of the true X_fs (4, 4)."""
        error, sigma = self.errors(se3.euler_from_pose(T_fs), slips)
        return PoseGaussian(se3.exp(error) @ se3.inverse(T_fs), np.diag(np.exp(2.0 * sigma)))
