"""SE(3), Gaussians over poses, their numbers in messages, and stamped transforms."""

try:
    from tactile_geometry import _se3 as _se3
except ImportError as error:
    raise ImportError(
        "the C extension tactile_geometry._se3 is not built for this Python: run `make build`, or "
        "`python setup.py build_ext --inplace` in a source tree"
    ) from error
