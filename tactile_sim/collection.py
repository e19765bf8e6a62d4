"""Labelled samples of surface contact poses: the paper's sampling rules and its two-step motion, simulated.

The sensor turns to its contact angles above a plane, presses along the normal to a depth, then shears in the
plane ("Data Collection" in the paper). Friction and errors of the arm's pose differ from sample to sample, so
that what is trained on them does not rely on one friction or on a perfect arm. A sample depends only on the
settings, the seed and its index: a run that was interrupted goes on with the indices that are missing::

    for sample in generate(CollectionSettings(), seed=1, indices=range(6000)):
        ...

With an `EdgeSampling` contacts are on the edge of a plate.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import named_file
from tactile_base.settings import setting
from tactile_base.yaml_file import read_yaml
from tactile_geometry import se3
from tactile_scene.sampling import (
    EdgeSampling,
    SamplingSettings,
    check_ordered,
    contact_poses,
    sample_pose,
    sample_rng,
)
from tactile_scene.shapes.box import Box, BoxSettings
from tactile_scene.shapes.plane import Plane
from tactile_scene.simulated_sensors import TacTipSettings
from tactile_scene.simulation import read_sensor_groups
from tactile_sim.tactip import ContactTruth, TacTip
from tactile_sim.variation import VariationSettings, varied

Array = NDArray[np.float64]
_FLAT = 1e-6  # 1/m: as good as a plane
_SCALE = np.array([1e-3] * 3 + [np.pi / 180] * 3)  # mm and degrees to m and rad
_PLATE = BoxSettings(size=(0.2, 0.2, 0.05), rounding=2e-4)  # far wider than a contact, milled


@dataclass(frozen=True)
class CollectionSettings(SamplingSettings):
    """Ranges of the samples, and what differs between them that no label tells."""

    friction: tuple[float, ...] = setting(
        (0.6, 1.2), lower=0.0, upper=5.0, length=2, doc="least and largest friction"
    )
    curvature: tuple[float, ...] = setting(
        (0.0, 0.0), unit="1/m", lower=-20.0, upper=40.0, length=2,
        doc="least and largest curvature of the surface, a sphere: positive is convex, 0 the paper's plane",
    )  # fmt: skip
    position_noise: float = setting(
        5e-5, unit="m", lower=0.0, upper=0.01, doc="of the arm, per axis (1 sigma)"
    )
    angle_noise: float = setting(2e-3, unit="rad", lower=0.0, upper=0.2, doc="of the arm, per axis (1 sigma)")
    depth_offset: float = setting(
        0.0, unit="m", lower=-5e-3, upper=5e-3, doc="of the true depth over the label's: a zero set by hand"
    )
    surface_tilt: tuple[float, ...] = setting(
        (0.0, 0.0), unit="rad", lower=-0.2, upper=0.2, length=2,
        doc="of the true surface against the labels' plane, about its x and y through the contact",
    )  # fmt: skip
    tool_offset: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), unit="m", lower=-0.02, upper=0.02, length=3,
        doc="of the tool centre point, about which the arm turns, from the dome's centre, in {s}",
    )  # fmt: skip
    clearance: float = setting(1e-3, unit="m", lower=0.0, upper=0.05, doc="gap from which the sensor starts")
    max_step: float = setting(2.5e-4, unit="m", lower=1e-6, upper=0.002, doc="longest step of the motion")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ordered(self, "friction", "curvature")


@dataclass(frozen=True)
class SensorFile:
    """What a file of `config/sensors` says; without one, the defaults.

    It has the groups of `TacTipSettings` (skin, contact, markers, camera, light), and for data sets
    `collection` (the rig: errors of its arm, friction), `variation` (how images differ) and `preprocessing`;
    all optional.
    """

    sensor: TacTipSettings = field(default_factory=TacTipSettings)
    collection: CollectionSettings = field(default_factory=CollectionSettings)
    variation: VariationSettings | None = None


def load_sensor(name_or_path: str | Path) -> SensorFile:
    """A sensor of `config/sensors` by its name, or any sensor file by its path.

    Raises
    ------
    FileNotFoundError
        With the names there are.
    SettingError
        With file and line of what is wrong.
    """
    root = read_yaml(named_file("sensor", name_or_path))
    return SensorFile(
        read_sensor_groups(root),
        root.settings("collection", CollectionSettings),
        root.settings("variation", VariationSettings) if "variation" in root.values else None,
    )


@dataclass(frozen=True)
class Sample:
    """One labelled image.

    Attributes
    ----------
    index : int
    image : (height, width) uint8
    markers : (n, 2)
        Where the markers are in it: column, row.
    euler_mm_deg : (6,)
        The label: commanded surface contact pose (x, y, z, alpha, beta, gamma) of X_fs, mm and degrees.
    truth : ContactTruth
        What the simulation knows, slip and equivalent shear included.
    friction : float
    """

    index: int
    image: NDArray[np.uint8]
    markers: Array
    euler_mm_deg: Array
    truth: ContactTruth
    friction: float


class Sphere:
    """A sphere of signed radius 1 / curvature that touches the plane z = 0 at the origin, from below."""

    def __init__(self, curvature: float) -> None:
        self._radius = 1.0 / curvature

    def query(self, points: Array) -> tuple[Array, Array]:
        from_center = points + np.array([0.0, 0.0, self._radius])
        distance = np.linalg.norm(from_center, axis=1)
        sign = math.copysign(1.0, self._radius)
        return sign * (distance - abs(self._radius)), sign * from_center / distance[:, None]


class Edge:
    """The edge along x of a plate, whose top is the plane z = 0 on the side of negative y."""

    _box = Box(_PLATE)
    _corner = np.array([0.0, _PLATE.size[1] / 2, _PLATE.size[2] / 2])

    def query(self, points: Array) -> tuple[Array, Array]:
        return self._box.query(points + self._corner)


def collect(
    sensor: TacTip, settings: CollectionSettings, seed: int, index: int,
    variation: VariationSettings | None = None, edge: EdgeSampling | None = None,
) -> Sample:  # fmt: skip
    """Collect sample `index` with a sensor, whose contact history is forgotten first."""
    rng = sample_rng(seed, index)
    pose = sample_pose(settings, rng)
    noise = rng.normal(size=6) * np.repeat([settings.position_noise, settings.angle_noise], 3)
    noise[2] += settings.depth_offset
    friction = rng.uniform(settings.friction[0], settings.friction[1])
    sensor.reset(seed=int(rng.integers(2**63)))
    sensor.friction = friction
    least, largest = settings.curvature
    curvature, mounting = float(rng.uniform(least, largest)), Mounting.of(settings)
    if edge is None:
        press_then_shear(sensor, pose + noise, settings.clearance, curvature, mounting)
    else:
        pressed, pose = contact_poses(settings, edge, seed, index)
        press_on_edge(sensor, pressed + noise, pose + noise, settings.clearance, mounting)
    image, markers, truth = sensor.image(), sensor.marker_pixels, sensor.truth()
    if variation is not None:
        image, markers = varied(image, markers, variation, truth.depth, rng)
    return Sample(index, image, markers, pose / _SCALE, truth, friction)


@dataclass(frozen=True)
class Mounting:
    """Errors of a rig that are the same in all of its samples: what it calls the pose, and where it is.

    Attributes
    ----------
    T_tilt : (4, 4)
        Turns the sensor about the contact point, as a surface that is tilted the other way would.
    T_center : (4, 4)
        The dome's centre in the frame of the tool centre point.
    """

    T_tilt: Array
    T_center: Array

    @classmethod
    def of(cls, settings: CollectionSettings) -> Mounting | None:
        """From `surface_tilt` and `tool_offset`; None where both are zero."""
        if not any((*settings.surface_tilt, *settings.tool_offset)):
            return None
        tilt = se3.pose_from_euler([0.0, 0.0, 0.0, *settings.surface_tilt, 0.0])
        return cls(tilt, se3.pose_from_euler([*(-np.array(settings.tool_offset)), 0.0, 0.0, 0.0]))

    def place(self, T_surface_tool: Array) -> Array:
        """Where the sensor is (4, 4) when the arm means T; at no tilt the depth is as meant."""
        T = T_surface_tool.copy()
        T[2, 3] += self.T_center[2, 3]
        return np.asarray(self.T_tilt @ T @ self.T_center)


def press_then_shear(
    sensor: TacTip, pose: Array, clearance: float = 1e-3, curvature: float = 0.0,
    mounting: Mounting | None = None,
) -> None:  # fmt: skip
    """Bring a sensor to a surface contact pose (6,), m and rad: turned, pressed, then sheared.

    The surface is a plane, or a sphere of that `curvature` in 1/m, along which the shear then runs. With a
    `mounting` the pose is what the arm means.
    """
    surface = Plane() if abs(curvature) < _FLAT else Sphere(curvature)

    def move(T: Array) -> None:
        sensor.advance(surface, T if mounting is None else mounting.place(T))

    x, y, z, alpha, beta, gamma = pose
    T_surface_f = _contact_frame(sensor)
    for depth in (-clearance, z):
        move(T_surface_f @ se3.pose_from_euler([0.0, 0.0, depth, alpha, beta, 0.0]))
    turned = T_surface_f @ se3.pose_from_euler([0.0, 0.0, z, alpha, beta, gamma])
    move(along_surface(x, -y, curvature) @ turned)


def press_on_edge(
    sensor: TacTip, pressed: Array, sheared: Array, clearance: float = 1e-3, mounting: Mounting | None = None
) -> None:
    """Bring a sensor to surface contact poses (6,) on an `Edge`, m and rad: pressed, then sheared.

    x of {f} is along the edge, y over the plate.
    """
    T_surface_f = _contact_frame(sensor)
    edge = Edge()  # one for all steps: what was touched on another one is forgotten
    above = pressed.copy()
    above[2] = -clearance
    for pose in (above, pressed, sheared):
        T = T_surface_f @ se3.pose_from_euler(pose)
        sensor.advance(edge, T if mounting is None else mounting.place(T))


def _contact_frame(sensor: TacTip) -> Array:
    """T_surface_f (4, 4): {f} has z into the surface, its origin at the dome's centre at first touch."""
    return se3.pose_from_euler([0.0, 0.0, sensor.settings.skin.radius, np.pi, 0.0, 0.0])


