import numpy as np
from numpy.typing import NDArray

def solve(
    force: NDArray[np.float64],
    state: NDArray[np.uint8],
    residual: NDArray[np.float32],
    normal: NDArray[np.float64],
    compliance: NDArray[np.float32],
    active: NDArray[np.int32],
    friction: float,
    max_sweeps: int,
    tolerance: float,
) -> int: ...
def displacement(
    out: NDArray[np.float32],
    force: NDArray[np.float64],
    compliance: NDArray[np.float32],
    active: NDArray[np.int32],
) -> None: ...
def render(
    image: NDArray[np.uint8],
    background: NDArray[np.float32],
    blobs: NDArray[np.float64],
    softness: float,
    noise: NDArray[np.float32] | None,
    seed: int,
    canvas: NDArray[np.float32],
) -> None: ...
def draw_input(
    input: NDArray[np.uint8],
    discs: NDArray[np.float64],
    ground: NDArray[np.float32],
    mask: NDArray[np.float32],
    view: tuple[float, ...],
) -> None: ...
