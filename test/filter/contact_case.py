"""What the filter meets: an estimate's standard deviations, and a contact of 3 mm under a tilted sensor."""

import numpy as np

from tactile_geometry import se3

SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])  # m, rad
COV = np.diag(SIGMA**2)
CONTACT = se3.exp([1e-3, 0.0, -3e-3, 0.1, -0.05, 0.0])
