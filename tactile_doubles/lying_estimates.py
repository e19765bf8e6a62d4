"""Estimates that lie: what a wrong model, mirrored images or a damaged sensor would have perception say.

Each is a `Lies` for the loop without ROS and changes the estimates of X_sf alone, from `begins` on: whether
there is contact stays what it was. Components are those of the Euler surface contact pose X_fs, (x, y, z,
alpha, beta, gamma): shear, depth, tilts and twist. The same seed gives the same noise, arm by arm::

    lies = drifting((0, 0, 1e-3, 0, 0, 0), begins=5.0)     # the depth is told 1 mm deeper each second
    lies = scaled(-1.0, "z")
    run_arms_offline("plane", options=OfflineOptions(fidelity="fitted", lies=lies))

`LYING_ESTIMATES` has one of each kind, by name, as tests and benches take them.
"""

from __future__ import annotations

import zlib
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import NANOSECOND
from tactile_doubles.lies import Lies
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]
Change = Callable[[str, float, Array], Array]

COMPONENTS = ("x", "y", "z", "alpha", "beta", "gamma")


class LyingEstimates(Lies):
    """Base: `lie` says what is told instead of an estimate of X_sf.

    Parameters
    ----------
    begins, arm
        As of `Lies`.
    seed : int
        Of what is drawn.
    """

    def __init__(self, begins: float = 0.0, arm: str = "", seed: int = 0) -> None:
        super().__init__(begins, arm)
        self.seed = seed
        self._random: dict[str, np.random.Generator] = {}

    def estimate(self, name: str, stamp_ns: int, estimate: PoseGaussian | None) -> PoseGaussian | None:
        """See `Lies`; no estimate stays none."""
        if estimate is None:
            return None
        if not self.begun(stamp_ns, name):
            self.before(name, estimate)
            return estimate
        return self.lie(name, (stamp_ns - self.begins_ns) * NANOSECOND, estimate)

    @abstractmethod
    def lie(self, arm: str, since: float, estimate: PoseGaussian) -> PoseGaussian:
        """What is told in place of an arm's estimate, `since` s after the lie began."""

    def before(self, arm: str, estimate: PoseGaussian) -> None:
        """Take notice of what was still told truly."""

    def drawn(self, arm: str, sigma: Array) -> Array:
        """Normal noise (6,) of these standard deviations (6,), new at each call."""
        if arm not in self._random:
            self._random[arm] = np.random.default_rng([self.seed, zlib.crc32(arm.encode())])
        return sigma * self._random[arm].standard_normal(6)


class LyingPoses(LyingEstimates):
    """The pose is made into another one and keeps its covariance.

    Parameters
    ----------
    change : callable
        Of arm, seconds since the lie began and Euler contact pose (6,), m and rad: what is told for that.
    """

    def __init__(self, change: Change, begins: float = 0.0, arm: str = "", seed: int = 0) -> None:
        super().__init__(begins, arm, seed)
        self.change = change

    def lie(self, arm: str, since: float, estimate: PoseGaussian) -> PoseGaussian:
        """See `LyingEstimates`."""
        euler = self.change(arm, since, se3.euler_from_pose(se3.inverse(estimate.mean)))
        return PoseGaussian(se3.inverse(se3.pose_from_euler(euler)), estimate.cov)


def drifting(rates: ArrayLike, begins: float = 0.0, arm: str = "") -> LyingPoses:
    """The pose wanders off at constant rates (6,), m/s and rad/s."""
    given = _six("rates", rates)
    return LyingPoses(lambda arm, since, euler: euler + since * given, begins, arm)


def offset(by: ArrayLike, begins: float = 0.0, arm: str = "") -> LyingPoses:
    """The pose is off by as much (6,), m and rad, all the time."""
    given = _six("offset", by)
    return LyingPoses(lambda arm, since, euler: euler + given, begins, arm)


def scaled(factor: float, components: str = "", begins: float = 0.0, arm: str = "") -> LyingPoses:
    """Some components (of `COMPONENTS`, with spaces between; empty: all) are told times a factor.

    With -1 they have the other sign: images mirrored left to right lead to that of "x beta gamma".
    """
    chosen = components.split() or COMPONENTS
    if unknown := [name for name in chosen if name not in COMPONENTS]:
        raise ValueError(f"components: {', '.join(unknown)} unknown, must be of {' '.join(COMPONENTS)}")
    factors = np.where([name in chosen for name in COMPONENTS], factor, 1.0)
    return LyingPoses(lambda arm, since, euler: factors * euler, begins, arm)


