"""A sensor without skin or image that errs as a network on simulated images does (see `network_error`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_scene.shapes.surface import Surface
from tactile_scene.simulated_sensors import FittedSensorSettings
from tactile_sim.ideal_sensor import IdealSensor
from tactile_sim.network_error import NetworkError, load_error_model

Array = NDArray[np.float64]

PLAIN_ERROR, PLAIN_WAY = 0.3e-3, 3e-3  # m: RMS error of a plain depth, the way on which it changes


class FittedSensor(IdealSensor):
    """The contact of the ideal sensor, seen as the shipped network would see it."""

    def __init__(self, settings: FittedSensorSettings | None = None, seed: int = 0) -> None:
        self._model = load_error_model()
        super().__init__(settings or FittedSensorSettings(), seed)

    def reset(self, seed: int | None = None) -> None:
        """Forget the contact, and start all noise again (with a new seed if given)."""
        super().reset(seed)
        self._errors = NetworkError(self._model, int(self._random.integers(2**63)))
        self._plain_random = np.random.default_rng([self._seed, 1])
        self._plain_error = 0.0
        self._present = False

    def advance(self, surface: Surface, T_surface_sensor: Array) -> None:
        """Move to a pose (4, 4) of {s} in the surface's frame."""
        before = self._T[:3, 3].copy()
        super().advance(surface, T_surface_sensor)
        kept = np.exp(-np.linalg.norm(self._T[:3, 3] - before) / PLAIN_WAY)
        fresh = PLAIN_ERROR * self._plain_random.standard_normal()
        self._plain_error = kept * self._plain_error + np.sqrt(1.0 - kept * kept) * fresh
        self._present = self._present and self.truth().depth >= self._model.leave

    def plain_depth(self) -> float:
        """See `IdealSensor`; it errs by as much as on images, and the longer the way the more anew."""
        return self.geometry.depth + self._plain_error

    def estimate(self) -> PoseGaussian | None:
        """What the network would say, with the noise of the settings on top; None where it sees no contact.

        Contact presence begins and ends at the depths at which the change of the images shows it.
        """
        truth = self.truth()
        if not self._present:
            if truth.depth < self._model.touch:
                return None
            self._present = True
            self._errors.begin()
        seen = self._errors.estimate(truth.T_fs, truth.slip_fraction > 0.5)
        if not self._sigma.any():
            return seen
        noise = self._sigma * self._random.standard_normal(6)
        return PoseGaussian(se3.exp(noise) @ seen.mean, seen.cov + np.diag(self._sigma**2))
