"""Several sensors on one object: their contact beliefs fused into one belief over the object's pose.

Each contact knows where the object is: T_wo = T_ws X_sf T_of^-1, from its sensor's pose in a common frame
{w}, its belief X_sf and the constant place {f} of its contact feature on the object {o}, known or estimated.
What it knows is not independent of what the others know (docs/filter.md). So each Gaussian keeps its
covariance in two parts, `independent` and `correlated`, and the fusion is the split covariance intersection
of Julier and Uhlmann: the correlated parts, whatever their correlation, are inflated by 1 / w and
1 / (1 - w), with w for the smallest determinant of the result. With nothing correlated it is plain fusion,
with nothing independent covariance intersection.

The object's belief has no memory: the contacts' filters have it. So nothing is counted twice over time, if
all contacts are predicted to one stamp (`ContactFilter.predict_to`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf

from tactile_filter.filter_settings import gate_threshold
from tactile_filter.fusion import FusionError, fuse
from tactile_filter.propagation import innovation
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

Array = NDArray[np.float64]

_SMALLEST_WEIGHT = 1e-6
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_SEARCH_STEPS = 40


@dataclass(frozen=True)
class SplitGaussian:
    """A Gaussian over poses whose left covariance is the sum of two parts.

    Attributes
    ----------
    mean : (4, 4) pose
    independent : (6, 6) of errors that no other Gaussian shares
    correlated : (6, 6) of errors that others may share, with a correlation that is not known
    """

    mean: Array
    independent: Array
    correlated: Array

    @property
    def cov(self) -> Array:
        """The whole covariance (6, 6)."""
        return self.independent + self.correlated

    def weighted(self, weight: float) -> Array:
        """Covariance (6, 6) with the correlated part inflated for an intersection."""
        return self.independent + self.correlated / weight

    @property
    def gaussian(self) -> PoseGaussian:
        """Mean and whole covariance."""
        return PoseGaussian(self.mean, self.cov)


@dataclass(frozen=True)
class Contact:
    """One sensor's contact with the object, all at one stamp.

    Attributes
    ----------
    belief : X_sf
    T_world_sensor : (4, 4)
    T_object_feature : where on the object the contact is. A known place has covariance zero.
    """

    belief: PoseGaussian
    T_world_sensor: Array
    T_object_feature: PoseGaussian


@dataclass(frozen=True)
class ObjectBelief:
    """The object's pose T_wo.

    Attributes
    ----------
    pose : None if there was no contact
    used : the contacts that went into it
    refused : contacts that disagreed, by name, with their NIS against the others
    """

    pose: SplitGaussian | None
    used: tuple[str, ...]
    refused: dict[str, float]


def fuse_contacts(known: Mapping[str, SplitGaussian], gate_probability: float = 1.0) -> ObjectBelief:
    """Fuse what each contact knows of the object's pose T_wo, the most certain first.

    Two contacts that disagree do not show which is right: the less certain one is refused, and named.

    Raises `FusionError` if a contact is no Gaussian.
    """
    gate = gate_threshold(gate_probability)
    order = sorted(known, key=lambda name: (_log_determinant(known[name].cov), name))
    pose: SplitGaussian | None = None
    used, refused = [], {}
    for name in order:
        if pose is None:
            pose = known[name]
        else:
            nis = _disagreement(pose, known[name])
            if not nis <= gate:
                refused[name] = nis
                continue
            pose = fuse_split(pose, known[name])
        used.append(name)
    return ObjectBelief(pose, tuple(used), refused)


def object_from_contact(
    contact: Contact, correlated_share: float = 0.0, place_share: float = 1.0
) -> SplitGaussian:
    """What one contact knows of the object's pose, T_wo = T_ws X_sf T_of^-1.

    Parameters
    ----------
    correlated_share, place_share : float
        Shares of the covariances of its belief and of the feature's place that count as correlated. A place
        that was found by other contacts is correlated with them; one that was measured may be independent.
    """
    T_ws = contact.T_world_sensor
    mean = T_ws @ contact.belief.mean @ se3.inverse(contact.T_object_feature.mean)
    mean = se3.orthonormalized(mean)
    own = moved_covariance(T_ws, contact.belief.cov)
    place = moved_covariance(mean, contact.T_object_feature.cov)
    independent = (1.0 - correlated_share) * own + (1.0 - place_share) * place
    return SplitGaussian(mean, independent, correlated_share * own + place_share * place)


def estimate_feature(pose: PoseGaussian, belief: PoseGaussian, T_world_sensor: Array) -> PoseGaussian:
    """Where on the object a contact is, T_of = T_wo^-1 T_ws X_sf, while the object's pose is known by others.

    Its errors are those of the object's pose then: from now on, what this contact says of the object is
    correlated with what was known of it already. `object_from_contact` takes it so.
    """
    T_ow = se3.inverse(pose.mean)
    mean = T_ow @ T_world_sensor @ belief.mean
    cov = moved_covariance(T_ow, pose.cov + moved_covariance(T_world_sensor, belief.cov))
    return PoseGaussian(se3.orthonormalized(mean), cov)


def fuse_split(a: SplitGaussian, b: SplitGaussian) -> SplitGaussian:
    """Split covariance intersection of two Gaussians over the same pose."""
    w = intersection_weight(a, b)
    cov_a, cov_b = a.weighted(w), b.weighted(1.0 - w)
    fused = fuse(a.mean, cov_a, b.mean, cov_b, "exact")
    gain_a, gain_b = fused.cov @ np.linalg.inv(cov_a), fused.cov @ np.linalg.inv(cov_b)
    independent = gain_a @ a.independent @ gain_a.T + gain_b @ b.independent @ gain_b.T
    independent = 0.5 * (independent + independent.T)
    return SplitGaussian(fused.mean, independent, fused.cov - independent)


def intersection_weight(a: SplitGaussian, b: SplitGaussian) -> float:
    """The weight in (0, 1) for which the fused covariance has the smallest determinant (golden section).

    The determinant, unlike the trace, does not depend on the units of length.
    """
    if not a.correlated.any():
        return _SMALLEST_WEIGHT if b.correlated.any() else 0.5  # without both it has no effect
    if not b.correlated.any():
        return 1.0 - _SMALLEST_WEIGHT

    def cost(weight: float) -> float:
        # |(A^-1 + B^-1)^-1| = |A| |B| / |A + B|
        cov_a, cov_b = a.weighted(weight), b.weighted(1.0 - weight)
        return _log_determinant(cov_a) + _log_determinant(cov_b) - _log_determinant(cov_a + cov_b)

    low, high = _SMALLEST_WEIGHT, 1.0 - _SMALLEST_WEIGHT
    inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
    costs = [cost(inner[0]), cost(inner[1])]
    for _ in range(_SEARCH_STEPS):
        if costs[0] <= costs[1]:
            high = inner[1]
            inner = [high - _GOLDEN * (high - low), inner[0]]
            costs = [cost(inner[0]), costs[0]]
        else:
            low = inner[0]
            inner = [inner[1], low + _GOLDEN * (high - low)]
            costs = [costs[1], cost(inner[1])]
    return 0.5 * (low + high)


def moved_covariance(T: Array, cov: Array) -> Array:
    """Left covariance (6, 6) of T X, given that of X."""
    adjoint = se3.adjoint(T)
    moved = adjoint @ cov @ adjoint.T
    return 0.5 * (moved + moved.T)


def _disagreement(a: SplitGaussian, b: SplitGaussian) -> float:
    """NIS of b against a, with covariances that hold whatever the correlation of the two.

    Not with the weight of the fusion: where that takes next to nothing of b, b would never disagree.
    """
    return innovation(b.mean, b.weighted(0.5), a.mean, a.weighted(0.5)).nis


def _log_determinant(cov: Array) -> float:
    factor, failed = dpotrf(cov, lower=1)
    if failed:
        raise FusionError(f"a contact's covariance is not positive definite: {cov.tolist()}")
    return 2.0 * sum(map(math.log, factor.ravel()[::7].tolist()))
