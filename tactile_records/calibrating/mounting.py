"""How the sensor is turned in the tool, from what its network says of contacts with one plane.

With R the rotation from the sensor as it is to the sensor as the scene has it, and n the plane's normal into
the surface, seen from the latter at touch i (it is known from where the touches met the plane, see `tip`):

    m_i = R^T n_i                        the normal that the network says, under each tilt
    phi_k = angle of x and y of R^T x    by which it has the arm's own motion along the surface turned, in
                                         touches that are upright (in others the tip rolls as well)

Least squares over R = exp(r^) from both. What the network does wrong in one pose it does wrong again: each
touch counts once, the spread over the touches is the noise, and `SYSTEMATIC` comes on top.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tactile_base.stamps import SECOND_NS
from tactile_records.calibrating import tip
from tactile_records.calibrating.result import CalibrationError
from tactile_records.calibrating.touches import touches_of
from tactile_records.runs.euler_poses import inverses
from tactile_records.runs.record import RunRecord

Array = NDArray[np.float64]

#: Standard deviations about x, y, z of what a network does wrong under all tilts alike, rad.
SYSTEMATIC = np.radians([0.3, 0.3, 0.5])
_LEAST_NOISE = np.radians([0.1, 0.3])  # of a normal and of a direction of motion, rad
_DEEP = 0.75  # of the depth that a touch comes to, from which on its estimates count
_UPRIGHT = np.radians(5.0)
_LEAST_MOTION = 3e-4  # m, root mean square
_GAP = SECOND_NS // 3  # between the estimates of two touches
_OBSERVED = np.radians(2.0)
_UNLIKE = np.radians(6.0)  # m_i off what any mounting explains: not this sensor's network


@dataclass(frozen=True)
class Contact:
    """What was said and seen in one touch.

    Attributes
    ----------
    said, seen : ndarray (3,)
        The normal into the surface in the sensor frame of the scene, and as the network has it in its own.
    moved, felt : ndarray (N, 2)
        Motion of the sensor along the surface by the arm and by the network, in the same two frames, m; none
        in touches that are not upright, or without such a motion.
    """

    said: Array
    seen: Array
    moved: Array
    felt: Array

    @property
    def turn(self) -> complex:
        """By what factor and angle the network has the motion turned; NaN without one."""
        if not len(self.moved):
            return complex(np.nan, np.nan)
        moved, felt = (v[:, 0] + 1j * v[:, 1] for v in (self.moved, self.felt))
        return complex(np.vdot(moved, felt) / np.vdot(moved, moved))


@dataclass(frozen=True)
class Mounting:
    """What was found; angles in rad.

    Attributes
    ----------
    rotation, sigma : ndarray (3,)
        Rotation vector of the sensor as it is in the frame that the scene says, and standard deviations.
    normal_residuals : ndarray (N,)
        Angle in each touch between the normal as seen and as this rotation has it.
    motion_residuals : ndarray (K,)
        The same of the directions of motion.
    contacts : tuple of Contact
    """

    rotation: Array
    sigma: Array
    normal_residuals: Array
    motion_residuals: Array
    contacts: tuple[Contact, ...]

    @property
    def R(self) -> Array:
        """The rotation as a matrix (3, 3)."""
        return np.asarray(Rotation.from_rotvec(self.rotation).as_matrix())


def contacts_of(record: RunRecord) -> tuple[Contact, ...]:
    """The contacts of a run that touched one plane; `CalibrationError` where the plane is not told."""
    touches = [touch.T_base_sensor for touch in touches_of(record)]
    into = -tip.estimated(np.array(touches).reshape(-1, 4, 4)).normal
    estimate = record.estimate
    known = record.pose.stamp_ns.min() <= estimate.stamp_ns
    estimate = estimate.rows(known & (estimate.stamp_ns <= record.pose.stamp_ns.max()))
    T = record.pose.at(estimate.stamp_ns)
    splits = np.flatnonzero(np.diff(estimate.stamp_ns) > _GAP) + 1
    each = zip(np.split(T, splits), np.split(estimate.mean, splits), strict=True)
    return tuple(_contact(T_one, mean, into) for T_one, mean in each if len(mean))


def _contact(T: Array, X_sf: Array, into: Array) -> Contact:
    X_fs = inverses(X_sf)
    deep = X_fs[:, 2, 3] >= _DEEP * X_fs[:, 2, 3].max()
    T, X_sf, X_fs = T[deep], X_sf[deep], X_fs[deep]
    said, seen = (T[:, :3, :3].transpose(0, 2, 1) @ into).mean(axis=0), X_sf[:, :3, 2].mean(axis=0)
    moved, felt = _own_motion(T), _own_motion(X_fs)
    upright = np.arccos(np.clip(said[2] / np.linalg.norm(said), -1.0, 1.0)) < _UPRIGHT
    if not upright or np.sqrt(np.mean(np.sum(moved**2, axis=1))) < _LEAST_MOTION:
        moved = felt = np.zeros((0, 2))
    return Contact(said / np.linalg.norm(said), seen / np.linalg.norm(seen), moved, felt)


def _own_motion(T: Array) -> Array:
    """Where a frame is along its own x and y (N, 2), from its mean position."""
    off = T[:, :3, 3] - T[:, :3, 3].mean(axis=0)
    return np.asarray(np.einsum("nji,nj->ni", T[:, :3, :3], off)[:, :2])


def estimated(contacts: tuple[Contact, ...]) -> Mounting:
    """The rotation from contacts with one plane.

    Raises
    ------
    CalibrationError
        Where they do not tell it, with what would be right.
    """
    if len(contacts) < 3:
        raise CalibrationError(f"{len(contacts)} contacts: must be at least 3, under tilts in 3 directions")
    said, seen = (np.array([getattr(one, name) for one in contacts]) for name in ("said", "seen"))
    turns = np.array([one.turn for one in contacts])
    angles = np.angle(turns[np.isfinite(turns)])

    def rests(r: Array) -> tuple[Array, Array]:
        R = Rotation.from_rotvec(r).as_matrix()
        return said @ R - seen, _wrapped(np.arctan2(R[0, 1], R[0, 0]) - angles)

    noise = _LEAST_NOISE
    for _ in range(2):  # the second time with the noise that the first has shown

        def rows(r: Array, noise: Array = noise) -> Array:
            normals, motions = rests(r)
            return np.concatenate([normals.ravel() / noise[0], motions / noise[1]])

        solution = least_squares(rows, np.zeros(3))
        normals, motions = rests(solution.x)
        spread = [np.sqrt(np.sum(normals**2) / max(2 * len(said) - 3, 1)), _rms(motions)]
        noise = np.maximum(_LEAST_NOISE, spread)
    off = np.linalg.norm(normals, axis=1)
    if _rms(off) > _UNLIKE:
        raise CalibrationError(
            f"the normals that the network says are {np.degrees(_rms(off)):.0f} degrees off what any "
            f"mounting explains, must be at most {np.degrees(_UNLIKE):.0f}: is the model this sensor's?"
        )
    information = solution.jac.T @ solution.jac
    if np.linalg.eigvalsh(information)[0] < _OBSERVED**-2:
        raise CalibrationError(
            f"the contacts do not tell how the sensor is turned to {np.degrees(_OBSERVED):g} degrees: press "
            "under at least three tilts of 10 degrees and more, in different directions, or move along the "
            "surface in an upright contact"
        )
    sigma = np.sqrt(np.diag(np.linalg.inv(information)) + SYSTEMATIC**2)
    return Mounting(solution.x, sigma, off, np.abs(motions), contacts)


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
