"""How a network errs on simulated images, for sensors of fidelity "fitted": `tactile fit network-error`.

The skin is simulated along random ways in contact (pressed, rolled, sheared until it slips, turned), the
network answers, and `tactile_sim.network_error.ErrorModel` is fitted. Images are drawn at the
network's size for the fit and in full for the contacts held out, on which both are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from tactile_bringup.offline_perception import network_view
from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.presence import ContactPresence
from tactile_scene.shapes.plane import Plane
from tactile_sim.collection import Sphere, along_surface
from tactile_sim.network_error import WAY, ErrorModel, NetworkError
from tactile_sim.tactip import ContactTruth, TacTip

Array = NDArray[np.float64]

FRICTION = (0.6, 1.2)  # as in the network's training data
CURVATURE = (-5.0, 16.0)  # 1/m
EXPOSURES = 90  # of a contact
LEAST, LARGEST = 1e-3, 6e-3  # depth on the way, m
TILT = 0.40  # rad: largest angle of both together
APPROACH = 6.7e-5  # m between two exposures at 4 mm/s
LAGS = (1, 2, 4, 8, 16, 32, 48, 64, 80)  # exposures
RIDGE = 3.0  # keeps what hardly matters small
SHOWN = np.array([1e3] * 3 + [180.0 / np.pi] * 3)  # mm and degrees


@dataclass
class Contacts:
    """Exposures (N rows): what was true, and what the network said.

    Attributes
    ----------
    contact : (N,) int
    truth : (N, 4, 4)
        X_fs as the picture can know it.
    slips : (N,) bool
        Whether more than half of the normal force is on nodes that slip.
    error : (N, 6)
        log(X_sf stated  X_sf true^-1), m and rad.
    again : (N, 6)
        Of a second image of the same contact.
    sigma : (N, 6)
        Standard deviations stated, of the left perturbation.
    nees : (N,)
        Of the error by the stated covariance.
    touch, leave : (contacts,)
        Depths (m) at which contact presence began and ended; empty where images are not drawn in full.
    """

    contact: NDArray[np.int64]
    truth: Array
    slips: NDArray[np.bool_]
    error: Array
    again: Array
    sigma: Array
    nees: Array
    touch: Array
    leave: Array

    @property
    def pose(self) -> Array:
        """Euler numbers (N, 6) of the truth."""
        return se3.euler_from_pose(self.truth)

    @property
    def way(self) -> Array:
        """Length (N,) of the way so far, m."""
        return np.cumsum(np.r_[0.0, np.linalg.norm(WAY * np.diff(self.pose, axis=0), axis=1)])


def way_of(rng: np.random.Generator) -> Array:
    """Poses (n, 6) of the tip over the surface, x and y along it: about a reference, as servoing keeps it."""
    reference = np.array([0.0, 0.0, rng.uniform(LEAST, LARGEST), *rng.normal(0.0, 0.12, 2), 0.0])
    poses = [_kept(reference)]
    while len(poses) < EXPOSURES:
        change = rng.normal(size=6) * [4e-3, 4e-3, 5e-4, 0.08, 0.08, 0.05] * (rng.random(6) < 0.6)
        following = _kept(reference + change)
        length = float(np.linalg.norm(WAY * (following - poses[-1])))
        steps = max(1, round(length / rng.uniform(8e-5, 4e-4)))
        last = poses[-1]
        poses += [last + (following - last) * k / steps for k in range(1, steps + 1)]
    return np.array(poses[:EXPOSURES])


def _kept(pose: Array) -> Array:
    """Within the ranges that the network was trained for."""
    pose = pose.copy()
    pose[2] = np.clip(pose[2], LEAST, LARGEST)
    pose[3:5] *= min(1.0, TILT / max(float(np.hypot(*pose[3:5])), 1e-9))
    return pose


class Ways:
    """One sensor pressed onto surfaces, and the network that looks at it."""

    def __init__(self, estimator: Estimator, full: bool) -> None:
        self.estimator, self.full = estimator, full
        self.sensor = TacTip(view=None if full else network_view(estimator))

    def contacts(self, seeds: range) -> Contacts:
        """One contact a seed."""
        found = [self._contact(seed) for seed in seeds]
        joined = {f.name: [getattr(each, f.name) for each in found] for f in fields(Contacts)}
        return Contacts(**{name: np.concatenate(parts) for name, parts in joined.items()})

    def _contact(self, seed: int) -> Contacts:
        rng = np.random.default_rng([7, seed])
        self.sensor.reset(seed)
        self.sensor.friction = float(rng.uniform(*FRICTION))
        curvature = float(rng.uniform(*CURVATURE))
        self.curvature = curvature if abs(curvature) > 0.1 else 0.0
        self.surface = Sphere(curvature) if self.curvature else Plane()
        way = way_of(rng)
        touch = self._approach(way[0]) if self.full else []
        rows = [self._exposed(seed, pose) for pose in way]
        leave = self._retreat(way[-1]) if self.full else []
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        parts = [*columns, np.array(touch), np.array(leave)]
        return Contacts(**{f.name: part for f, part in zip(fields(Contacts), parts, strict=True)})

    def _exposed(self, seed: int, pose: Array) -> tuple[int, Array, bool, Array, Array, Array, float]:
        truth = self._move(pose, pose[2])
        stated = [self.estimator.estimate_prepared(self._image()) for _ in range(2 if self.full else 1)]
        errors = [se3.log(each.mean @ truth.T_fs) for each in stated]  # X_sf^-1 = X_fs
        nees = float(errors[0] @ np.linalg.solve(stated[0].cov, errors[0]))
        sigma = np.sqrt(np.diag(stated[0].cov))
        return seed, truth.T_fs, truth.slip_fraction > 0.5, errors[0], errors[-1], sigma, nees

    def _approach(self, pose: Array) -> list[float]:
        self.presence = ContactPresence()
        for _ in range(self.presence.settings.reference_frames):
            self._sees(pose, -1e-3)
        depths = np.arange(-2e-4, pose[2], APPROACH)
        seen = [self._sees(pose, float(depth)) for depth in depths]
        return [float(depths[seen.index(True)])]

    def _retreat(self, pose: Array) -> list[float]:
        depth = float(pose[2])
        while self._sees(pose, depth) and depth > -5e-4:
            depth -= APPROACH
        return [depth]

    def _sees(self, pose: Array, depth: float) -> bool:
        self._move(pose, depth)
        return bool(self.presence.update(self._image()).in_contact)

    def _image(self) -> NDArray[np.float32]:
        image = self.sensor.image()
        prepare = self.estimator.preprocessor
        return prepare(image) if self.full else prepare.from_processed(image)

    def _move(self, pose: Array, depth: float) -> ContactTruth:
        along = along_surface(pose[0], -pose[1], self.curvature)
        T_surface_f = se3.pose_from_euler([0.0, 0.0, self.sensor.settings.skin.radius, np.pi, 0.0, 0.0])
        self.sensor.advance(self.surface, along @ T_surface_f @ se3.pose_from_euler([0, 0, depth, *pose[3:]]))
        return self.sensor.truth()


def fit(data: Contacts, held: Contacts) -> ErrorModel:
    """Least squares for bias, log of the spread and of the stated deviation, then how the rest lasts.

    For the bias each error counts by the deviation that the network states with it.

    The noise of images and the depths of presence are those of the contacts held out, drawn in full.
    """
    pose = data.pose
    model = ErrorModel(
        lower=np.quantile(pose, 0.005, axis=0), upper=np.quantile(pose, 0.995, axis=0),
        coefficients=np.zeros((49, 18)), way=np.ones(6),
        noise=np.sqrt(0.5 * np.mean((held.error - held.again) ** 2, axis=0)),
        start=np.ones(6), doubt=np.zeros(6), justified=np.zeros(6),
        touch=float(np.median(held.touch)), leave=float(np.median(held.leave)),
    )  # fmt: skip
    features = model.features(pose, data.slips.astype(np.float64))
    bias = np.empty((features.shape[1], 6))
    for k in range(6):
        weight = 1.0 / data.sigma[:, k]
        bias[:, k] = _least_squares(features * weight[:, None], data.error[:, k] * weight, weight.mean())
    rest = data.error - features @ bias
    least = 0.05 * rest.std(axis=0)
    sigma = _least_squares(features, np.log(data.sigma))
    doubt = np.log(data.sigma) - features @ sigma
    model.doubt[:] = doubt.std(axis=0)
    spread = np.empty_like(bias)
    for k in range(6):
        found = _least_squares(
            np.hstack([features, doubt[:, k, None]]), 0.5 * np.log(rest[:, k] ** 2 + least[k] ** 2)
        )
        spread[:, k], model.justified[k] = found[:-1], found[-1]
    scale = np.exp(features @ spread + model.justified * doubt)
    root = np.sqrt(np.mean((rest / scale) ** 2, axis=0))
    spread[0] += np.log(root)
    model.coefficients[:] = np.hstack([bias, spread, sigma])
    whitened = rest / (root * scale)
    first = np.flatnonzero(np.diff(data.contact, prepend=-1))
    model.start[:] = np.sqrt(np.mean(whitened[first] ** 2, axis=0))
    lag_way, similar = correlations(data, whitened)
    for k in range(6):
        (model.way[k],), _ = curve_fit(lambda x, way: np.exp(-x / way), lag_way, similar[:, k], p0=(3e-3,))
    return model


def _least_squares(features: Array, values: Array, weight: float = 1.0) -> Array:
    """Coefficients (f,) or (f, n), kept small by as much as `RIDGE` rows of that weight."""
    ridge = RIDGE * weight * np.eye(features.shape[1])
    ridge[0, 0] = 0.0
    zero = np.zeros((len(ridge), *values.shape[1:]))
    return np.linalg.lstsq(np.vstack([features, ridge]), np.concatenate([values, zero]), rcond=None)[0]


def correlations(data: Contacts, values: Array) -> tuple[Array, Array]:
    """Mean way (lags,) in m and correlation (lags, 6) of values (N, 6) of one contact, by `LAGS`."""
    way, square = data.way, np.mean(values**2, axis=0)
    ways, found = [], []
    for lag in LAGS:
        same = data.contact[lag:] == data.contact[:-lag]
        ways.append((way[lag:] - way[:-lag])[same].mean())
        found.append((values[lag:][same] * values[:-lag][same]).mean(axis=0) / square)
    return np.array(ways), np.array(found)


def drawn(model: ErrorModel, data: Contacts, seed: int) -> Contacts:
    """Copy the contacts, with answers of the error model in place of the network's."""
    errors, rows = NetworkError(model, seed), []
    for k in range(len(data.contact)):
        if k == 0 or data.contact[k] != data.contact[k - 1]:
            errors.begin()
        stated = errors.estimate(data.truth[k], bool(data.slips[k]))
        error = se3.log(stated.mean @ data.truth[k])
        rows.append((error, np.sqrt(np.diag(stated.cov)), error @ np.linalg.solve(stated.cov, error)))
    error, sigma, nees = (np.array(column) for column in zip(*rows, strict=True))
    return Contacts(data.contact, data.truth, data.slips, error, error, sigma, nees, data.touch, data.leave)


