"""A simulated TacTip: skin in frictional contact with a surface, and what its camera sees.

The motion is quasi-static with history. Each skin node in contact holds on to the point of the surface that
it touched (its anchor, kept in the surface's frame) until the tangential force exceeds friction times the
normal force; then it slips and drags the anchor along::

    sensor = TacTip(TacTipSettings(), seed=1)
    sensor.advance(surface, T_surface_sensor)
    image, truth = sensor.image(), sensor.truth()
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_geometry.se3 import PoseError
from tactile_scene.simulated_sensors import TacTipSettings
from tactile_sim import _contact
from tactile_sim.camera import Camera
from tactile_sim.gel_light import GelLight
from tactile_sim.markers import Markers
from tactile_sim.network_view import NetworkView, ViewSettings
from tactile_sim.skin import Skin, load_skin

Array = NDArray[np.float64]
_FREE, _STICK, _SLIP = 0, 1, 2


class SurfaceShape(Protocol):
    """What the sensor has to know of a surface, in the surface's own frame."""

    def query(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (n,) m, positive outside, and outward unit normal (n, 3) at points (n, 3) m."""


@dataclass(frozen=True)
class ContactTruth:
    """What the simulation knows about the contact.

    Attributes
    ----------
    depth : float, m
        Tip radius less the distance of the dome's centre from the surface; negative off the surface.
    T_fs : (4, 4)
        Equivalent surface contact pose X_fs: depth and angles from geometry, shear from the anchors (see
        `TacTip.truth`).
    T_surface_contact : (4, 4)
        The feature frame {f} in the surface's frame.
    force : (3,) N
        Total force of the surface on the skin, in {s}.
    torque : (3,) N m
        Its torque about the origin of {s}, in {s}.
    normal_force, tangential_force : float, N
        Its parts along and across the surface's normal under the dome's centre.
    contact_nodes : int
        Skin nodes that carry force.
    slip_fraction : float
        Part of the normal force carried by nodes that slipped in the last step.
    """

    depth: float
    T_fs: Array
    T_surface_contact: Array
    force: Array
    torque: Array
    normal_force: float
    tangential_force: float
    contact_nodes: int
    slip_fraction: float


class TacTip:
    """One sensor with its contact history; deterministic by seed (the seed selects image noise only).

    With a `view` its images are what that network would see of them, drawn at its size and without noise.
    """

    def __init__(
        self,
        settings: TacTipSettings | None = None,
        seed: int = 0,
        skin: Skin | None = None,
        view: ViewSettings | None = None,
    ) -> None:
        self.settings = settings or TacTipSettings()
        self._skin = skin or load_skin(self.settings.skin)
        tip = self.settings.skin
        self._markers = Markers(self.settings.markers, self._skin, tip.radius, tip.skin_thickness)
        self._camera = Camera(self.settings.camera)
        lit = self.settings.light.lamp_gray > 0.0
        light = self.settings.light, self._camera, self._skin, tip.radius
        self._light = GelLight(*light) if lit else None
        self._view = NetworkView(self._camera, view) if view is not None else None
        self._friction = self.settings.contact.friction
        self.reset(seed)

    def reset(self, seed: int | None = None) -> None:
        """Forget contact and pose, and start the image noise again (from a new seed if given)."""
        count = len(self._skin.nodes)
        if seed is not None:
            self._seed = seed
        self._frames = 0
        self._T: Array | None = None
        self._surface: SurfaceShape | None = None
        self._force = np.zeros((count, 3))
        self._state = np.zeros(count, dtype=np.uint8)
        self._anchor = np.zeros((count, 3))
        self._touch = np.zeros((count, 3))
        self._normal = np.zeros((count, 3))
        self._displacement = np.zeros((count, 3), dtype=np.float32)

    @property
    def friction(self) -> float:
        """Coulomb friction in force; may be set between steps."""
        return self._friction

    @friction.setter
    def friction(self, value: float) -> None:
        self._friction = self.settings.contact.replaced(friction=value).friction

    @property
    def marker_positions(self) -> Array:
        """Markers (n, 3) m in {s}."""
        return self._markers.positions(self._displacement)

    @property
    def marker_pixels(self) -> Array:
        """Markers (n, 2) in the image: column, row."""
        return self._camera.project(self.marker_positions)[0]

    @property
    def displacement(self) -> Array:
        """Displacement (nodes, 3) m of the skin nodes from rest, in {s}."""
        return self._displacement.astype(float)

    def advance(self, surface: SurfaceShape, T_surface_sensor: Array) -> None:
        """Move to a pose (4, 4) of {s} in the surface's frame, in steps no longer than `max_step`.

        A surface other than the last one starts a new contact: anchors on the old one mean nothing on it.

        Raises
        ------
        PoseError
            If the pose is not a finite rigid transform, or the surface answers with something not finite.
        """
        target = se3.checked_pose("pose of the sensor", T_surface_sensor).copy()
        if surface is not self._surface:
            self._release()
            self._surface, self._T = surface, None
        start = target if self._T is None else self._T
        steps = self._steps_between(start, target, surface)
        for k in range(1, steps + 1):
            self._step(surface, target if k == steps else se3.interpolate(start, target, k / steps))
        self._T = target

    def image(self) -> NDArray[np.uint8]:
        """Expose one frame, whose noise differs from frame to frame: gray (height, width).

        With lamps it is in color (height, width, 3), blue, green and red. With a view, it is what crop,
        threshold and resizing would leave of it: black and white (size, size).
        """
        if self._view is not None:
            return self._view.draw(self.marker_positions)
        seed = (self._seed * 0x9E3779B97F4A7C15 + self._frames * 0xD1B54A32D192ED03) % 2**64
        self._frames += 1
        if self._light is None:
            return self._camera.draw(self.marker_positions, seed)
        grounds, points = self._light.grounds(self._displacement), self.marker_positions
        colors = [self._camera.draw(points, seed ^ k, ground) for k, ground in enumerate(grounds)]
        return np.stack(colors, axis=-1)

    def truth(self) -> ContactTruth:
        """Where the sensor is, as a surface contact pose that a picture could know.

        Depth and contact angles follow from the geometry at the surface point nearest to the dome's centre.
        Shear (x, y, gamma) is the rigid motion in the tangent plane that best carries (least squares,
        weighted by normal force) the anchors to the places where their nodes were, in the sensor, when they
        touched. It is the commanded shear as long as nothing slips, and saturates when the contact slips.

        Raises
        ------
        RuntimeError
            If the sensor has not been anywhere yet.
        """
        if self._T is None or self._surface is None:
            raise RuntimeError("truth() before the first advance(): the sensor has no pose yet")
        return _truth(self._T, self._surface, self.settings.skin.radius, self._contact_state())

    def _friction_now(self) -> float:
        """Friction under the normal force of the last step."""
        half = self.settings.contact.friction_load
        if half == 0.0:
            return self._friction
        load = float(np.einsum("ij,ij->", self._force, self._normal))
        return self._friction * max(load, 0.0) / (max(load, 0.0) + half)

    def _contact_state(self) -> _ContactState:
        on = np.flatnonzero(self._state)
        return _ContactState(
            self._force[on], self._state[on], self._normal[on], self._anchor[on], self._touch[on]
        )

    def _release(self) -> None:
        self._force[:] = 0.0
        self._state[:] = _FREE
        self._displacement[:] = 0.0

    def _steps_between(self, start: Array, target: Array, surface: SurfaceShape) -> int:
        """Steps for a motion: one when out of reach at both ends, else by how far the tip moves."""
        reach = self.settings.skin.radius
        far = all(_query(surface, T[None, :3, 3])[0][0] > 1.5 * reach for T in (start, target))
        if far:
            return 1
        turn = _rotation_angle(start[:3, :3].T @ target[:3, :3])
        length = float(np.linalg.norm(target[:3, 3] - start[:3, 3])) + reach * turn
        return max(1, int(np.ceil(length / self.settings.contact.max_step - 1e-9)))

    def _step(self, surface: SurfaceShape, T: Array) -> None:
        """One quasi-static step: linearize the surface at the guessed skin, solve, drag what slipped."""
        rotation, origin = T[:3, :3], T[:3, 3]
        settings = self.settings.contact
        skin = self._skin.nodes + self._displacement
        gap, normal = _query(surface, skin @ rotation.T + origin)
        on = np.flatnonzero((gap < settings.margin) | (self._state != _FREE))
        if not len(on):
            self._state[:] = _FREE
            return
        normal_s = normal[on] @ rotation
        fresh = self._state[on] == _FREE
        self._anchor[on[fresh]] = skin[on[fresh]] @ rotation.T + origin
        offset = skin[on] - (self._anchor[on] - origin) @ rotation
        along = np.einsum("ij,ij->i", offset, normal_s)
        residual = (offset + (gap[on] - along)[:, None] * normal_s).astype(np.float32)
        force, state = self._force[on], np.empty(len(on), dtype=np.uint8)
        active = on.astype(np.int32)
        _contact.solve(force, state, residual, normal_s, self._skin.compliance, active, self._friction_now(),
                       settings.max_sweeps, settings.tolerance)  # fmt: skip
        _contact.displacement(self._displacement, force, self._skin.compliance, active)
        self._remember(on, force, state, normal_s, fresh, rotation, origin)

    def _remember(
        self, on: NDArray[np.intp], force: Array, state: NDArray[np.uint8], normal: Array,
        fresh: NDArray[np.bool_], rotation: Array, origin: Array,
    ) -> None:  # fmt: skip
        """Keep forces and states; set anchors of what slipped or is new, and where new contacts touched."""
        self._force[:], self._state[:] = 0.0, _FREE
        self._force[on], self._state[on], self._normal[on] = force, state, normal
        skin = self._skin.nodes[on] + self._displacement[on]
        touched = on[fresh]
        self._touch[touched] = (self._anchor[touched] - origin) @ rotation
        dragged = state == _SLIP
        self._anchor[on[dragged]] = skin[dragged] @ rotation.T + origin


@dataclass(frozen=True)
class _ContactState:
    """Nodes in contact: force, state and normal in {s}; anchors on the surface; touch points in {s}."""

    force: Array
    state: NDArray[np.uint8]
    normal: Array
    anchor: Array
    touch: Array


def _truth(T: Array, surface: SurfaceShape, radius: float, contact: _ContactState) -> ContactTruth:
    distance, normal = _query(surface, T[None, :3, 3])
    into_surface = -(normal[0] @ T[:3, :3])
    tilt = _tilt(into_surface)  # {s} to the tangent frame that is aligned with the sensor, z into the surface
    press = np.maximum(np.einsum("ij,ij->i", contact.force, contact.normal), 0.0)
    total = contact.force.sum(axis=0)
    shear, gamma = np.zeros(2), 0.0
    anchors = (contact.anchor - T[:3, 3]) @ T[:3, :3]
    if press.sum() > 0:
        shear, gamma = _rigid_shear((contact.touch @ tilt.T)[:, :2], (anchors @ tilt.T)[:, :2], press)
    turn = np.array([[np.cos(gamma), -np.sin(gamma), 0], [np.sin(gamma), np.cos(gamma), 0], [0, 0, 1.0]])
    T_fs = np.eye(4)
    T_fs[:3, :3] = turn @ tilt
    depth = radius - float(distance[0])
    T_fs[:3, 3] = [*(turn[:2, :2] @ shear), depth]
    along = float(-total @ into_surface)
    return ContactTruth(
        depth=depth, T_fs=T_fs, T_surface_contact=T @ se3.inverse(T_fs), force=total,
        torque=np.cross(anchors, contact.force).sum(axis=0), normal_force=along,
        tangential_force=float(np.linalg.norm(total + along * into_surface)),
        contact_nodes=int((press > 0).sum()),
        slip_fraction=float(press[contact.state == _SLIP].sum() / press.sum()) if press.sum() > 0 else 0.0,
    )  # fmt: skip


def _tilt(into_surface: Array) -> Array:
    """R_y(beta) R_x(alpha) that takes a unit vector in {s} to +z."""
    alpha = np.arctan2(into_surface[1], into_surface[2])
    beta = -np.arcsin(np.clip(into_surface[0], -1.0, 1.0))
    ca, sa, cb, sb = np.cos(alpha), np.sin(alpha), np.cos(beta), np.sin(beta)
    return np.array([[cb, sb * sa, sb * ca], [0, ca, -sa], [-sb, cb * sa, cb * ca]])


def _rigid_shear(now: Array, anchor: Array, weight: Array) -> tuple[Array, float]:
    """Motion of the sensor since touch, in the plane: displacement (2,) of its centre and rotation (rad).

    `now` are touch points carried by the sensor, `anchor` where they touched, both relative to the centre.
    """
    weight = weight / weight.sum()
    mean_now, mean_anchor = weight @ now, weight @ anchor
    a, b = anchor - mean_anchor, now - mean_now
    gamma = float(
        np.arctan2(weight @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), weight @ np.sum(a * b, axis=1))
    )
    if len(now) < 3:
        gamma = 0.0
    c, s = np.cos(gamma), np.sin(gamma)
    return mean_now @ np.array([[c, -s], [s, c]]) - mean_anchor, gamma


def _query(surface: SurfaceShape, points: Array) -> tuple[Array, Array]:
    distance, normal = surface.query(points)
    if not (np.isfinite(distance).all() and np.isfinite(normal).all()):
        raise PoseError(f"surface {type(surface).__name__} gave a distance or normal that is not finite")
    return distance, normal


def _rotation_angle(rotation: Array) -> float:
    axial = rotation[[2, 0, 1], [1, 2, 0]] - rotation[[1, 2, 0], [2, 0, 1]]
    return float(np.arctan2(np.linalg.norm(axial), np.trace(rotation) - 1))
