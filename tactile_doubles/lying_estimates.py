"""Estimates that lie: what a wrong model, mirrored images or a damaged sensor would have perception say.

Each is a `Lies` for the loop without ROS and changes the estimates of X_sf alone, from `begins` on: whether
there is contact stays what it was. Components are those of the Euler surface contact pose X_fs, (x, y, z,
alpha, beta, gamma): shear, depth, tilts and twist. The same seed gives the same noise, arm by arm::

    lies = Drifting((0, 0, 1e-3, 0, 0, 0), begins=5.0)     # the depth is told 1 mm deeper each second
    lies = Flipped("z")
    run_arms_offline("plane", options=OfflineOptions(fidelity="fitted", lies=lies))

`LYING_ESTIMATES` has one of each kind, by name, as tests and benches take them.
"""

from __future__ import annotations

import zlib
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.stamps import NANOSECOND
from tactile_doubles.lies import Lies
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]

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
    """Base of those that change the pose and keep the covariance: `euler` says how."""

    def lie(self, arm: str, since: float, estimate: PoseGaussian) -> PoseGaussian:
        """See `LyingEstimates`."""
        euler = self.euler(arm, since, se3.euler_from_pose(se3.inverse(estimate.mean)))
        return PoseGaussian(se3.inverse(se3.pose_from_euler(euler)), estimate.cov)

    @abstractmethod
    def euler(self, arm: str, since: float, euler: Array) -> Array:
        """What is told for the Euler contact pose (6,), m and rad."""


class Drifting(LyingPoses):
    """The pose wanders off at constant rates (6,), m/s and rad/s."""

    def __init__(self, rates: ArrayLike, begins: float = 0.0, arm: str = "") -> None:
        super().__init__(begins, arm)
        self.rates = _six("rates", rates)

    def euler(self, arm: str, since: float, euler: Array) -> Array:
        """See `LyingPoses`."""
        return euler + since * self.rates


class Offset(LyingPoses):
    """The pose is off by as much (6,), m and rad, all the time."""

    def __init__(self, offset: ArrayLike, begins: float = 0.0, arm: str = "") -> None:
        super().__init__(begins, arm)
        self.offset = _six("offset", offset)

    def euler(self, arm: str, since: float, euler: Array) -> Array:
        """See `LyingPoses`."""
        return euler + self.offset


class Scaled(LyingPoses):
    """Some components are told too large or too small, or with the other sign.

    Parameters
    ----------
    factor : float
        By what they are multiplied.
    components : str
        Some of `COMPONENTS`, with spaces between them; empty: all.
    """

    def __init__(self, factor: float, components: str = "", begins: float = 0.0, arm: str = "") -> None:
        super().__init__(begins, arm)
        chosen = components.split() or COMPONENTS
        unknown = [name for name in chosen if name not in COMPONENTS]
        if unknown:
            raise ValueError(f"components: {', '.join(unknown)} unknown, must be of {' '.join(COMPONENTS)}")
        self.factors = np.where([name in chosen for name in COMPONENTS], factor, 1.0)

    def euler(self, arm: str, since: float, euler: Array) -> Array:
        """See `LyingPoses`."""
        return self.factors * euler


class Flipped(Scaled):
    """Some components have the other sign. Images mirrored left to right lead to "x beta gamma"."""

    def __init__(self, components: str, begins: float = 0.0, arm: str = "") -> None:
        super().__init__(-1.0, components, begins, arm)


class Turned(LyingPoses):
    """What a model says of images that are turned by an angle (rad) about the sensor's axis."""

    def __init__(self, angle: float, begins: float = 0.0, arm: str = "") -> None:
        super().__init__(begins, arm)
        self._turn = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, angle])

    def euler(self, arm: str, since: float, euler: Array) -> Array:
        """See `LyingPoses`."""
        return se3.euler_from_pose(self._turn @ se3.pose_from_euler(euler) @ se3.inverse(self._turn))


class Noisy(LyingPoses):
    """Normal noise of these standard deviations (6,), m and rad, new in each estimate, that nobody tells."""

    def __init__(self, sigma: ArrayLike, begins: float = 0.0, arm: str = "", seed: int = 0) -> None:
        super().__init__(begins, arm, seed)
        self.sigma = _six("sigma", sigma)

    def euler(self, arm: str, since: float, euler: Array) -> Array:
        """See `LyingPoses`."""
        return euler + self.drawn(arm, self.sigma)


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


def _drifting(component: str, rate: float) -> Make:
    return lambda begins, arm: Drifting(_alone(component, rate), begins, arm)


def _flipped(component: str) -> Make:
    return lambda begins, arm: Flipped(component, begins, arm)


def _covariance(change: Callable[[Array], Array]) -> Make:
    return lambda begins, arm: LyingCovariance(change, begins, arm)


def _kinds() -> dict[str, Make]:
    kinds: dict[str, Make] = {}
    for name in COMPONENTS:
        rate = 1e-3 if name in "xyz" else np.radians(3.0)
        kinds[f"{name} drifts up"] = _drifting(name, rate)
        kinds[f"{name} drifts down"] = _drifting(name, -rate)
        kinds[f"{name} flipped"] = _flipped(name)
    quiet = [2e-5] * 3 + [1e-3] * 3
    kinds |= {
        "tilts flipped": _flipped("alpha beta"),
        "images mirrored": _flipped("x beta gamma"),
        "images turned by 90 degrees": lambda begins, arm: Turned(np.pi / 2, begins, arm),
        "images turned by 180 degrees": lambda begins, arm: Turned(np.pi, begins, arm),
        "5 mm of noise": lambda begins, arm: Noisy([5e-3] * 3 + [0.0] * 3, begins, arm),
        "10 degrees of noise": lambda begins, arm: Noisy([0.0] * 3 + [0.17] * 3, begins, arm),
        "twice as large": lambda begins, arm: Scaled(2.0, "", begins, arm),
        "half as large": lambda begins, arm: Scaled(0.5, "", begins, arm),
        "frozen": lambda begins, arm: Frozen(np.zeros(6), begins, arm),
        "frozen with noise": lambda begins, arm: Frozen(quiet, begins, arm),
        "2 mm too deep": lambda begins, arm: Offset(_alone("z", 2e-3), begins, arm),
        "2 mm too shallow": lambda begins, arm: Offset(_alone("z", -2e-3), begins, arm),
    }
    return kinds | {f"covariance {name}": _covariance(change) for name, change in REFUSED_COVARIANCES.items()}


#: One of each kind, made of when it begins (s) and of whom (an arm; empty: all).
LYING_ESTIMATES: Mapping[str, Make] = _kinds()
