import numpy as np
from numpy.typing import NDArray

def median5(res: NDArray[np.uint8], image: NDArray[np.uint8], /) -> None: ...
def threshold_mean(
    res: NDArray[np.uint8],
    image: NDArray[np.uint8],
    block: int,
    offset: int,
    mask: NDArray[np.uint8],
    /,
) -> None: ...
def shrink(res: NDArray[np.uint8], image: NDArray[np.uint8], /) -> None: ...
def largest_change(
    image: NDArray[np.float32],
    reference: NDArray[np.float32],
    noise: NDArray[np.float32],
    window: int,
    /,
) -> float: ...
