"""Fusion of Gaussians over poses, and the Bayesian filter over surface contact poses."""

try:
    from tactile_filter import _fusion as _fusion
except ImportError as error:
    raise ImportError(
        "the C extension tactile_filter._fusion is not built for this Python: run `make build`, or "
        "`python setup.py build_ext --inplace` in a source tree"
    ) from error
