"""Softbound against mpmath and at the extremes."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")

from tactile_perception.training import heads  # noqa: E402

LOWER, UPPER = 1e-6, 1e6
FINITE = st.floats(allow_nan=False, allow_infinity=False)


def softbound(x: float, lower: float, upper: float) -> float:
    return heads.softbound(torch.tensor(x, dtype=torch.float64), lower, upper).item()


def exact(x: float, lower: float, upper: float) -> float:
    """The value of lower + softplus(x - lower) - softplus(x - upper), to a thousand digits."""
    with mpmath.workdps(1000):
        x, lower, upper = mpmath.mpf(x), mpmath.mpf(lower), mpmath.mpf(upper)
        return float(lower + mpmath.log1p(mpmath.exp(x - lower)) - mpmath.log1p(mpmath.exp(x - upper)))


@pytest.mark.parametrize(
    "x", [-500.0, -40.0, -1.0, -1e-9, 0.0, 1e-6, 0.3, 1.0, 17.0, 800.0, 5e5, 1e6 - 1, 1e6, 1e6 + 30]
)
def test_equals_the_exact_function(x):
    assert softbound(x, LOWER, UPPER) == pytest.approx(exact(x, LOWER, UPPER), rel=1e-13, abs=0.0)


def test_equals_the_exact_function_for_narrow_bounds():
    for x in np.linspace(-6.0, 6.0, 41):
        assert softbound(x, -1.0, 2.0) == pytest.approx(exact(x, -1.0, 2.0), rel=0.0, abs=1e-13)


@pytest.mark.parametrize("x, bound", [(-np.inf, LOWER), (np.inf, UPPER), (-1e308, LOWER), (1e308, UPPER)])
def test_reaches_and_holds_its_bounds_at_the_extremes(x, bound):
    assert softbound(x, LOWER, UPPER) == bound


def test_nan_passes_as_nan():
    assert np.isnan(softbound(np.nan, LOWER, UPPER))


@given(x=st.floats(allow_nan=False), a=FINITE, b=FINITE)
def test_never_leaves_its_bounds(x, a, b):
    lower, upper = min(a, b), max(a, b)
    assert lower <= softbound(x, lower, upper) <= upper


@given(x=FINITE, step=st.floats(0.0, 1e3))
def test_never_falls_as_x_rises(x, step):
    # by no more than roundings of exp and log1p, which need not be monotonic in the last digit
    assert softbound(x + step, LOWER, UPPER) >= (1.0 - 1e-13) * softbound(x, LOWER, UPPER)
