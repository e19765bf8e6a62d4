"""The simulated sensor (camera, markers, skin, friction) and a rig's errors, fitted to real images.

Markers are tracked in labelled images (`tactile_perception.markers.labelled`), the contacts simulated with
their labels, and all marker positions fitted by Gauss-Newton on a soft-L1 loss: `tactile fit sensor`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tactile_perception.markers.labelled import Tracked
from tactile_scene.simulated_sensors import SkinSettings, TacTipSettings
from tactile_sim.camera import Camera
from tactile_sim.collection import Mounting, SensorFile, press_then_shear
from tactile_sim.markers import Markers
from tactile_sim.skin import Skin, load_skin
from tactile_sim.tactip import TacTip

Array = NDArray[Any]

SOFT = 3.0  # px, where the loss turns from squares to absolute values
DEPTHS = ((0.5, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6))  # mm, in which errors are told
REST_WEIGHT = 3.0  # of the markers at rest, which are known better
_UNIT = np.repeat([1e-3, np.pi / 180], 3)


@dataclass(frozen=True)
class Parameter:
    """One number of a sensor file: where it stands, the step of its derivative, and its bounds."""

    name: str
    step: float
    low: float
    high: float

    def of(self, sensor: SensorFile) -> float:
        group, field, index = self._parts()
        value = getattr(_group(sensor, group), field)
        return float(value if index is None else value[index])

    def put(self, sensor: SensorFile, value: float) -> SensorFile:
        group, field, index = self._parts()
        settings = _group(sensor, group)
        new: Any = float(np.clip(value, self.low, self.high))
        if index is not None:
            whole = list(getattr(settings, field))
            whole[index] = new
            new = tuple(whole)
        settings = settings.replaced(**{field: new})
        if group == "collection":
            return replace(sensor, collection=settings)
        return replace(sensor, sensor=replace(sensor.sensor, **{group: settings}))

    def _parts(self) -> tuple[str, str, int | None]:
        group, field, *index = self.name.split(".")
        return group, field, int(index[0]) if index else None


PARAMETERS = (
    Parameter("camera.focal_length", 5.0, 200, 3000),
    Parameter("camera.distance", 5e-4, 0.01, 0.2),
    Parameter("camera.distortion.0", 0.02, -3, 6),
    Parameter("camera.distortion.1", 0.05, -20, 20),
    Parameter("camera.center_column", 0.5, 300, 360),
    Parameter("camera.center_row", 0.5, 210, 270),
    Parameter("camera.rotation_deg", 0.3, -180, 180),
    Parameter("markers.pitch_deg", 0.03, 2.5, 8.0),
    Parameter("markers.azimuth_deg", 0.3, -180, 180),
    Parameter("markers.pin_length", 2e-4, 0.0, 8e-3),
    Parameter("skin.stiffness_ratio", 1.0, 0.5, 300),
    Parameter("skin.poisson_ratio", 0.02, 0.0, 0.48),
    Parameter("skin.volume_retention", 0.05, 0.0, 0.99),
    Parameter("contact.friction", 0.05, 0.1, 4.0),
    Parameter("contact.friction_load", 0.03, 0.0, 3.0),
    Parameter("collection.depth_offset", 5e-5, -2e-3, 1e-3),
    Parameter("collection.surface_tilt.0", 3e-3, -0.1, 0.1),
    Parameter("collection.surface_tilt.1", 3e-3, -0.1, 0.1),
    Parameter("collection.tool_offset.0", 1e-4, -4e-3, 4e-3),
    Parameter("collection.tool_offset.1", 1e-4, -4e-3, 4e-3),
    Parameter("collection.tool_offset.2", 1e-4, -5e-3, 5e-3),
)


class Fit:
    """Residuals of chosen contacts as a function of a sensor file.

    Raises
    ------
    ValueError
        The simulated markers at rest are too far from the real ones to say which is which.
    """

    def __init__(self, tracked: Tracked, chosen: Array, sensor: SensorFile) -> None:
        self.labels, self.real, self.rest = tracked.labels[chosen], tracked.positions[chosen], tracked.rest
        self._seen = np.isfinite(self.real[..., 0])
        self._moved: dict[Any, Array] = {}
        self._skins: dict[SkinSettings, Skin] = {}
        rest = Camera(sensor.sensor.camera).project(self._markers(sensor).rest)[0]
        self._order = np.linalg.norm(self.rest[:, None] - rest[None], axis=2).argmin(axis=1)
        if len(set(self._order)) != len(self._order):
            raise ValueError(
                "the simulated markers at rest are too far from the real ones to be matched: start from a "
                "sensor whose camera is nearer (--start)"
            )

    def residual(self, sensor: SensorFile) -> Array:
        """Simulated less real positions (n, 2) px of all markers seen, and of those at rest."""
        markers, camera = self._markers(sensor), Camera(sensor.sensor.camera)
        rest = camera.project(markers.rest)[0][self._order] - self.rest
        return np.concatenate([self.off(sensor)[self._seen], REST_WEIGHT * rest])

    def off(self, sensor: SensorFile) -> Array:
        """Simulated less real positions (contacts, 331, 2) px; NaN where a marker was not found."""
        markers, camera = self._markers(sensor), Camera(sensor.sensor.camera)
        pixels = np.array([camera.project(markers.positions(one))[0] for one in self._displaced(sensor)])
        return pixels[:, self._order] - self.real

    def _markers(self, sensor: SensorFile) -> Markers:
        tip = sensor.sensor.skin
        return Markers(sensor.sensor.markers, self._skin(tip), tip.radius, tip.skin_thickness)

    def _skin(self, settings: SkinSettings) -> Skin:
        if settings not in self._skins:
            while len(self._skins) > 5:
                self._skins.pop(next(iter(self._skins)))
            self._skins[settings] = load_skin(settings)
        return self._skins[settings]

    def _displaced(self, sensor: SensorFile) -> Array:
        """Skin displacements (contacts, nodes, 3), kept for sensors that differ in camera or markers only."""
        key = (sensor.sensor.skin, sensor.sensor.contact, sensor.collection)
        if key not in self._moved:
            if len(self._moved) > 3:
                self._moved.pop(next(iter(self._moved)))
            skin, mounting = self._skin(sensor.sensor.skin), Mounting.of(sensor.collection)
            simulated = TacTip(sensor.sensor, skin=skin)
            out = np.empty((len(self.labels), len(skin.nodes), 3), np.float32)
            for k, label in enumerate(self.labels):
                pose = label * _UNIT
                pose[2] += sensor.collection.depth_offset
                simulated.reset()
                press_then_shear(simulated, pose, mounting=mounting)
                out[k] = simulated.displacement
            self._moved[key] = out
        return self._moved[key]


def loss(residual: Array) -> float:
    """Soft L1 of the distances."""
    return float(np.sum(2 * SOFT**2 * (np.sqrt(1 + np.sum(residual**2, axis=1) / SOFT**2) - 1)))


def improve(
    fit: Fit, sensor: SensorFile, damping: float, parameters: Sequence[Parameter] = PARAMETERS
) -> tuple[SensorFile, float, float]:
    """One damped Gauss-Newton step: the new sensor (the old one where none helps), its loss, the damping."""
    start = fit.residual(sensor)
    columns = [
        (fit.residual(p.put(sensor, p.of(sensor) + p.step)) - start).astype(np.float32) for p in parameters
    ]
    jacobian = np.stack(columns, axis=-1)  # per step
    weight = (1 + np.sum(start**2, axis=1) / SOFT**2) ** -0.5
    normal = np.einsum("nci,n,ncj->ij", jacobian, weight, jacobian, optimize=True)
    gradient = np.einsum("nci,n,nc->i", jacobian, weight, start, optimize=True)
    before = loss(start)
    for _ in range(5):
        scaled = normal + damping * np.diag(np.diag(normal)) + 1e-9 * np.eye(len(normal))
        new = sensor
        for parameter, change in zip(parameters, np.linalg.solve(scaled, -gradient), strict=True):
            new = parameter.put(new, parameter.of(sensor) + change * parameter.step)
        after = loss(fit.residual(new))
        if after < before:
            return new, after, max(damping / 10, 1e-6)
        damping *= 10
    return sensor, before, damping


def by_depth(fit: Fit, sensor: SensorFile) -> list[tuple[str, int, float, float]]:
    """Of the contacts in each range of depth (mm): how many, median and RMS (px) of the markers' errors."""
    distance, depth, found = np.linalg.norm(fit.off(sensor), axis=2), fit.labels[:, 2], []
    for low, high in (*DEPTHS, (0.0, np.inf)):
        off = distance[(depth >= low) & (depth < high)]
        if np.isfinite(off).any():
            name = f"{low:g} to {high:g} mm" if np.isfinite(high) else "all"
            found.append((name, len(off), float(np.nanmedian(off)), float(np.sqrt(np.nanmean(off**2)))))
    return found


def write(sensor: SensorFile, path: Path, note: str) -> None:
    """A sensor file of what differs from the defaults."""
    groups: dict[str, Any] = {"description": note}
    for name in (*(item.name for item in fields(TacTipSettings)), "collection", "variation"):
        settings = (
            getattr(sensor, name) if name in ("collection", "variation") else getattr(sensor.sensor, name)
        )
        if settings is None:
            continue
        default = asdict(type(settings)())
        groups[name] = {k: _rounded(v) for k, v in asdict(settings).items() if v != default[k]}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(groups, sort_keys=False))


def _rounded(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_rounded(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _group(sensor: SensorFile, group: str) -> Any:
    return sensor.collection if group == "collection" else getattr(sensor.sensor, group)
