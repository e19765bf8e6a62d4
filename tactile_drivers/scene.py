"""Scenes: what stands in a cell: arms with their drivers, sensors with their cameras, and bodies.

A scene is a YAML file (docs/scenes.md). Only what it names is built, started, simulated and published::

    scene = load_scene("ramp")            # config/scenes/ramp.yaml, or a path
    scene.arms["arm"].T_base_start        # where the arm's controlled frame starts, in its base
    scene.bodies["ramp"].make().distance(points)
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.config_paths import named_file
from tactile_base.registry import Registry
from tactile_base.settings import SettingError, Settings, setting
from tactile_base.yaml_file import Section, read_yaml
from tactile_drivers.arm import ARMS, ArmLimits, Box, SafetySettings
from tactile_drivers.camera import CAMERAS, ExternalCameraSettings
from tactile_drivers.external import check_external
from tactile_drivers.kinematics.arm_file import load_arm
from tactile_drivers.kinematics.chain import Chain
from tactile_drivers.shapes import SHAPES
from tactile_drivers.shapes.surface import Surface
from tactile_drivers.sim.motions import CARRIED, FIXED, MOTIONS
from tactile_drivers.sim.simulation import Simulation, read_simulation
from tactile_drivers.tracking import TrackingSettings
from tactile_geometry import se3

Array = NDArray[np.float64]

SIM = "sim"  # driven or exposed by the simulated cell
EXTERNAL = "external"  # somebody else's driver or camera, which runs already
_NAME = re.compile(r"[a-z][a-z0-9_]*")  # a ROS namespace and frame prefix
_POSE_KEYS = ("position", "rotation_deg")
_ARM_KEYS = (
    "driver", "driver_settings", "base", "start", "limits", "safety", "tracking", "keep_out", "sensor",
    "kinematics",
)  # fmt: skip


class SceneError(SettingError):
    """A scene that cannot be read or means nothing; the message says file, line and what would be valid."""


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
        """The same scene with all simulated sensors of a fidelity, and their model's settings by name.

        Names are those of the model's settings class; it starts from its defaults where the model changes.
        """
        sensors = {
            name: sensor.changed(fidelity, **model) for name, sensor in self.simulation.sensors.items()
        }
        return _with_tips(replace(self, simulation=replace(self.simulation, sensors=sensors)))


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a packaged scene by its name, or any by its path.

    Raises
    ------
    SceneError
        With file, line and the valid choices.
    """
    try:
        path = named_file("scene", name_or_path)
    except FileNotFoundError as error:
        raise SceneError(str(error)) from error
    root = read_yaml(path, SceneError)
    root.allow("description", "goals_of", "arms", "bodies", "simulation")
    arm_sections, body_sections = _named(root, "arms"), _named(root, "bodies")
    if not arm_sections:
        root.fail("arms: a scene must have at least one")
    bodies = {name: _body(name, section, list(arm_sections)) for name, section in body_sections.items()}
    arms = {name: _arm(name, section, bodies) for name, section in arm_sections.items()}
    with_sensor = [name for name, arm in arms.items() if arm.sensor is not None]
    simulation = read_simulation(root.section("simulation"), with_sensor)
    simulation = _with_radii(simulation, arms, arm_sections)
    for name, arm in arms.items():
        if arm.simulated_sensor:
            _check_rate(arm, simulation.rate, arm_sections[name].section("sensor"))
    description, goals_of = root.text("description", ""), root.text("goals_of", "")
    scene = Scene(path.stem, path, description, arms, bodies, simulation, goals_of)
    return _with_tips(scene)


def _named(root: Section, key: str) -> dict[str, Section]:
    sections = root.sections(key)
    for name in sections:
        if not _NAME.fullmatch(name):
            root.section(key).fail(
                f"{key}: '{name}' must be lower-case letters, digits and _, from a letter", name
            )
    return sections


def _registered(
    section: Section, key: str, registry: Registry[Any], more: tuple[str, ...] = (), default: str = ""
) -> str:
    """A name of a registry, or one `more`; packages are searched only for a name that is not ours."""
    if section.values.get(key, default) in more:
        return section.choice(key, more, default)
    names = list(dict.fromkeys((*more, *registry.names())))
    return section.choice(key, names, default) if default else section.choice(key, names)


