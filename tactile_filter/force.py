"""The force of a contact over time: a random walk in the sensor's frame, corrected by each estimate.

The skin's force follows the contact at once, so that nothing is predicted from the arm's motion: between two
estimates it may have changed, the more the longer they are apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_filter.filter_settings import gate_threshold

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForceGaussian:
    """Mean (3,) in N of the force on the sensor, in its frame, and covariance (3, 3) in N^2."""

    mean: Array
    cov: Array


@dataclass(frozen=True)
class ForceSettings(Settings):
    """How the force of a contact is filtered."""

    noise: float = setting(
        20.0, lower=0.0, upper=1e4, unit="N/sqrt(s)", doc="standard deviation by which it changes in a second"
    )
    gate_probability: float = setting(
        0.999999, lower=0.5, upper=1.0,
        doc="an estimate is refused if its NIS exceeds this quantile of chi-square with 3 degrees of freedom",
    )  # fmt: skip
    reinitialize_after: int = setting(
        5, lower=1, upper=1000, doc="after this many refused in a row the next starts anew"
    )
    max_age: float = setting(
        0.5, lower=0.001, upper=60.0, unit="s", doc="after a gap that is longer the next starts anew"
    )


class ForceFilter:
    """Kalman filter over the force; what is believed is None before the first estimate and without contact.

    Attributes
    ----------
    belief : ForceGaussian or None
    nis : of the last estimate, refused ones included; NaN where it started the belief
    rejected : estimates refused so far
    """

    def __init__(self, settings: ForceSettings | None = None) -> None:
        self.configure(settings or ForceSettings())
        self.belief: ForceGaussian | None = None
        self.nis, self.rejected = math.nan, 0
        self._stamp_ns, self._refused_in_a_row = 0, 0

    def configure(self, settings: ForceSettings) -> None:
        """Take other settings from the next step on."""
        self.settings = settings
        self._gate = gate_threshold(settings.gate_probability, 3)

    def reset(self) -> None:
        """Forget the force, as without contact."""
        self.belief, self.nis, self._refused_in_a_row = None, math.nan, 0

    def step(self, stamp_ns: int, estimate: ForceGaussian) -> str:
        """Take in an estimate of the force; why it was refused, or empty.

        One that is not finite, has no positive definite covariance or is not later than the last is refused.
        """
        if not (np.isfinite(estimate.mean).all() and _positive(estimate.cov)):
            return self._refuse("it is not a Gaussian")
        elapsed = (stamp_ns - self._stamp_ns) / SECOND_NS
        if self.belief is None or not -1.0 < elapsed <= self.settings.max_age:
            return self._start(stamp_ns, estimate)
        if elapsed <= 0.0:
            return self._refuse("it is not later than the last")
        prior = self.belief.cov + elapsed * self.settings.noise**2 * np.eye(3)
        innovation = estimate.mean - self.belief.mean
        gain = np.linalg.solve(prior + estimate.cov, prior).T
        self.nis = float(innovation @ np.linalg.solve(prior + estimate.cov, innovation))
        if self.nis > self._gate:
            self._refused_in_a_row += 1
            if self._refused_in_a_row > self.settings.reinitialize_after:
                return self._start(stamp_ns, estimate)
            return self._refuse(f"its NIS is {self.nis:.1f}, above {self._gate:.1f}")
        left = np.eye(3) - gain
        cov = left @ prior @ left.T + gain @ estimate.cov @ gain.T  # positive whatever is rounded
        self.belief = ForceGaussian(self.belief.mean + gain @ innovation, cov)
        self._stamp_ns, self._refused_in_a_row = stamp_ns, 0
        return ""

    def _start(self, stamp_ns: int, estimate: ForceGaussian) -> str:
        self.belief, self.nis = estimate, math.nan
        self._stamp_ns, self._refused_in_a_row = stamp_ns, 0
        return ""

    def _refuse(self, why: str) -> str:
        self.rejected += 1
        return why


def _positive(cov: Array) -> bool:
    """Whether a matrix is finite and positive definite."""
    try:
        return bool(np.isfinite(cov).all() and np.isfinite(np.linalg.cholesky(cov)).all())
    except np.linalg.LinAlgError:
        return False
