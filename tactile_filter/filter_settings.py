"""Everything about the filter that can be tuned."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tactile_filter.settings import SettingError, Settings, setting


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
        5e-4, lower=0.0, upper=1.0, unit="m", doc="standard deviation that a step adds to each translation"
    )
    process_noise_rotation: float = setting(
        math.radians(0.5), lower=0.0, upper=math.pi, unit="rad",
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
        upper=10000,
        doc="after this many measurements refused in a row the next starts a new belief",
    )
    max_prediction_age: float = setting(
        0.5, lower=0.001, upper=3600.0, unit="s",
        doc="a belief that was not corrected for longer is given up: nothing is predicted from it",
    )  # fmt: skip
    backward_jump: float = setting(
        1.0, lower=0.0, upper=3600.0, unit="s",
        doc="a measurement older than the last by more than this resets the filter; one older by "
        "less is late: see history",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fusion_mode == "exact" and self.jacobian_order not in ("mode", "exact"):
            raise SettingError(
                f"jacobian_order = '{self.jacobian_order}': fusion_mode 'exact' needs 'exact' or 'mode'"
            )
