import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

def vector(value: ArrayLike, largest: float, /) -> Array | None: ...
def pid_law(state: Array, gains: Array, /) -> Array: ...
def pid_step(
    state: Array,
    gains: Array,
    error: Array,
    dt: float,
    gap: bool,
    integrate: bool,
    decay: float,
    transfer_time: float,
    /,
) -> Array: ...
def limit_twist(
    last: Array,
    wanted: Array,
    linear_speed: float,
    linear_change: float,
    angular_speed: float,
    angular_change: float,
    /,
) -> tuple[Array, int]: ...
