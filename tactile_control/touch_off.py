"""Finding a flat surface by touch: over each place, down until the image shows contact, up again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_control.collection import TouchSettings
from tactile_geometry import se3

Array = NDArray[np.float64]

OVER, DOWN, UP = "over", "down", "up"
_NEAR = 1e-3  # m; a move through the air need not end more exactly than this


class TouchFailed(RuntimeError):
    """No surface where one should be."""


@dataclass(frozen=True)
class TouchMove:
    """Where to move: X_fs (4, 4), slowly where the surface may be met on the way."""

    X_fs: Array
    slowly: bool


class TouchOff:
    """The touches of one calibration; whoever moves the arm asks `step` where to.

    Attributes
    ----------
    touches : list of ndarray (3,)
        Positions of the sensor's centre in {f} at which contact was first seen.
    """

    def __init__(self, settings: TouchSettings) -> None:
        self.settings = settings
        self.touches: list[Array] = []
        self._places = places(settings.points, settings.radius)
        self._step = OVER
        self._since_ns = 0

    @property
    def done(self) -> bool:
        """Every place was touched, and left."""
        return len(self.touches) == len(self._places) and self._step == OVER

    def step(self, now_ns: int, X_fs: Array, stamp_ns: int, X_exposed: Array, in_contact: bool) -> TouchMove:
        """Where to move next.

        Parameters
        ----------
        now_ns, X_fs
            Now, and the sensor's pose in {f}.
        stamp_ns, X_exposed, in_contact
            Stamp of the newest image, the sensor's pose in {f} at it, and whether it shows contact.

        Raises
        ------
        TouchFailed
            If nothing is met within the way to search, or something where there should be air.
        """
        search = self.settings.search
        if self._step == DOWN:
            return self._down(now_ns, X_fs, stamp_ns, X_exposed, in_contact)
        if self._step == UP and X_fs[2, 3] <= -search + _NEAR:
            self._go(OVER, now_ns)
        place = self._places[min(len(self.touches), len(self._places) - 1)]
        if self._step == UP:
            x, y, _ = self.touches[-1]
            return TouchMove(at(x, y, -search), slowly=False)
        over = at(*place, -search)
        fresh = stamp_ns >= self._since_ns
        if not self.done and np.linalg.norm(X_fs[:3, 3] - over[:3, 3]) <= _NEAR and fresh:
            if in_contact:
                raise TouchFailed(f"the image shows contact {search * 1e3:.1f} mm above the surface")
            self._go(DOWN, now_ns)
        return TouchMove(over, slowly=False)

    def corrected(self, T_base_f: Array) -> Array:
        """T_base_f (4, 4) as the touches have found it."""
        return frame_from_touches(T_base_f, np.array(self.touches), self.settings.depth)

    def _down(self, now_ns: int, X_fs: Array, stamp_ns: int, X_exposed: Array, in_contact: bool) -> TouchMove:
        x, y = self._places[len(self.touches)]
        search = self.settings.search
        if in_contact and stamp_ns >= self._since_ns:
            self.touches.append(X_exposed[:3, 3].copy())
            self._go(UP, now_ns)
            return TouchMove(at(x, y, -search), slowly=False)
        if X_fs[2, 3] > search:
            raise TouchFailed(
                f"no contact within {search * 1e3:.1f} mm above and below where the surface should be"
            )
        return TouchMove(at(x, y, 2.0 * search), slowly=True)

    def _go(self, step: str, now_ns: int) -> None:
        self._step, self._since_ns = step, now_ns


def at(x: float, y: float, z: float) -> Array:
    """X_fs (4, 4) at a position in {f}, untilted."""
    return se3.pose_from_euler([x, y, z, 0.0, 0.0, 0.0])


def places(points: int, radius: float) -> list[tuple[float, float]]:
    """Where to touch, x and y in {f}: the origin for one touch, else evenly on a circle."""
    if points <= 1:
        return [(0.0, 0.0)] * points
    angles = 2.0 * np.pi * np.arange(points) / points
    return [(radius * float(np.cos(angle)), radius * float(np.sin(angle))) for angle in angles]


def frame_from_touches(T_base_f: Array, centers: Array, depth: float) -> Array:
    """T_base_f (4, 4) corrected by positions (n, 3) of the sensor's centre in {f} at a known depth.

    One touch corrects the height; three and more, by a plane of least squares, the tilt as well. The x-axis
    stays where it was but for the tilt.
    """
    if len(centers) < 3:
        return np.asarray(T_base_f @ at(0.0, 0.0, float(np.mean(centers[:, 2])) - depth))
    basis = np.column_stack([centers[:, :2], np.ones(len(centers))])
    slope_x, slope_y, height = np.linalg.lstsq(basis, centers[:, 2], rcond=None)[0]
    z = np.array([-slope_x, -slope_y, 1.0])
    z /= np.linalg.norm(z)
    x = np.array([1.0, 0.0, 0.0]) - z * z[0]
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    # the plane of the centers lies as deep as the touches were
    T[:3, 3] = np.array([0.0, 0.0, height]) - z * depth
    return np.asarray(T_base_f @ T)
