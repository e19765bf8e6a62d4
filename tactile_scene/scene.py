"""Scenes: what stands in a cell: arms with their drivers, sensors with their cameras, and bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_base.yaml_file import Section
from tactile_geometry import se3
from tactile_scene.arm_settings import ArmLimits, Box, SafetySettings, TrackingSettings
from tactile_scene.kinematics.chain import Chain
from tactile_scene.shapes import SHAPES
from tactile_scene.shapes.surface import Surface
from tactile_scene.simulation import Simulation

Array = NDArray[np.float64]

SIM = "sim"  # driven or exposed by the simulated cell
EXTERNAL = "external"  # somebody else's driver or camera, which runs already


@dataclass(frozen=True)
class SensorSettings(Settings):
    """What a scene says of a tactile sensor, besides where it is and who drives its camera."""

    tip_radius: float = setting(0.020, unit="m", lower=1e-3, upper=0.1, doc="of the hemispherical tip")
    camera_rate: float = setting(60.0, unit="Hz", lower=1.0, upper=240.0, doc="rate of exposures")
    model: str = setting(
        "", doc="its own model (.onnx), seen from the scene's folder; empty: the shipped one"
    )
    touches: tuple[str, ...] = setting(
        (), doc="bodies that it can touch; empty: all but what its arm carries"
    )
    protective_depth: float = setting(
        0.010, unit="m", lower=1e-4, upper=0.03, doc="depth of the tip at which the arm stops in fault"
    )
    protective_force: float = setting(
        0.0, unit="N", lower=0.0, upper=1000.0,
        doc="force on the sensor, where the network tells it, from which on the arm goes no further along "
        "the sensor's z; 0: any",
    )  # fmt: skip
    force_sensor: bool = setting(
        False,
        doc="whether a force sensor between tool and tactile sensor says what it measures "
        "(`force_sensor/wrench`): collected contacts are then labelled with forces",
    )
    time_offset: float = setting(
        0.0, unit="s", lower=-0.5, upper=0.5,
        doc="added to the stamps of the camera, so that they are those of the exposures on the arm's clock",
    )  # fmt: skip


@dataclass(frozen=True)
class SensorScene:
    """A tactile sensor on an arm.

    Attributes
    ----------
    settings : SensorSettings
    T_tool_sensor : ndarray (4, 4)
        The sensor frame, at the centre of the dome, in the arm's tool frame.
    camera : str
        Who exposes it: `SIM`, `EXTERNAL`, or a name of `CAMERAS`.
    camera_settings : Section
        What the camera's driver wants; it is checked when the driver is loaded.
    """

    settings: SensorSettings
    T_tool_sensor: Array
    camera: str
    camera_settings: Section = field(compare=False)


@dataclass(frozen=True)
class ArmScene:
    """An arm with its driver.

    Attributes
    ----------
    driver : str
        Who drives it: `SIM`, `EXTERNAL`, or a name of `ARMS`.
    driver_settings : Section
        What the driver wants; it is checked when the driver is loaded.
    T_world_base, T_world_start : ndarray (4, 4)
        The arm's base, and where its controlled frame starts, in the world.
    limits : ArmLimits
    safety : SafetySettings
    keep_out : tuple of Box
        Where the tip must not go, in the arm's base.
    sensor : SensorScene or None
        None for an arm that feels nothing.
    kinematics : Chain or None
        From the base to the controlled frame; None where they are not known.
    tracking : TrackingSettings
        How well the arm does what it is told.
    """

    name: str
    driver: str
    driver_settings: Section = field(compare=False)
    T_world_base: Array
    T_world_start: Array
    limits: ArmLimits
    safety: SafetySettings
    keep_out: tuple[Box, ...]
    sensor: SensorScene | None
    kinematics: Chain | None = field(default=None, compare=False)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)

    @property
    def controlled_frame(self) -> str:
        """What twists move and poses tell: "tactile_sensor", or "tool" for an arm without one."""
        return "tool" if self.sensor is None else "tactile_sensor"

    @property
    def T_tool_controlled(self) -> Array:
        """The controlled frame in the tool frame (4, 4)."""
        return np.eye(4) if self.sensor is None else self.sensor.T_tool_sensor

    @property
    def T_base_start(self) -> Array:
        """Where the controlled frame starts, in the arm's base (4, 4)."""
        return se3.inverse(self.T_world_base) @ self.T_world_start

    def out_of_bounds(self, position: ArrayLike) -> str:
        """Why the controlled frame's origin may not be there, (3,) m in the base; empty where it may."""
        p = np.asarray(position, dtype=np.float64)
        if reason := self.safety.outside(p, self.name):
            return reason
        radius = self.sensor.settings.tip_radius if self.sensor is not None else 0.0
        for box in self.keep_out:
            if se3.norm(np.clip(p, box.lower, box.upper) - p) < max(radius, 1e-9):
                where = f"({', '.join(f'{value:g}' for value in p)}) m"
                return f"{where} is in '{box.name}', which '{self.name}' is kept out of, or too near"
        return ""

    @property
    def simulated_sensor(self) -> bool:
        """Whether the simulated cell exposes its sensor."""
        return self.sensor is not None and self.sensor.camera == SIM


