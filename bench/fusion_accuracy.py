"""The worst errors of exp, log, the Jacobians and mode exact against 60 digits, as test/filter holds them.

python bench/fusion_accuracy.py [--count 3] [--reference]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "test" / "filter"))

import se3_reference

from tactile_filter.fusion import fuse
from tactile_geometry import se3


def print_fusions() -> None:
    """Errors of mode exact at the extremes, beside what rounding the inputs alone costs."""
    from fusion_cases import cases, exact_error, tolerance

    print(f"\n{'mode exact, case':24}{'error':>10}{'rounding':>10}{'allowed':>10}  in standard deviations")
    for name, pair in cases(0).items():
        error, cost, _, _ = exact_error(pair, fuse(*pair, "exact"))
        print(f"{name:24}{error:10.1e}{cost:10.1e}{tolerance(cost):10.1e}")


def main() -> None:
    """Measure and print."""
    from worst_errors import table, worst_errors

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3, help="tangent vectors an angle")
    parser.add_argument("--reference", action="store_true", help="of the NumPy reference instead of C")
    options = parser.parse_args()
    print(table(worst_errors(se3_reference if options.reference else se3, options.count)))
    print_fusions()


if __name__ == "__main__":
    main()
