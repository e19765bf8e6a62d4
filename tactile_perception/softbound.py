"""Softbound: a smooth, strictly held bound on a number, used on the network's inverse standard deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def softbound(x: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """Smooth approximation of clamp(x, lower, upper) that never leaves [lower, upper].

    The paper's softbound, lower + softplus(x - lower) - softplus(x - upper), rearranged as
    clamp(x) + (log1p(exp(-|x - lower|)) - log1p(exp(-|x - upper|))). The paper's own rearrangement (appendix
    "A numerically stable implementation of the softbound function") subtracts x from a sum of its size and
    so loses its bounds for large |x|; here nothing larger than the bounds is ever formed.

    Raises `ValueError` if a bound is not finite or lower > upper.

    Parameters
    ----------
    x : array_like
        Any value; +-inf gives the bound, NaN gives NaN.
    lower, upper : array_like
        Finite, lower <= upper; broadcast against `x`.

    Returns
    -------
    ndarray, float64, of the broadcast shape.
    """
    x, lower, upper = (np.asarray(value, dtype=np.float64) for value in (x, lower, upper))
    if not (np.all(np.isfinite(lower)) and np.all(np.isfinite(upper)) and np.all(lower <= upper)):
        raise ValueError(f"softbound: bounds must be finite with lower <= upper, are {lower} and {upper}")
    with np.errstate(over="ignore", under="ignore"):
        above_lower = np.log1p(np.exp(-np.abs(x - lower)))
        above_upper = np.log1p(np.exp(-np.abs(x - upper)))
    smooth = np.clip(x, lower, upper) + (above_lower - above_upper)
    # The last clip is for bounds closer together than the rounding error of the two logarithms.
    return np.clip(smooth, lower, upper)
