from collections.abc import Callable
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_filter.fusion import FusionResult

Array = NDArray[np.float64]

def contact_fault(X_sf: ArrayLike, limits: ArrayLike, /) -> tuple[int, float] | None: ...
def sigma_fault(cov: ArrayLike, limits: ArrayLike, /) -> int | None: ...
def predict(
    mean: ArrayLike, cov: ArrayLike, T_before: ArrayLike, T_now: ArrayLike, variances: ArrayLike, /
) -> tuple[Array, Array]: ...
def innovation(
    mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike, /
) -> tuple[float, Array]: ...
def fuse(
    mean_1: ArrayLike, cov_1: ArrayLike, mean_2: ArrayLike, cov_2: ArrayLike, plan: str | tuple[int, int], /
) -> FusionResult: ...
def check(mean: ArrayLike, cov: ArrayLike, /) -> int: ...
def set_up(
    result: type,
    statuses: tuple,
    plans: dict[str, tuple[int, int]],
    refuse: Callable[[int, tuple[ArrayLike, ...]], NoReturn],
    /,
) -> None: ...
def instruction_set(name: str = ..., /) -> str: ...
