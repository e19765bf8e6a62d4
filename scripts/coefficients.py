"""Writes coefficients.h: the series of se3_exact.h, each coefficient as the sum of two doubles, and the
polynomials of fusion_lanes.h.

    python scripts/coefficients.py > tactile_geometry/_csrc/coefficients.h
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable

import mpmath as mp

COUNT = 26  # terms of a series; as many more in a table as derivatives of it are taken
REGULAR_VERSINE = 0.3  # of the largest angle of the polynomials, 1 - cos t


def split(value: mp.mpf) -> str:
    high = float(value)
    return f"{{{high!r},\xa0{float(value - mp.mpf(high))!r}}}"


def array(kind: str, name: str, text: str, values: list[str]) -> str:
    wrapped = textwrap.TextWrapper(100, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
    rows = wrapped.fill(", ".join(values)).replace("\xa0", " ")
    return f"// {text}\nstatic const {kind} {name}[{len(values)}] = {{\n{rows}\n}};\n"


def series(name: str, text: str, values: list[mp.mpf]) -> str:
    return array("Dd", name, text, [split(value) for value in values])


def tail(power: int) -> mp.mpf:
    """Sum of 1 / (2 pi n)**power over n >= 3."""
    return (mp.zeta(power) - 1 - mp.mpf(2) ** -power) / (2 * mp.pi) ** power


def fit(name: str, text: str, function: Callable[[mp.mpf], mp.mpf], end: mp.mpf, degree: int) -> str:
    """Polynomial by Chebyshev interpolation on [0, end]; `function` of the square root of its argument."""
    values, error = mp.chebyfit(
        lambda x: function(mp.sqrt(max(x, mp.mpf(10) ** -30))), [0, end], degree + 1, error=True
    )
    assert error < 4e-16 * abs(function(mp.mpf(10) ** -15))
    return array("double", name, text, [repr(float(value)) for value in reversed(values)])


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
        series(
            "SIN",
            "sin(t)/t in powers of t^2",
            [(-1) ** k / mp.factorial(2 * k + 1) for k in range(COUNT + 2)],
        ),
        series("COS", "(1 - cos t)/t^2", [(-1) ** k / mp.factorial(2 * k + 2) for k in range(COUNT + 1)]),
        series(
            "COT",
            "what the poles from n = 3 on add to (1 - (t/2) cot(t/2))/t^2",
            [2 * tail(2 * k + 2) for k in range(COUNT + 1)],
        ),
        series("FIRST_POLE", "4 pi^2, 16 pi^2", [4 * mp.pi**2, 16 * mp.pi**2]),
    ]
    print("// Written by scripts/coefficients.py. Series in powers of t^2, each a sum of two doubles.")
    print('#ifndef TACTILE_COEFFICIENTS_H_\n#define TACTILE_COEFFICIENTS_H_\n\n#include "dd.h"\n')
    print("\n".join(blocks).replace("FIRST_POLE", "POLES"))
    print("\n".join(fits()))
    print("#endif  // TACTILE_COEFFICIENTS_H_")


if __name__ == "__main__":
    main()
