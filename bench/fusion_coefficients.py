"""Writes coefficients.h: the power series of se3_exact.h, each coefficient as the sum of two doubles.

python bench/fusion_coefficients.py > tactile_filter/_csrc/coefficients.h
"""

from __future__ import annotations

import mpmath as mp

COUNT = 26


def split(value: mp.mpf) -> str:
    high = float(value)
    return f"{{{high!r}, {float(value - mp.mpf(high))!r}}}"


def array(name: str, text: str, values: list[mp.mpf]) -> str:
    rows = "".join(f"  {split(value)},\n" for value in values)
    return f"// {text}\nstatic const Dd {name}[{len(values)}] = {{\n{rows}}};\n"


def tail(power: int) -> mp.mpf:
    """Sum of 1 / (2 pi n)**power over n >= 3."""
    return (mp.zeta(power) - 1 - mp.mpf(2) ** -power) / (2 * mp.pi) ** power


def main() -> None:
    """Print the header."""
    mp.mp.dps = 60
    n = range(COUNT)
    sign = [mp.mpf(-1) ** k for k in n]
    blocks = [
        array("SIN", "sin(t)/t in powers of t^2", [sign[k] / mp.factorial(2 * k + 1) for k in n]),
        array("COS", "(1 - cos t)/t^2", [sign[k] / mp.factorial(2 * k + 2) for k in n]),
        array("CUBIC", "(t - sin t)/t^3", [sign[k] / mp.factorial(2 * k + 3) for k in n]),
        array(
            "D_COS",
            "d/dt of (1 - cos t)/t^2, over t",
            [-sign[k] * 2 * (k + 1) / mp.factorial(2 * k + 4) for k in n],
        ),
        array(
            "D_CUBIC",
            "d/dt of (t - sin t)/t^3, over t",
            [-sign[k] * 2 * (k + 1) / mp.factorial(2 * k + 5) for k in n],
        ),
        array(
            "COT",
            "what the poles from n = 3 on add to (1 - (t/2) cot(t/2))/t^2",
            [2 * tail(2 * k + 2) for k in n],
        ),
        array("D_COT", "twice the derivative of that by t^2", [4 * (k + 1) * tail(2 * k + 4) for k in n]),
        array("FIRST_POLE", "4 pi^2, 16 pi^2", [4 * mp.pi**2, 16 * mp.pi**2]),
    ]
    print("// Written by bench/fusion_coefficients.py. Series in powers of t^2, each a sum of two doubles.")
    print('#ifndef TACTILE_COEFFICIENTS_H_\n#define TACTILE_COEFFICIENTS_H_\n\n#include "dd.h"\n')
    print("\n".join(blocks).replace("FIRST_POLE", "POLES"))
    print("#endif  // TACTILE_COEFFICIENTS_H_")


if __name__ == "__main__":
    main()