def _body(name: str, section: Section, arms: Iterable[str]) -> BodyScene:
    section.allow("shape", "parameters", "pose", "carried_by", "motion", "motion_settings")
    shape = _registered(section, "shape", SHAPES)
    parameters = section.settings("parameters", SHAPES.load(shape).settings_class)
    carried_by = section.choice("carried_by", list(arms), "") if "carried_by" in section.values else ""
    motion = _registered(section, "motion", MOTIONS, (FIXED, CARRIED), CARRIED if carried_by else FIXED)
    if (motion == CARRIED and not carried_by) or (motion == FIXED and carried_by):
        who = "needs" if motion == CARRIED else "cannot have"
        section.fail(f"{section.name}: a body whose motion is '{motion}' {who} carried_by", "motion")
    pose = _pose(section.section("pose"))
    return BodyScene(name, shape, parameters, pose, carried_by, motion, section.section("motion_settings"))


def _arm(name: str, section: Section, bodies: Mapping[str, BodyScene]) -> ArmScene:
    section.allow(*_ARM_KEYS)
    section.value("start")  # an arm has to start somewhere: there is no default
    driver = _registered(section, "driver", ARMS, (SIM, EXTERNAL), SIM)
    _check_no_settings(section, "driver", driver)
    safety = section.settings("safety", SafetySettings)
    if not np.less(safety.workspace_lower, safety.workspace_upper).all():
        section.fail(f"{section.name}.safety: workspace_lower must be below workspace_upper", "safety")
    if not safety.singularity_stop < safety.singularity_slow:
        section.fail(f"{section.name}.safety: singularity_stop must be below singularity_slow", "safety")
    sensor = _sensor(section.section("sensor"), name, driver, bodies) if "sensor" in section.values else None
    known = "kinematics" in section.values
    kinematics = _kinematics(section.section("kinematics"), sensor) if known else None
    if driver == EXTERNAL:
        check_external(section, None if kinematics is None else kinematics.names)
    return ArmScene(
        name=name,
        driver=driver,
        driver_settings=section.section("driver_settings"),
        T_world_base=_pose(section.section("base")),
        T_world_start=_pose(section.section("start")),
        limits=section.settings("limits", ArmLimits),
        safety=safety,
        tracking=section.settings("tracking", TrackingSettings),
        keep_out=tuple(_box(name, box) for name, box in section.sections("keep_out").items()),
        sensor=sensor,
        kinematics=kinematics,
    )


def _kinematics(section: Section, sensor: SensorScene | None) -> Chain:
    """The chain of a known arm to the controlled frame, with capsules from flange to tool and to tip."""
    section.allow("description", "tool", "tool_radius", "ready_deg")
    name = section.text("description")
    is_path = name.endswith((".yaml", ".yml"))
    try:
        chain = load_arm(section.path.parent / name if is_path else name)
    except SettingError as error:
        section.fail(f"{section.name}.description: {error}", "description")
    if "ready_deg" in section.values:
        chain = replace(chain, ready=np.radians(section.numbers("ready_deg", len(chain.names))))
        if beyond := chain.out_of_range(chain.ready):
            section.fail(f"{section.name}.ready_deg: {beyond}", "ready_deg")
    radius = section.number("tool_radius", 0.035)
    if radius <= 0.0:
        section.fail(f"{section.name}.tool_radius = {radius:g} m: must be above 0", "tool_radius")
    T_tool = _pose(section.section("tool"))
    T_end = T_tool if sensor is None else T_tool @ sensor.T_tool_sensor
    parts = [(np.zeros(3), T_tool[:3, 3], radius)]
    if sensor is not None:  # it ends where the tip does, which is round with a radius of its own
        front = T_end[:3, 3] + (sensor.settings.tip_radius - radius) * T_end[:3, 2]
        parts.append((T_tool[:3, 3], front, radius))
    return chain.with_tool(T_end, *parts)


def _box(name: str, section: Section) -> Box:
    section.allow("lower", "upper")
    lower, upper = (np.array(section.numbers(key, 3)) for key in ("lower", "upper"))
    if not (lower < upper).all():
        section.fail(f"{section.name}: lower must be below upper in x, y and z", "lower")
    return Box(name, lower, upper)