def turned(angle: float, begins: float = 0.0, arm: str = "") -> LyingPoses:
    """What a model says of images that are turned by an angle (rad) about the sensor's axis."""
    T = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, angle])

    def change(arm: str, since: float, euler: Array) -> Array:
        return se3.euler_from_pose(T @ se3.pose_from_euler(euler) @ se3.inverse(T))

    return LyingPoses(change, begins, arm)


class Noisy(LyingPoses):
    """Normal noise of these standard deviations (6,), m and rad, new in each estimate, that nobody tells."""

    def __init__(self, sigma: ArrayLike, begins: float = 0.0, arm: str = "", seed: int = 0) -> None:
        given = _six("sigma", sigma)
        super().__init__(lambda arm, since, euler: euler + self.drawn(arm, given), begins, arm, seed)


class Frozen(Noisy):
    """The last true pose for ever, with noise on it, so that no two are equal."""

    def __init__(self, sigma: ArrayLike, begins: float = 0.0, arm: str = "", seed: int = 0) -> None:
        super().__init__(sigma, begins, arm, seed)
        self._last: dict[str, PoseGaussian] = {}

    def before(self, arm: str, estimate: PoseGaussian) -> None:
        """See `LyingEstimates`."""
        self._last[arm] = estimate

    def lie(self, arm: str, since: float, estimate: PoseGaussian) -> PoseGaussian:
        """See `LyingEstimates`; where nothing was told before, the first pose is the one that stays."""
        return super().lie(arm, since, self._last.setdefault(arm, estimate))


class LyingCovariance(LyingEstimates):
    """The pose is true, its covariance (6, 6) is made into another one."""

    def __init__(self, change: Callable[[Array], Array], begins: float = 0.0, arm: str = "") -> None:
        super().__init__(begins, arm)
        self.change = change

    def lie(self, arm: str, since: float, estimate: PoseGaussian) -> PoseGaussian:
        """See `LyingEstimates`."""
        return PoseGaussian(estimate.mean, self.change(estimate.cov.copy()))


def _skewed(cov: Array) -> Array:
    """Not symmetric, by as much as its first variances."""
    cov[0, 1] += cov[0, 0]
    return cov


#: What no filter takes for a covariance, by name.
REFUSED_COVARIANCES: Mapping[str, Callable[[Array], Array]] = {
    "not a number": lambda cov: np.full_like(cov, np.nan),
    "zero": np.zeros_like,
    "negative": np.negative,
    "not symmetric": _skewed,
    "tiny": lambda cov: 1e-9 * cov,
}


def _six(name: str, values: ArrayLike) -> Array:
    given = np.array(values, dtype=np.float64)
    if given.shape != (6,):
        raise ValueError(f"{name}: must be 6 numbers ({', '.join(COMPONENTS)}), has shape {given.shape}")
    return given


def _alone(component: str, value: float) -> Sequence[float]:
    return [value if name == component else 0.0 for name in COMPONENTS]


Make = Callable[[float, str], LyingEstimates]


def _kinds() -> dict[str, Make]:
    kinds: dict[str, Make] = {}
    for name in COMPONENTS:
        rate = 1e-3 if name in "xyz" else np.radians(3.0)
        kinds[f"{name} drifts up"] = partial(drifting, _alone(name, rate))
        kinds[f"{name} drifts down"] = partial(drifting, _alone(name, -rate))
        kinds[f"{name} flipped"] = partial(scaled, -1.0, name)
    kinds |= {
        "tilts flipped": partial(scaled, -1.0, "alpha beta"),
        "images mirrored": partial(scaled, -1.0, "x beta gamma"),
        "images turned by 90 degrees": partial(turned, np.pi / 2),
        "images turned by 180 degrees": partial(turned, np.pi),
        "5 mm of noise": partial(Noisy, [5e-3] * 3 + [0.0] * 3),
        "10 degrees of noise": partial(Noisy, [0.0] * 3 + [0.17] * 3),
        "twice as large": partial(scaled, 2.0, ""),
        "half as large": partial(scaled, 0.5, ""),
        "frozen": partial(Frozen, np.zeros(6)),
        "frozen with noise": partial(Frozen, [2e-5] * 3 + [1e-3] * 3),
        "2 mm too deep": partial(offset, _alone("z", 2e-3)),
        "2 mm too shallow": partial(offset, _alone("z", -2e-3)),
    }
    refused = REFUSED_COVARIANCES.items()
    return kinds | {f"covariance {name}": partial(LyingCovariance, change) for name, change in refused}


#: One of each kind, made of when it begins (s) and of whom (an arm; empty: all).
LYING_ESTIMATES: Mapping[str, Make] = _kinds()