def along_surface(x: float, y: float, curvature: float) -> Array:
    """Motion (4, 4) that carries the surface's origin by x, y along it: a turn about a sphere's centre."""
    if abs(curvature) < _FLAT:
        return se3.pose_from_euler([x, y, 0.0, 0.0, 0.0, 0.0])
    phi = np.array([-curvature * y, curvature * x, 0.0])
    centre = np.array([0.0, 0.0, -1.0 / curvature])
    return se3.exp(np.concatenate([np.cross(centre, phi), phi]))


@dataclass(frozen=True)
class Collector:
    """Makes the sample of an index; can be sent to other processes, and called by several threads.

    Attributes
    ----------
    settings, seed
        What, with an index, determines a sample.
    sensors
        The sensors, which take turns; their step is replaced by that of `settings`.
    variation
        How the images differ from those of an exactly known sensor; None: not at all.
    edge
        Where contacts on an edge lie; None: they are on a surface.
    """

    settings: CollectionSettings
    seed: int
    sensors: tuple[TacTipSettings, ...] = (TacTipSettings(),)
    variation: VariationSettings | None = None
    edge: EdgeSampling | None = None

    def __call__(self, index: int) -> Sample:
        if getattr(_of_thread, "collector", None) is not self:
            _of_thread.collector, _of_thread.sensors = self, {}
        number = index % len(self.sensors)
        if number not in _of_thread.sensors:
            sensor = self.sensors[number]
            contact = sensor.contact.replaced(max_step=self.settings.max_step)
            _of_thread.sensors[number] = TacTip(replace(sensor, contact=contact))
        return collect(_of_thread.sensors[number], self.settings, self.seed, index, self.variation, self.edge)


_of_thread = threading.local()  # a sensor has a history


def generate(settings: CollectionSettings, seed: int, indices: Iterable[int]) -> Iterator[Sample]:
    """Samples at `indices` of the built-in sensor, in that order."""
    return map(Collector(settings, seed), indices)
