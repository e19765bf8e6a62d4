"""What a network says of a contact: quantities by name, which of them labels have fixed, and how they read.

A contact model has the six components of the contact pose, the Euler surface contact pose of X_fs, and
perhaps forces. Another package adds one by an entry point of the group `tactile_servoing.contact_models`.

Where all six are labelled and none goes all round, a network learns them as xi_sf, in which each mixes
several. Otherwise it learns them one by one. What no label fixes it cannot know: that has its prior, the
uniform distribution over its bounds, as mean and standard deviation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.contract import Contract
from tactile_base.registry import Registry
from tactile_base.settings import SettingError
from tactile_filter.force import ForceGaussian
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.labels import (
    COMPONENTS,
    EULER_COMPONENTS,
    EULER_UNITS,
    NETWORK_SCALE,
    NETWORK_UNITS,
    covariance_root,
    depths,
    euler_from_label,
    labels_from_euler,
    pose_gaussian,
    tangent_gaussian,
)

Array = NDArray[np.float64]

FORCES = ("Fx", "Fy", "Fz")
POSE = len(EULER_COMPONENTS)
#: From the network's units of an Euler component, mm and rad, to those of tables, mm and degrees.
_TABLE_SCALE = np.array([1.0] * 3 + [np.degrees(1.0)] * 3)


@dataclass(frozen=True)
class Quantity:
    """One thing that a network says: its name, its unit (mm, deg, N), and between which bounds it lies."""

    name: str
    unit: str
    low: float
    high: float

    @property
    def turns(self) -> bool:
        """Whether it is an angle that goes all round, so that its ends are the same."""
        return self.unit == "deg" and self.high - self.low >= 360.0


@dataclass(frozen=True)
class ContactModel:
    """The quantities of a network and, in a model file, those of them that labels have fixed.

    Attributes
    ----------
    quantities : x, y, z, alpha, beta, gamma, and those of Fx, Fy, Fz (N) that it tells, in this order
    required : what a data set must label to be one for it
    labelled : what is labelled; of all others only the prior is known
    """

    name: str
    quantities: tuple[Quantity, ...]
    required: tuple[str, ...] = ("z",)
    labelled: tuple[str, ...] = dataclasses.field(default=())

    def __post_init__(self) -> None:
        if not self.labelled:
            object.__setattr__(self, "labelled", self.quantity_names)

    def objections(self) -> Iterator[str]:
        """What is wrong with it."""
        names = self.quantity_names
        if names[:POSE] != EULER_COMPONENTS or names[POSE:] != tuple(f for f in FORCES if f in names):
            right = ", ".join(EULER_COMPONENTS)
            yield f"quantities are {', '.join(names)}: must be {right}, then of {FORCES}"
            return
        for quantity, unit in zip(self.quantities, (*EULER_UNITS, *"N" * len(self.forces)), strict=True):
            if quantity.unit != unit or not quantity.low < quantity.high:
                yield f"{quantity}: must be in {unit}, with low < high"
        for name in sorted({*self.required, *self.labelled} - set(names)):
            yield f"{name}: is required or labelled, but none of {', '.join(names)}"
        if "z" not in self.labelled:
            yield "z is not labelled: depth is what all else rests on"

    @property
    def quantity_names(self) -> tuple[str, ...]:
        """Names of the quantities, as in tables of labels."""
        return tuple(quantity.name for quantity in self.quantities)

    @property
    def forces(self) -> tuple[str, ...]:
        """Those of Fx, Fy, Fz that it tells."""
        return self.quantity_names[POSE:]

    @property
    def size(self) -> int:
        """Number of quantities, K."""
        return len(self.quantities)

    @cached_property
    def tangent(self) -> bool:
        """Whether the pose is learned as xi_sf."""
        return set(EULER_COMPONENTS) <= set(self.labelled) and not self.turning

    @property
    def turning(self) -> tuple[int, ...]:
        """Places of the angles that go all round."""
        return tuple(k for k, quantity in enumerate(self.quantities) if quantity.turns)

    @property
    def directed(self) -> bool:
        """Whether gamma goes all round: {f} has a direction on the surface, as along an edge."""
        return POSE - 1 in self.turning

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Which quantities (K,) are labelled."""
        return np.array([name in self.labelled for name in self.quantity_names])

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of those that no label fixes."""
        return tuple(name for name in self.quantity_names if name not in self.labelled)

    def says_unknown(self) -> str:
        """What no label has fixed, for people; empty if all is."""
        if not self.unknown:
            return ""
        bounds = {
            quantity.name: f"{quantity.low:g} to {quantity.high:g} {quantity.unit}"
            for quantity in self.quantities
        }
        listed = ", ".join(f"{name} ({bounds[name]})" for name in self.unknown)
        return f"not labelled, so that only bounds are known: {listed}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the network's outputs (K,)."""
        return (*(COMPONENTS if self.tangent else EULER_COMPONENTS), *self.forces)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the network's outputs: mm, rad, N."""
        return (*NETWORK_UNITS, *"N" * len(self.forces))

    @property
    def titles(self) -> tuple[str, ...]:
        """Name and unit of each output, for tables and plots."""
        return tuple(f"{name} ({unit})" for name, unit in zip(self.names, self.units, strict=True))

    @property
    def columns(self) -> tuple[str, ...]:
        """The same for columns of files."""
        return tuple(f"{name}_{unit}" for name, unit in zip(self.names, self.units, strict=True))

    @cached_property
    def prior(self) -> tuple[Array, Array]:
        """Mean and standard deviation (K,) in mm, rad and N of the uniform distributions over the bounds."""
        scale = np.where([quantity.unit == "deg" for quantity in self.quantities], np.radians(1.0), 1.0)
        low, high = (np.array([getattr(q, end) for q in self.quantities]) * scale for end in ("low", "high"))
        return 0.5 * (low + high), (high - low) / np.sqrt(12.0)

    def narrowed(self, labelled: Iterable[str], where: object) -> ContactModel:
        """The model for data with these labels; `SettingError` if they lack what it requires."""
        found = tuple(name for name in self.quantity_names if name in set(labelled))
        if missing := [name for name in self.required if name not in found]:
            raise SettingError(
                f"{where}: the contact model '{self.name}' needs {', '.join(missing)}, which is not "
                f"labelled; labelled: {', '.join(found)}"
            )
        if self.forces and not set(self.forces) & set(found):
            raise SettingError(
                f"{where}: the contact model '{self.name}' tells forces, and none of "
                f"{', '.join(self.forces)} is labelled: take another model (--model), or name their columns "
                "(`tactile data import`)"
            )
        return dataclasses.replace(self, labelled=found)

    def labels(self, euler_mm_deg: ArrayLike, force: ArrayLike, labelled: Sequence[str]) -> Array:
        """What the network is to say, (N, K) in mm, rad and N; NaN where that is not labelled.

        Parameters
        ----------
        euler_mm_deg, force : (N, 6) and (N, 3) of a data set
        labelled : what of them is
        """
        euler, force = np.asarray(euler_mm_deg, np.float64), np.asarray(force, np.float64)
        missing = [name for name in self.quantity_names if name not in labelled]
        if self.tangent and (lacking := [name for name in missing if name in EULER_COMPONENTS]):
            raise SettingError(
                f"{', '.join(lacking)} not labelled: the network tells all six components of the pose "
                "together, so that it can only be held against labels of all six"
            )
        pose = labels_from_euler(euler) if self.tangent else euler / _TABLE_SCALE
        labels = np.hstack([pose, force[:, [FORCES.index(name) for name in self.forces]]])
        labels[:, [self.quantity_names.index(name) for name in missing]] = np.nan
        return labels

    def depths(self, labels: Array) -> Array:
        """Depths (N,) in m, the z of X_fs, of labels (N, K)."""
        return depths(labels[:, :POSE]) if self.tangent else 1e-3 * labels[:, 2]

    def euler(self, outputs: Array) -> Array:
        """Euler surface contact poses (N, 6) in mm and degrees of the network's outputs (N, K)."""
        if self.tangent:
            return np.array([euler_from_label(row[:POSE]) for row in outputs]).reshape(-1, POSE)
        return outputs[:, :POSE] * _TABLE_SCALE

    def error(self, found: Array, labels: Array) -> Array:
        """Found - labels (N, K), the short way round for angles that go all round."""
        error = found - labels
        turning = list(self.turning)
        error[:, turning] = (error[:, turning] + np.pi) % (2.0 * np.pi) - np.pi
        return error

    def gaussians(self, mean: Array, cov: Array) -> tuple[PoseGaussian, ForceGaussian | None]:
        """The network's answer, mean (K,) and covariance (K, K), as Gaussians over X_sf and the force, in SI.

        Raises `EstimateError` if the covariance is not positive definite.
        """
        pose = pose_gaussian if self.tangent else gaussian_from_euler
        return pose(mean[:POSE], cov[:POSE, :POSE]), self._force(mean, cov)

    def _force(self, mean: Array, cov: Array) -> ForceGaussian | None:
        if not self.forces:
            return None
        prior = SURFACE_FORCE.prior
        force, covariance = prior[0][POSE:].copy(), np.diag(prior[1][POSE:] ** 2)
        at = [FORCES.index(name) for name in self.forces]
        force[at], covariance[np.ix_(at, at)] = mean[POSE:], cov[POSE:, POSE:]
        return ForceGaussian(force, covariance)

    def row(self, pose: PoseGaussian, force: ForceGaussian | None) -> tuple[Array, Array]:
        """Mean and standard deviations (K,) of Gaussians, the reverse of `gaussians`; NaN without a force."""
        mean, cov = tangent_gaussian(pose) if self.tangent else euler_gaussian(pose)
        sigma = np.sqrt(np.diag(cov))
        if not self.forces:
            return mean, sigma
        at = [FORCES.index(name) for name in self.forces]
        known = force or ForceGaussian(np.full(3, np.nan), np.full((3, 3), np.nan))
        return np.append(mean, known.mean[at]), np.append(sigma, np.sqrt(np.diag(known.cov)[at]))

    def plain(self) -> dict[str, Any]:
        """For a model file, in types that JSON has."""
        return {
            "name": self.name,
            "quantities": [dataclasses.asdict(quantity) for quantity in self.quantities],
            "labelled": list(self.labelled),
        }

    @classmethod
    def from_plain(cls, values: Any) -> ContactModel:
        """The reverse; `ValueError` says what is wrong."""
        try:
            quantities = tuple(Quantity(**quantity) for quantity in values["quantities"])
            found = cls(str(values["name"]), quantities, labelled=tuple(values["labelled"]))
            objections = list(found.objections())
        except (KeyError, TypeError) as error:
            raise ValueError(f"contact_model: cannot be read: {error!r}") from error
        if objections:
            raise ValueError(f"contact_model: {'; '.join(objections)}")
        return found