@dataclass(frozen=True)
class BodyScene:
    """A rigid body: its shape, where it is, and how it moves.

    Attributes
    ----------
    T_parent_body : ndarray (4, 4)
        In the tool of the arm that carries it, else in the world, where it starts.
    carried_by : str
        Name of that arm, with which it moves at least as long as nothing else happens; empty for none.
    motion : str
        A name of `MOTIONS`.
    motion_settings : Section
        What the motion wants; it is checked when the cell is built.
    """

    name: str
    shape: str
    parameters: Settings
    T_parent_body: Array
    carried_by: str
    motion: str
    motion_settings: Section = field(compare=False)

    def make(self) -> Surface:
        """The surface, in the body's own frame."""
        return SHAPES.load(self.shape)(self.parameters)


@dataclass(frozen=True)
class Scene:
    """All that is there.

    Attributes
    ----------
    simulation : Simulation
        How it is simulated, as far as it is.
    goals_of : str
        The scene whose goals it takes in task files that do not name it; empty: none.
    """

    name: str
    path: Path
    description: str
    arms: Mapping[str, ArmScene]
    bodies: Mapping[str, BodyScene]
    simulation: Simulation
    goals_of: str = ""

    @property
    def is_simulated(self) -> bool:
        """Whether any arm is driven, or any sensor exposed, by the simulated cell."""
        return any(arm.driver == SIM or arm.simulated_sensor for arm in self.arms.values())

    def gives_images(self, arm: str) -> bool:
        """Whether the arm has a sensor with a camera; a simulated one may give estimates itself."""
        scene = self.arms[arm]
        without = scene.simulated_sensor and not self.simulation.sensors[arm].gives_images
        return scene.sensor is not None and not without

    def bodies_of(self, arm: str) -> dict[str, BodyScene]:
        """The bodies that the sensor of an arm can touch, by name."""
        sensor = self.arms[arm].sensor
        if sensor is None:
            return {}
        own = {name for name, body in self.bodies.items() if body.carried_by == arm}
        names = sensor.settings.touches or [name for name in self.bodies if name not in own]
        return {name: self.bodies[name] for name in names}

    def T_controlled_sensor(self, arm: str) -> Array:
        """Where an arm's sensor is in truth, (4, 4), in the frame that is controlled as the sensor's.

        The identity, unless a simulated one stands elsewhere in its tool (`SimulatedSensor.in_tool`).
        """
        simulated = self.simulation.sensors.get(arm)
        if simulated is None or not simulated.in_tool:
            return np.eye(4)
        return se3.inverse(self.arms[arm].T_tool_controlled) @ se3.pose_from_euler(simulated.in_tool)

    def T_world_body(self, body: str) -> Array:
        """Where a body is at the start, in the world (4, 4)."""
        scene = self.bodies[body]
        if not scene.carried_by:
            return scene.T_parent_body
        arm = self.arms[scene.carried_by]
        return arm.T_world_start @ se3.inverse(arm.T_tool_controlled) @ scene.T_parent_body

    def T_base_body(self, arm: str, body: str) -> Array:
        """Where a body is at the start, in the base of an arm (4, 4)."""
        return se3.inverse(self.arms[arm].T_world_base) @ self.T_world_body(body)

    def model_file(self, arm: str) -> Path | None:
        """The model of the arm's own sensor; None for the shipped one."""
        sensor = self.arms[arm].sensor
        return self.path.parent / sensor.settings.model if sensor and sensor.settings.model else None

    def with_fidelity(self, fidelity: str, **model: Any) -> Scene:
        """A copy with all simulated sensors of a fidelity, and their model's settings by name.

        Names are those of the model's settings class; it starts from its defaults where the model changes.
        """
        sensors = {
            name: sensor.changed(fidelity, **model) for name, sensor in self.simulation.sensors.items()
        }
        return with_simulated_tips(replace(self, simulation=replace(self.simulation, sensors=sensors)))


def with_simulated_tips(scene: Scene) -> Scene:
    """The scene with the tip's radius of each simulated sensor that of its model."""
    arms = dict(scene.arms)
    for name, simulated in scene.simulation.sensors.items():
        arm = arms[name]
        if arm.simulated_sensor and arm.sensor is not None:
            settings = arm.sensor.settings.replaced(tip_radius=simulated.tip_radius)
            arms[name] = replace(arm, sensor=replace(arm.sensor, settings=settings))
    return replace(scene, arms=arms)
