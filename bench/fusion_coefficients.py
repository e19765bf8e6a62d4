"""Writes coefficients.h: the power series of se3_exact.h, each coefficient as the sum of two doubles, and the
polynomials of fusion_lanes.h.

python bench/fusion_coefficients.py > tactile_filter/_csrc/coefficients.h
"""

from __future__ import annotations

from collections.abc import Callable

import mpmath as mp

COUNT = 26  # terms of a series; as many more in a table as derivatives of it are taken
REGULAR_VERSINE = 0.3  # of the largest angle of the polynomials, 1 - cos t


def split(value: mp.mpf) -> str:
    high = float(value)
    return f"{{{high!r}, {float(value - mp.mpf(high))!r}}}"


def array(name: str, text: str, values: list[mp.mpf]) -> str:
    rows = "".join(f"  {split(value)},\n" for value in values)
    return f"// {text}\nstatic const Dd {name}[{len(values)}] = {{\n{rows}}};\n"


def tail(power: int) -> mp.mpf:
    """Sum of 1 / (2 pi n)**power over n >= 3."""
    return (mp.zeta(power) - 1 - mp.mpf(2) ** -power) / (2 * mp.pi) ** power


def fit(name: str, text: str, function: Callable[[mp.mpf], mp.mpf], end: mp.mpf, degree: int) -> str:
    """Polynomial by Chebyshev interpolation on [0, end]; `function` of the square root of its argument."""
    values, error = mp.chebyfit(
        lambda x: function(mp.sqrt(max(x, mp.mpf(10) ** -30))), [0, end], degree + 1, error=True
    )
    assert error < 4e-16 * abs(function(mp.mpf(10) ** -15))
    rows = "".join(f"  {float(value)!r},\n" for value in reversed(values))
    return f"// {text}\nstatic const double {name}[{degree + 1}] = {{\n{rows}}};\n"


def fits() -> list[str]:
    """Polynomials in versines and squares of angles up to about 45 degrees."""
    versine = mp.mpf(REGULAR_VERSINE)
    square = mp.acos(1 - versine) ** 2

    def turn(root: mp.mpf) -> mp.mpf:
        angle = 2 * mp.asin(root / mp.sqrt(2))
        return angle / mp.sin(angle)

    def cot(t: mp.mpf) -> mp.mpf:
        return (1 - t / 2 * mp.cot(t / 2)) / t**2

    def d_cot(t: mp.mpf) -> mp.mpf:
        return (t / 2 * mp.cot(t / 2) - 2 + (t / 2 / mp.sin(t / 2)) ** 2) / t**4

    return [
        f"#define REGULAR_VERSINE {REGULAR_VERSINE}\n#define REGULAR_SQUARE {float(square)!r}\n",
        fit("FIT_TURN", "t/sin(t) in powers of 1 - cos t", turn, versine, 12),
        fit("FIT_SIN", "sin(t)/t in powers of t^2", lambda t: mp.sin(t) / t, square, 6),
        fit("FIT_COS", "(1 - cos t)/t^2", lambda t: (1 - mp.cos(t)) / t**2, square, 6),
        fit("FIT_CUBIC", "(t - sin t)/t^3", lambda t: (t - mp.sin(t)) / t**3, square, 6),
        fit("FIT_COT", "e = (1 - (t/2) cot(t/2))/t^2", cot, square, 6),
        fit("FIT_D_COT", "(de/dt)/t", d_cot, square, 6),
    ]


def main() -> None:
    """Print the header."""
    mp.mp.dps = 90
    blocks = [
        array(
            "SIN",
            "sin(t)/t in powers of t^2",
            [(-1) ** k / mp.factorial(2 * k + 1) for k in range(COUNT + 2)],
        ),
        array("COS", "(1 - cos t)/t^2", [(-1) ** k / mp.factorial(2 * k + 2) for k in range(COUNT + 1)]),
        array(
            "COT",
            "what the poles from n = 3 on add to (1 - (t/2) cot(t/2))/t^2",
            [2 * tail(2 * k + 2) for k in range(COUNT + 1)],
        ),
        array("FIRST_POLE", "4 pi^2, 16 pi^2", [4 * mp.pi**2, 16 * mp.pi**2]),
    ]
    print("// Written by bench/fusion_coefficients.py. Series in powers of t^2, each a sum of two doubles.")
    print('#ifndef TACTILE_COEFFICIENTS_H_\n#define TACTILE_COEFFICIENTS_H_\n\n#include "dd.h"\n')
    print("\n".join(blocks).replace("FIRST_POLE", "POLES"))
    print("\n".join(fits()))
    print("#endif  // TACTILE_COEFFICIENTS_H_")


if __name__ == "__main__":
    main()