def euler_jacobian(T_fs: ArrayLike) -> Array:
    """(6, 6) from small changes of (x, y, z, alpha, beta, gamma) of X_fs to the perturbation left of X_sf.

    X_sf changes by exp(eps^) with eps = [-R^T dt, -W da], W da the body's angular rate, R = Rz Ry Rx.
    """
    T = np.asarray(T_fs, np.float64)
    alpha, beta = se3.euler_from_pose(T)[3:5]
    (sa, sb), (ca, cb) = np.sin([alpha, beta]), np.cos([alpha, beta])
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = -T[:3, :3].T
    jacobian[3:, 3:] = -np.array([[1.0, 0.0, -sb], [0.0, ca, sa * cb], [0.0, -sa, ca * cb]])
    return jacobian


def gaussian_from_euler(mean: Array, cov: Array) -> PoseGaussian:
    """Gaussian over X_sf (SI) of one over the Euler components of X_fs, (6,) and (6, 6) in mm and rad.

    Raises `EstimateError` if the covariance is not positive definite.
    """
    X_fs = se3.pose_from_euler(mean * NETWORK_SCALE)
    root = euler_jacobian(X_fs) @ (NETWORK_SCALE[:, None] * covariance_root(cov))
    return PoseGaussian(se3.inverse(X_fs), root @ root.T)


