"""Everything about the filter that can be tuned, and the files that hold it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import config_path, named_file
from tactile_base.settings import SettingError, Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_base.yaml_file import read_yaml


@dataclass(frozen=True)
class FilterSettings(Settings):
    """Everything about the filter that can be tuned; the defaults are the paper's except for the gate."""

    fusion_mode: str = setting(
        "paper",
        choices=("paper", "fast", "exact"),
        doc="paper: as published; fast: 3 iterations with the exact Jacobian; exact: to convergence",
    )
    iterations: int = setting(
        0, lower=0, upper=1000, doc="iterations of the fusion (mode exact: at most); 0 takes the mode's own"
    )
    jacobian_order: str = setting(
        "mode",
        choices=("mode", "2", "4", "exact"),
        doc="order of the inverse Jacobian; 'mode' takes the mode's",
    )
    process_noise_translation: float = setting(
        5e-4, lower=0.0, upper=0.05, unit="m", doc="standard deviation that a step adds to each translation"
    )
    process_noise_rotation: float = setting(
        math.radians(0.5), lower=0.0, upper=1.0, unit="rad",
        doc="standard deviation that a step adds to each rotation",
    )  # fmt: skip
    process_noise_interval: float = setting(
        0.0, lower=0.0, upper=10.0, unit="s",
        doc="0: the noise is that of a step, however long (as in the paper); "
        "else: that of this much time, and its variance grows in proportion to the time elapsed",
    )  # fmt: skip
    gate_probability: float = setting(
        0.999999, lower=0.5, upper=1.0,
        doc="a measurement is refused if its NIS exceeds this quantile of chi-square with 6 degrees of "
        "freedom; 1 refuses none (as in the paper)",
    )  # fmt: skip
    reinitialize_after: int = setting(
        5,
        lower=1,
        upper=1000,
        doc="after this many measurements refused in a row the next starts a new belief",
    )
    robust: str = setting(
        "none",
        choices=("none", "student_t", "huber"),
        doc="inflate the covariance of estimates that are unlikely: student_t for errors with heavy tails, "
        "huber for errors that are normal but for outliers; none as in the paper",
    )
    student_t_dof: float = setting(
        6.0, lower=2.1, upper=1e6, doc="robust student_t: degrees of freedom of the estimate's errors"
    )
    huber_threshold: float = setting(
        3.55, lower=0.1, upper=100.0,
        doc="robust huber: Mahalanobis distance (6 dimensions) from which on an estimate counts as unlikely",
    )  # fmt: skip
    max_prediction_age: float = setting(
        0.5, lower=0.001, upper=60.0, unit="s",
        doc="a belief that was not corrected for longer is given up: nothing is predicted from it",
    )  # fmt: skip
    backward_jump: float = setting(
        1.0, lower=0.0, upper=3600.0, unit="s",
        doc="a measurement older than the last by more than this resets the filter; one older by "
        "less is late: see history",
    )  # fmt: skip
    history: float = setting(
        0.0, lower=0.0, upper=10.0, unit="s",
        doc="a measurement that comes late, by no more than this, is put in its place and all since is "
        "filtered anew; 0 refuses whatever comes late",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fusion_mode == "exact" and self.jacobian_order not in ("mode", "exact"):
            raise SettingError(
                f"jacobian_order = '{self.jacobian_order}': fusion_mode 'exact' needs 'exact' or 'mode'"
            )
        if self.history > self.backward_jump:
            raise SettingError(
                f"history = {self.history:g} s: must not be longer than backward_jump "
                f"= {self.backward_jump:g} s"
            )


def load_filter_settings(profile: str | Path = "") -> FilterSettings:
    """Settings from a file.

    Parameters
    ----------
    profile : str or Path
        Name of one of `config/filters`, or path of a .yaml file; empty: `config/filter.yaml`.

    Raises
    ------
    SettingError
        With file, line and valid choices.
    FileNotFoundError
        With the names of `config/filters`, if there is no such profile.
    OSError
        Where the file cannot be read.
    """
    section = read_yaml(named_file("filter", profile) if str(profile) else config_path("filter.yaml"))
    return section.checked(FilterSettings, section.values)


class Tuning(NamedTuple):
    """What a step needs of the settings, worked out once."""

    settings: FilterSettings
    gate: float
    variances: NDArray[np.float64]  # (6,) of the process noise
    noise_interval_ns: float
    max_age_ns: float
    backward_jump_ns: float
    iterations: int | None
    jacobian_order: int | str | None

    @classmethod
    def of(cls, settings: FilterSettings) -> Tuning:
        """The settings as a step takes them."""
        sigma = np.repeat((settings.process_noise_translation, settings.process_noise_rotation), 3)
        orders: dict[str, int | str | None] = {"mode": None, "2": 2, "4": 4, "exact": "exact"}
        return cls(
            settings=settings,
            gate=gate_threshold(settings.gate_probability),
            variances=sigma**2,
            noise_interval_ns=settings.process_noise_interval * SECOND_NS,
            max_age_ns=settings.max_prediction_age * SECOND_NS,
            backward_jump_ns=settings.backward_jump * SECOND_NS,
            iterations=settings.iterations or None,
            jacobian_order=orders[settings.jacobian_order],
        )

    def noise_since(self, elapsed_ns: int) -> NDArray[np.float64]:
        """Variances (6,) that the process noise adds in this time."""
        if self.noise_interval_ns > 0.0:
            return self.variances * (elapsed_ns / self.noise_interval_ns)
        return self.variances if elapsed_ns > 0 else np.zeros(6)


def gate_threshold(probability: float, dof: int = 6) -> float:
    """Quantile of chi-square; infinite at probability 1."""
    if probability >= 1.0:
        return math.inf
    # Here, since it takes a third of the start of every node that reads a filter's settings but has no gate.
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * dof, probability))
