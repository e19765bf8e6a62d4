"""Prediction and innovation as the algorithm writes them, in plain NumPy: slow, and to be read."""

import numpy as np
import se3_reference

from tactile_geometry import se3


def predict(mean, cov, T_before, T_now, variances):
    T_k = np.linalg.inv(T_now) @ T_before
    adjoint = se3_reference.adjoint(T_k)
    moved = adjoint @ cov @ adjoint.T
    return se3.orthonormalized(T_k @ mean), 0.5 * (moved + moved.T) + np.diag(variances)


def innovation_squared(mean_obs, cov_obs, mean_bel, cov_bel):
    """nu^T S^-1 nu with the covariance of nu from the inverse Jacobians on both sides."""
    nu = se3_reference.log(mean_obs @ np.linalg.inv(mean_bel))
    left, right = (se3_reference.inverse_left_jacobian(v) for v in (nu, -nu))
    S = left @ cov_obs @ left.T + right @ cov_bel @ right.T
    return float(nu @ np.linalg.solve(S, nu))