def _sensor(section: Section, arm: str, driver: str, bodies: Mapping[str, BodyScene]) -> SensorScene:
    apart = ("in_tool", "camera", "camera_settings")
    plain = {key: value for key, value in section.values.items() if key not in apart}
    touchable = [name for name, body in bodies.items() if body.carried_by != arm]
    section.names("touches", touchable, ())
    settings = section.checked(SensorSettings, plain)
    camera = _registered(section, "camera", CAMERAS, (SIM, EXTERNAL), SIM if driver == SIM else EXTERNAL)
    if camera == SIM and settings.time_offset > 0.0:
        section.fail(
            f"{section.name}.time_offset = {settings.time_offset:g} s: a simulated camera has no frames from "
            "the future; must be at most 0",
            "time_offset",
        )
    if camera == SIM and driver != SIM:
        section.fail(f"{section.name}.camera: '{SIM}' needs an arm whose driver is '{SIM}' too", "camera")
    if camera == EXTERNAL:
        section.settings("camera_settings", ExternalCameraSettings)
    else:
        _check_no_settings(section, "camera", camera)
    pose = _pose(section.section("in_tool"))
    return SensorScene(settings, pose, camera, section.section("camera_settings"))


def _check_no_settings(section: Section, kind: str, name: str) -> None:
    key = f"{kind}_settings"
    if name == SIM and section.section(key).values:
        section.fail(f"{section.name}.{key}: {kind} '{name}' has none", key)


def _check_rate(arm: ArmScene, rate: int, section: Section) -> None:
    assert arm.sensor is not None
    camera_rate = arm.sensor.settings.camera_rate
    if rate / camera_rate != int(rate / camera_rate):
        section.fail(
            f"{section.name}.camera_rate = {camera_rate:g} Hz: "
            f"the simulation's rate, {rate} Hz, must be a multiple of it",
            "camera_rate",
        )


def _with_radii(
    simulation: Simulation, arms: Mapping[str, ArmScene], sections: Mapping[str, Section]
) -> Simulation:
    """The simulated sensors with the tips that the scene says."""
    sensors = dict(simulation.sensors)
    default = SensorSettings().tip_radius
    for name, sensor in simulation.sensors.items():
        section, scene = sections[name].section("sensor"), arms[name].sensor
        if scene is None or "tip_radius" not in section.values:
            continue
        radius = scene.settings.tip_radius
        if sensor.tip_radius not in (default, radius):
            section.fail(
                f"{section.name}.tip_radius = {radius:g} m: the section simulation gives this sensor "
                f"a tip of {sensor.tip_radius:g} m; leave one of the two out",
                "tip_radius",
            )
        sensors[name] = sensor.with_tip_radius(radius)
    return replace(simulation, sensors=sensors)


def _with_tips(scene: Scene) -> Scene:
    """The scene with the tip's radius of each simulated sensor that of its model."""
    arms = dict(scene.arms)
    for name, simulated in scene.simulation.sensors.items():
        arm = arms[name]
        if arm.simulated_sensor and arm.sensor is not None:
            settings = arm.sensor.settings.replaced(tip_radius=simulated.tip_radius)
            arms[name] = replace(arm, sensor=replace(arm.sensor, settings=settings))
    return replace(scene, arms=arms)


def _pose(section: Section) -> Array:
    """`position` (m) and `rotation_deg` (extrinsic xyz) of the frame in its parent."""
    section.allow(*_POSE_KEYS)
    x, y, z = np.radians(section.numbers("rotation_deg", 3, (0.0, 0.0, 0.0)))
    T = np.eye(4)
    T[:3, 3] = section.numbers("position", 3, (0.0, 0.0, 0.0))
    T[:3, :3] = _turn(2, z) @ _turn(1, y) @ _turn(0, x)
    return T


def _turn(axis: int, angle: float) -> Array:
    """Rotation about a coordinate axis, exact at multiples of 90 degrees."""
    quarter = round(angle / (np.pi / 2))
    exact = np.isclose(angle, quarter * np.pi / 2, rtol=0, atol=1e-12)
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter % 4] if exact else (np.cos(angle), np.sin(angle))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = cos, -sin, sin, cos
    return R
