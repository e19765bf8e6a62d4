"""The C extension, with a message that helps where it has not been built."""

from __future__ import annotations

try:
    from tactile_filter import _fusion
except ImportError as error:
    raise ImportError(
        "the C extension tactile_filter._fusion is not built for this Python: run `make build`, or "
        "`python setup.py build_ext --inplace` in a source tree"
    ) from error

__all__ = ["_fusion"]
