"""Does the filter's covariance mean what it claims? Statistics of its innovations, online.

If the model holds - the estimates' covariances, the process noise, the surface that stands still - the
whitened innovations are standard normal and independent from step to step. Over a window of N of them:

- the sum of NIS is chi-square with 6 N degrees of freedom: above it the filter is overconfident, below it
  underconfident;
- the correlations r_i of component i with itself one step later are normal with variance 1/N, so N sum r_i^2
  is chi-square with 6 degrees of freedom: above it, innovations drag on from step to step, as with a process
  noise that is too small for the motion there is, or estimates that err alike on successive images.

Outliers that the gate has refused are not part of the window; their share has a test of its own.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_filter.belief import Belief, BeliefFlag
from tactile_geometry import se3

Array = NDArray[np.float64]

DOF = 6
HARMFUL = ("overconfident", "many outliers")


@dataclass(frozen=True)
class ConsistencySettings(Settings):
    """How the consistency of the filter is judged."""

    window: int = setting(240, lower=10, upper=100_000, doc="innovations that are judged together")
    probability: float = setting(
        0.999, lower=0.5, upper=0.999999, doc="of a consistent filter's statistic to lie inside its bounds"
    )
    patience: float = setting(
        2.0, lower=0.0, upper=3600.0, unit="s", doc="a statistic has to be outside this long to be reported"
    )
    warn_of: str = setting(
        "harmful",
        choices=("harmful", "all"),
        doc="harmful: overconfidence and many outliers; all: underconfidence and correlation, too, which the "
        "paper's generous process noise and estimates that err alike on successive images bring about",
    )
    max_rejected: float = setting(
        0.05, lower=0.0, upper=1.0, doc="share of the window's measurements that the gate may refuse"
    )


@dataclass(frozen=True)
class Consistency:
    """What the last window says.

    Attributes
    ----------
    count : innovations in the window; the statistics are NaN until it is full
    nis : mean NIS over its degrees of freedom: 1 if consistent, larger if overconfident
    nis_bounds : (float, float)
    whiteness : N sum r_i^2 over its degrees of freedom: 1 if consistent
    whiteness_bound : float
    lag_one : (6,) correlation of each whitened component with itself one step later
    rejected : share of measurements that the gate refused
    problems : what is wrong, in words; empty if nothing is, or not for long enough
    warnings : those of the problems to warn of, by the setting `warn_of`
    """

    count: int
    nis: float
    nis_bounds: tuple[float, float]
    whiteness: float
    whiteness_bound: float
    lag_one: Array
    rejected: float
    problems: tuple[str, ...]
    warnings: tuple[str, ...]


class ConsistencyMonitor:
    """Takes each belief of the filter and judges the last `window` innovations."""

    def __init__(self, settings: ConsistencySettings | None = None) -> None:
        self._innovations: deque[Array] = deque()
        self._gated: deque[bool] = deque()
        self.configure(ConsistencySettings() if settings is None else settings)
        self.reset()

    def configure(self, settings: ConsistencySettings) -> None:
        """Take other settings; of the innovations seen, those that fit into the window stay."""
        self.settings = settings
        self._innovations = deque(self._innovations, maxlen=settings.window)
        self._gated = deque(self._gated, maxlen=settings.window)
        tail = 0.5 * (1.0 - settings.probability)
        dof = DOF * settings.window
        self.nis_bounds = (float(chdtri(dof, 1.0 - tail)) / dof, float(chdtri(dof, tail)) / dof)
        self.whiteness_bound = float(chdtri(DOF, 1.0 - settings.probability)) / DOF

    def reset(self) -> None:
        """Forget all innovations, as when the filter restarts."""
        self._innovations.clear()
        self._gated.clear()
        self._outside_since: dict[str, int] = {}
        self._stamp_ns = 0

    def add(self, belief: Belief) -> None:
        """Take the belief of one step; one without an innovation says nothing and is passed over."""
        if belief.flags & BeliefFlag.REINITIALIZED or belief.innovation is None:
            return
        self._stamp_ns = belief.stamp_ns
        gated = bool(belief.flags & BeliefFlag.GATED)
        self._gated.append(gated)
        if not gated and np.isfinite(belief.innovation).all():
            self._innovations.append(belief.innovation)

    def report(self) -> Consistency:
        """Judge the window; call it as often as the answer is looked at."""
        count, (low, high) = len(self._innovations), self.nis_bounds
        nis, whiteness, lag_one = float("nan"), float("nan"), np.full(DOF, np.nan)
        if count == self.settings.window:
            window = np.array(self._innovations)
            nis = float((window**2).sum()) / (DOF * count)
            lag_one = (window[1:] * window[:-1]).sum(axis=0) / (window**2).sum(axis=0)
            whiteness = count * float(lag_one @ lag_one) / DOF
        rejected = sum(self._gated) / len(self._gated) if self._gated else 0.0
        full = len(self._gated) == self.settings.window
        outside = {
            "overconfident": (nis > high, f"mean NIS / 6 is {nis:.2f}, above {high:.2f}"),
            "underconfident": (nis < low, f"mean NIS / 6 is {nis:.2f}, below {low:.2f}"),
            "innovations are correlated": (
                whiteness > self.whiteness_bound,
                f"statistic {whiteness:.2f}, above {self.whiteness_bound:.2f}",
            ),
            "many outliers": (
                full and rejected > self.settings.max_rejected,
                f"{rejected:.0%} of the measurements refused, more than {self.settings.max_rejected:.0%}",
            ),
        }
        problems = self._lasting(outside)
        warnings = problems
        if self.settings.warn_of == "harmful":
            warnings = tuple(text for text in problems if text.startswith(HARMFUL))
        return Consistency(
            count, nis, (low, high), whiteness, self.whiteness_bound, lag_one, rejected, problems, warnings
        )

    def _lasting(self, outside: dict[str, tuple[bool, str]]) -> tuple[str, ...]:
        """The texts of what has been outside for long enough."""
        problems = []
        for name, (is_outside, text) in outside.items():
            if not is_outside:
                self._outside_since.pop(name, None)
                continue
            since_ns = self._outside_since.setdefault(name, self._stamp_ns)
            if self._stamp_ns - since_ns >= self.settings.patience * SECOND_NS:
                problems.append(f"{name}: {text}")
        return tuple(problems)


def nees(truth: Array, mean: Array, cov: Array) -> float:
    """Normalized estimation error squared of a belief: chi-square with 6 degrees of freedom if it is true.

    Parameters
    ----------
    truth, mean : (4, 4)
    cov : (6, 6) left covariance
    """
    error = se3.log(truth @ se3.inverse(mean))
    return float(error @ np.linalg.solve(cov, error))
