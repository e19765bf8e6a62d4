"""Rigid surfaces as signed distance functions, each in its own frame, for the simulated sensor to touch.

Distances are exact (Euclidean), positive outside, in metres; normals are unit, outward, and equal the
gradient of the distance. All functions take many points at once::

    surface = make_surface("ramp", {"height": 0.03})
    distance, normal = surface.query(points)
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tactile_base.registry import Registry
from tactile_base.settings import SettingError, Settings, setting, unknown_name

Array = NDArray[np.float64]

_NEWTON_TOLERANCE = 1e-8  # m, the last step: convergence is quadratic, so that the error left is below 1e-14
_NEWTON_LIMIT = 8
_BISECTIONS = 60
_MAX_RAMP_SLOPE_DEG = 60.0


class Surface(ABC):
    """A rigid surface in its own frame.

    Subclasses name their `Settings` class and implement `query` and `grid`.
    """

    kind: ClassVar[str]
    settings_class: ClassVar[type[Settings]]

    @abstractmethod
    def query(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (N,) in m and outward unit normal (N, 3) at `points` (N, 3) in m."""

    @abstractmethod
    def grid(self, n: int = 60) -> Array:
        """Points (rows, n, 3) on the part of the surface that is worth drawing, in m."""

    def distance(self, points: Array) -> Array:
        """Signed distance (N,) of `points` (N, 3) in m, positive outside."""
        return self.query(points)[0]

    def normal(self, points: Array) -> Array:
        """Outward unit normal (N, 3) at `points` (N, 3): the gradient of the distance."""
        return self.query(points)[1]

    def closest(self, points: Array) -> Array:
        """Points (N, 3) of the surface that are nearest to `points` (N, 3), in m."""
        distance, normal = self.query(points)
        return points - distance[:, None] * normal

    def mesh(self, n: int = 60) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (V, 3) in m and triangles (F, 3), counter-clockwise from outside, of `grid(n)`."""
        points = self.grid(n)
        rows, columns = points.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = (
            block.ravel() for block in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
        )
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        return points.reshape(-1, 3), faces


@dataclass(frozen=True)
class PlaneSettings(Settings):
    """A plane; the size is only that of its picture."""

    width: float = setting(0.1, unit="m", lower=0.0, doc="extent of the drawn part along x")
    length: float = setting(0.2, unit="m", lower=0.0, doc="extent of the drawn part along y")


class Plane(Surface):
    """The plane z = 0 with the outside at z > 0."""

    kind = "plane"
    settings_class = PlaneSettings

    def __init__(self, settings: PlaneSettings | None = None) -> None:
        self.settings = settings or PlaneSettings()

    def query(self, points: Array) -> tuple[Array, Array]:
        normal = np.zeros((len(points), 3))
        normal[:, 2] = 1.0
        return points[:, 2].copy(), normal

    def grid(self, n: int = 60) -> Array:
        half_x, half_y = self.settings.width / 2, self.settings.length / 2
        x, y = np.meshgrid(np.linspace(-half_x, half_x, n), np.linspace(-half_y, half_y, n))
        return np.stack([x, y, np.zeros_like(x)], axis=-1)


@dataclass(frozen=True)
class RampSettings(Settings):
    """A curved ramp: high flat part, S-shaped slope down along +y, low flat part."""

    height: float = setting(
        0.03, unit="m", lower=0.0, upper=1.0, doc="height of the high part over the low part"
    )
    length: float = setting(0.14, unit="m", lower=0.01, upper=10.0, doc="length of the slope along y")
    flat: float = setting(0.04, unit="m", lower=0.0, doc="drawn length of each flat part (they have no end)")
    width: float = setting(0.08, unit="m", lower=0.0, doc="drawn width along x (the ramp has no side)")

    def __post_init__(self) -> None:
        super().__post_init__()
        slope_deg = np.degrees(np.arctan(1.875 * self.height / self.length))
        if slope_deg > _MAX_RAMP_SLOPE_DEG:
            raise SettingError(
                f"height = {self.height:g} m over length = {self.length:g} m: "
                f"slopes up to {slope_deg:.1f} degrees, must be at most {_MAX_RAMP_SLOPE_DEG:g}"
            )


class Ramp(Surface):
    """A profile z = h(y) without end along x: h = height for y <= 0, 0 for y >= length, a quintic between.

    The quintic smoothstep makes the profile twice continuously differentiable, so that an arm that follows it
    sees no jump in angular velocity. The nearest point is found by Newton's method on the profile.
    """

    kind = "ramp"
    settings_class = RampSettings

    def __init__(self, settings: RampSettings | None = None) -> None:
        self.settings = settings or RampSettings()

    @property
    def max_slope(self) -> float:
        """Steepest angle of the profile, rad."""
        return float(np.arctan(1.875 * self.settings.height / self.settings.length))

    @property
    def min_curvature_radius(self) -> float:
        """A lower bound of the profile's radius of curvature, m (the bound leaves the slope out)."""
        second = self._max_second_derivative
        return float(1.0 / second) if second > 0 else float("inf")

    @property
    def _max_second_derivative(self) -> float:
        return 10.0 / np.sqrt(3.0) * self.settings.height / self.settings.length**2

    def profile(self, y: Array) -> tuple[Array, Array, Array]:
        """Height h(y) in m, slope h'(y) and h''(y) in 1/m, each of the shape of `y` (m)."""
        height, length = self.settings.height, self.settings.length
        t = np.clip(y / length, 0.0, 1.0)
        rest = 1.0 - t
        bump = t * rest
        h = height * (1.0 - t * t * t * (10.0 + t * (6.0 * t - 15.0)))
        slope = (-30.0 * height / length) * (bump * bump)
        second = (-60.0 * height / length**2) * (bump * (rest - t))
        return h, slope, second

    def query(self, points: Array) -> tuple[Array, Array]:
        y, z = points[:, 1], points[:, 2]
        u = self._nearest_on_profile(y, z)
        h, slope, _ = self.profile(u)
        scale = 1.0 / np.sqrt(1.0 + slope * slope)
        normal = np.zeros((len(points), 3))
        normal[:, 1] = -slope * scale
        normal[:, 2] = scale
        return (y - u) * normal[:, 1] + (z - h) * normal[:, 2], normal

    def grid(self, n: int = 60) -> Array:
        s = self.settings
        y = np.linspace(-s.flat, s.length + s.flat, 2 * n)
        x = np.linspace(-s.width / 2, s.width / 2, n)
        xx, yy = np.meshgrid(x, y)
        return np.stack([xx, yy, self.profile(yy)[0]], axis=-1)

    def _nearest_on_profile(self, y: Array, z: Array) -> Array:
        """Parameters u (N,) of the nearest points (u, h(u)) to (y, z)."""
        u, gap, converged = self._newton(y, z)
        # Well within the smallest radius of curvature the condition rises with u: its root is unique.
        search = ~converged | (gap * self._max_second_derivative > 0.7)
        if search.any():
            u[search] = self._search(y[search], z[search])
        return u

    def _newton(self, y: Array, z: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Stationary points from u = y, the gaps |z - h(y)| there, and which ones converged."""
        h, slope, second = self.profile(y)
        first_gap = np.abs(z - h)
        u = y
        for _ in range(_NEWTON_LIMIT):
            gap = h - z
            step = (u - y + gap * slope) / np.maximum(1.0 + slope * slope + gap * second, 0.1)
            u = u - step
            moved = np.abs(step)
            if (moved < _NEWTON_TOLERANCE).all():
                break
            h, slope, second = self.profile(u)
        return u, first_gap, moved < _NEWTON_TOLERANCE

    def _search(self, y: Array, z: Array) -> Array:
        """Global minimum: nearest of many samples of the slope, then bisection of the condition."""
        length = self.settings.length
        samples = np.linspace(0.0, length, 129)
        h = self.profile(samples)[0]
        best = np.argmin((y[:, None] - samples) ** 2 + (z[:, None] - h) ** 2, axis=1)
        low = samples[np.maximum(best - 1, 0)]
        high = samples[np.minimum(best + 1, len(samples) - 1)]
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            h_middle, slope, _ = self.profile(middle)
            rising = middle - y + (h_middle - z) * slope > 0
            low, high = np.where(rising, low, middle), np.where(rising, middle, high)
        candidates = np.stack([np.minimum(y, 0.0), 0.5 * (low + high), np.maximum(y, length)])
        squared = (candidates - y) ** 2 + (self.profile(candidates)[0] - z) ** 2
        return np.take_along_axis(candidates, np.argmin(squared, axis=0)[None], axis=0)[0]


@dataclass(frozen=True)
class DomeSettings(Settings):
    """A hemisphere on a base plane."""

    radius: float = setting(0.075, unit="m", lower=0.005, upper=10.0, doc="radius of the hemisphere")


class Dome(Surface):
    """The upper half of a sphere about the origin on the plane z = 0 (the outside is above both).

    The top is at (0, 0, radius). In the crease between the two, and inside below the base, normals jump.
    """

    kind = "dome"
    settings_class = DomeSettings

    def __init__(self, settings: DomeSettings | None = None) -> None:
        self.settings = settings or DomeSettings()

    def query(self, points: Array) -> tuple[Array, Array]:
        radius = self.settings.radius
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        from_center = np.sqrt(x * x + y * y + z * z)
        distance = from_center - radius
        normal = points / np.maximum(from_center, 1e-300)[:, None]
        if (np.abs(distance) < z).all():
            return distance, normal
        return self._with_base(points, distance, normal, from_center)

    def _with_base(
        self, points: Array, distance: Array, normal: Array, from_center: Array
    ) -> tuple[Array, Array]:
        """The general case: nearest of cap (z > 0), plane outside the cap's foot, and the foot's circle."""
        radius, z = self.settings.radius, points[:, 2]
        in_plane = np.hypot(points[:, 0], points[:, 1])
        outward = in_plane - radius
        crease = np.hypot(outward, z)
        inside = (from_center < radius) | (z < 0)
        cap = np.where(z > 0, np.abs(distance), crease)
        base = np.where(outward >= 0, np.abs(z), crease)
        sign = np.where(inside, -1.0, 1.0)
        on_cap = (z > 0) & (cap <= base)
        on_base = (outward >= 0) & ~on_cap
        at_crease = ~on_cap & ~on_base

        result = sign * np.minimum(cap, base)
        normal = np.where(on_cap[:, None], normal, [0.0, 0.0, 1.0])
        normal[on_cap & (from_center == 0)] = (0.0, 0.0, 1.0)
        if at_crease.any():
            p, rho = points[at_crease], in_plane[at_crease]
            direction = np.where((rho > 0)[:, None], p[:, :2] / np.maximum(rho, 1e-300)[:, None], [1.0, 0.0])
            foot = np.column_stack([radius * direction, np.zeros(len(p))])
            normal[at_crease] = (foot - p) / np.maximum(crease[at_crease], 1e-300)[:, None]
        return result, normal

    def grid(self, n: int = 60) -> Array:
        azimuth = np.linspace(0.0, 2 * np.pi, n)
        polar = np.linspace(np.pi / 2, 0.0, n)
        a, p = np.meshgrid(azimuth, polar)
        unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
        return self.settings.radius * unit


SURFACES: dict[str, type[Surface]] = {cls.kind: cls for cls in (Plane, Ramp, Dome)}
SHAPES: Registry[Any] = Registry(
    "shape", "tactile_servoing.shapes", {kind: f"{__name__}:{cls.__name__}" for kind, cls in SURFACES.items()}
)


def make_surface(kind: str, parameters: Mapping[str, Any] | None = None, where: str = "") -> Surface:
    """The surface of the given kind ("plane", "ramp", "dome") from named parameters.

    Raises `SettingError`, which names `where` (a file and line), for an unknown kind or a bad parameter.
    """
    if kind not in SURFACES:
        raise SettingError((f"{where}: " if where else "") + unknown_name(kind, list(SURFACES)))
    cls = SURFACES[kind]
    return cls(cls.settings_class.from_mapping(parameters or {}, where))  # type: ignore[call-arg]


@dataclass(frozen=True)
class ContactGeometry:
    """Where an undeformed spherical tip meets a surface.

    Attributes
    ----------
    depth : float
        Depth of the tip below the surface, m; negative off it.
    T_fs : ndarray (4, 4)
        Contact pose X_fs without shear: translation (0, 0, depth), rotation without turn about {f}'s z.
    normal_angle : float
        Angle between the sensor's z axis and the inward normal, rad.
    point, normal : ndarray (3,)
        Nearest point of the surface (m) and outward unit normal there, in the surface's frame.
    """

    depth: float
    T_fs: Array
    normal_angle: float
    point: Array
    normal: Array


def contact_pose(surface: Surface, T_surface_sensor: Array, radius: float) -> ContactGeometry:
    """Geometry of the contact of a tip of the given radius (m) about the sensor frame's origin.

    The feature frame {f} has its z axis along the inward normal at the nearest point of the surface and its
    origin where the sensor's centre would be at first touch, `radius` off the surface. Its turn about z is
    the one for which X_fs, as extrinsic xyz Euler angles, has gamma = 0.
    """
    rotation, center = T_surface_sensor[:3, :3], T_surface_sensor[:3, 3]
    distance, normals = surface.query(center[None])
    normal, depth = normals[0], radius - float(distance[0])
    inward = rotation.T @ -normal  # {f}'s z axis in {s}
    T_fs = np.eye(4)
    T_fs[:3, :3] = _rotation_without_turn(inward)
    T_fs[2, 3] = depth
    angle = float(np.arctan2(np.hypot(inward[0], inward[1]), inward[2]))
    return ContactGeometry(depth, T_fs, angle, center - float(distance[0]) * normal, normal)


def _rotation_without_turn(axis: Array) -> Array:
    """R_fs = Ry(beta) Rx(alpha) whose third row, {f}'s z axis in {s}, is the unit vector `axis`."""
    x, y, z = axis
    cos_beta = np.hypot(y, z)
    sin_alpha, cos_alpha = (y / cos_beta, z / cos_beta) if cos_beta > 0 else (0.0, 1.0)
    return np.array([
        [cos_beta, -x * sin_alpha, -x * cos_alpha],
        [0.0, cos_alpha, -sin_alpha],
        [x, cos_beta * sin_alpha, cos_beta * cos_alpha],
    ])  # fmt: skip
