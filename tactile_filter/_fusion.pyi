from numpy.typing import ArrayLike

def fuse(
    mean_1: ArrayLike,
    cov_1: ArrayLike,
    mean_2: ArrayLike,
    cov_2: ArrayLike,
    iterations: int,
    order: int,
    /,
) -> tuple | int: ...
def check(mean: ArrayLike, cov: ArrayLike, /) -> int: ...