def euler_gaussian(gaussian: PoseGaussian) -> tuple[Array, Array]:
    """The reverse: mean (6,) and covariance (6, 6) of the Euler components of X_fs, in mm and rad."""
    X_fs = se3.inverse(gaussian.mean)
    inverse = np.linalg.inv(euler_jacobian(X_fs)) / NETWORK_SCALE[:, None]
    return se3.euler_from_pose(X_fs) / NETWORK_SCALE, inverse @ gaussian.cov @ inverse.T


def _quantities(gamma: float, *forces: float) -> tuple[Quantity, ...]:
    """The pose of a TacTip's contacts, with gamma (deg) between these bounds; forces (N) between those."""
    bounds = (5.0, 5.0, 8.0, 25.0, 25.0, gamma)
    pose = [
        Quantity(name, unit, 0.0 if name == "z" else -bound, bound)
        for name, unit, bound in zip(EULER_COMPONENTS, EULER_UNITS, bounds, strict=True)
    ]
    found = [Quantity(name, "N", -bound, bound) for name, bound in zip(FORCES, forces, strict=False)]
    return (*pose, *found)


#: Sensor on a surface; {f} has z into the surface and its origin where the sensor's center first touched.
SURFACE = ContactModel("surface", _quantities(10.0))
#: Sensor on a straight edge: {f} lies on it, z into the surface and x along the edge; y is the offset.
EDGE = ContactModel("edge", _quantities(180.0), required=("y", "z", "gamma"))
#: `surface` with the force on the sensor, in {s}.
SURFACE_FORCE = ContactModel("surface_force", _quantities(10.0, 50.0, 50.0, 100.0))

CONTACT_MODELS: Registry[ContactModel] = Registry(
    "contact model",
    "tactile_servoing.contact_models",
    {
        model.name: f"{__name__}:{constant}"
        for constant, model in (("SURFACE", SURFACE), ("EDGE", EDGE), ("SURFACE_FORCE", SURFACE_FORCE))
    },
    Contract(None, base=lambda: ContactModel, also=ContactModel.objections),
)
