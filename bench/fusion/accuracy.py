"""The worst errors of exp, log and the Jacobians against 60 digits, as test/filter holds them.

    python bench/fusion/accuracy.py [--count 3] [--reference]

Needs mpmath (`pip install 'mpmath>=1.3,<1.4'`, or `scripts/setup.sh test`).
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.extend(
    str(Path(__file__).resolve().parents[2] / name) for name in ("bench", "test/filter", "test/geometry")
)

from shared import Table, needs, parser

from tactile_geometry import se3


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--count", type=int, default=3, help="tangent vectors an angle")
    arguments.add_argument("--reference", action="store_true", help="of the NumPy reference instead of C")
    given = arguments.parse_args()
    needs("pip install 'mpmath>=1.3,<1.4', or scripts/setup.sh test", "mpmath")
    import se3_reference
    from worst_errors import TOLERANCES, worst_errors

    table = Table(("error", "worst", "at angle", "must hold"), f"largest of {given.count} vectors an angle")
    found = worst_errors(se3_reference if given.reference else se3, given.count)
    for name, (error, angle) in found.items():
        table.row(name, f"{error:.2e}", f"{angle:.4g}", f"{TOLERANCES[name]:.0e}")


if __name__ == "__main__":
    main()