STATISTICS: dict[str, Callable[[Contacts], Array]] = {
    "RMS error": lambda c: np.sqrt(np.mean(c.error**2, axis=0)),
    "mean error": lambda c: c.error.mean(axis=0),
    "median of |error|": lambda c: np.median(np.abs(c.error), axis=0),
    "95 % of |error|": lambda c: np.quantile(np.abs(c.error), 0.95, axis=0),
    "RMS error where it slips": lambda c: np.sqrt(np.mean(c.error[c.slips] ** 2, axis=0)),
    "RMS error where it sticks": lambda c: np.sqrt(np.mean(c.error[~c.slips] ** 2, axis=0)),
    "median of stated sigma": lambda c: np.median(c.sigma, axis=0),
}


def compared(network: Contacts, model: Contacts) -> Iterator[tuple[str, str, Array]]:
    """Statistic, whose, and numbers (6,): mm and degrees; correlations without a unit."""
    both = (("network", network), ("model", model))
    for name, of in STATISTICS.items():
        for who, contacts in both:
            yield name, who, of(contacts) * SHOWN
    (way, ours), (_, theirs) = (correlations(contacts, contacts.error) for _, contacts in both)
    for k in range(len(LAGS)):
        for who, row in (("network", ours[k]), ("model", theirs[k])):
            yield f"correlation after {way[k] * 1e3:.2f} mm", who, row
