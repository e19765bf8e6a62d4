"""Scenes: which arms, sensors and surfaces a task has, and where they stand.

A scene is a YAML file (docs/scenes.md). Only what it names is built, started, simulated and published::

    scene = load_scene("ramp")            # config/scenes/ramp.yaml, or a path
    scene.arms["arm"].T_base_start        # where the sensor starts, in the arm's base
    scene.surfaces["ramp"].make().distance(points)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import named_file
from tactile_base.settings import SettingError, Settings, setting
from tactile_base.yaml_file import Section, read_yaml
from tactile_drivers.shapes import SHAPES
from tactile_drivers.shapes.surface import Surface
from tactile_drivers.sim.arm import ArmSettings
from tactile_drivers.sim.ideal_sensor import IdealSensorSettings
from tactile_filter import se3

Array = NDArray[np.float64]

DRIVERS = ("sim",)
FIDELITIES = ("image", "ideal")
_NAME = re.compile(r"[a-z][a-z0-9_]*")  # a ROS namespace and frame prefix
_POSE_KEYS = ("position", "rotation_deg")


class SceneError(SettingError):
    """A scene that cannot be read or means nothing; the message says file, line and what would be valid."""


@dataclass(frozen=True)
class SensorSettings(Settings):
    """What a scene says of a sensor, besides the settings of its model."""

    fidelity: str = setting(
        "image", choices=FIDELITIES, doc="image: camera image of a soft tip; ideal: no image"
    )
    camera_rate: float = setting(60.0, unit="Hz", lower=1.0, upper=240.0, doc="rate of exposures")
    touches: tuple[str, ...] = setting((), doc="surfaces that it can touch; empty: all of the scene")
    protective_depth: float = setting(
        0.010, unit="m", lower=1e-4, upper=0.1, doc="depth of the tip at which the arm stops in fault"
    )


@dataclass(frozen=True)
class SensorScene:
    """A tactile sensor on an arm.

    Attributes
    ----------
    settings : SensorSettings
    model : Settings of the model, or their groups
        `TacTipSettings` for fidelity "image", `IdealSensorSettings` for "ideal".
    """

    settings: SensorSettings = field(default_factory=SensorSettings)
    model: Any = field(default_factory=IdealSensorSettings)


@dataclass(frozen=True)
class ArmScene:
    """An arm with its driver.

    Attributes
    ----------
    driver : str
        Who drives it; "sim" is simulated.
    T_world_base, T_world_start : ndarray (4, 4)
        The arm's base, and where its sensor starts, in the world.
    T_tool_sensor : ndarray (4, 4)
        The sensor in the arm's tool frame.
    limits : ArmSettings
    sensor : SensorScene or None
        None for an arm that feels nothing.
    """

    name: str
    driver: str
    T_world_base: Array
    T_world_start: Array
    T_tool_sensor: Array
    limits: ArmSettings
    sensor: SensorScene | None

    @property
    def T_base_start(self) -> Array:
        """Where the sensor starts, in the arm's base (4, 4)."""
        return se3.inverse(self.T_world_base) @ self.T_world_start


@dataclass(frozen=True)
class SurfaceScene:
    """A rigid surface, its pose (4, 4) in the world, and the settings of its shape."""

    name: str
    shape: str
    T_world_surface: Array
    parameters: Settings

    def make(self) -> Surface:
        """The surface, in its own frame."""
        return SHAPES.load(self.shape)(self.parameters)

    def T_base_surface(self, arm: ArmScene) -> Array:
        """The surface's frame in the base of an arm (4, 4)."""
        return se3.inverse(arm.T_world_base) @ self.T_world_surface


@dataclass(frozen=True)
class Scene:
    """All that is there.

    Attributes
    ----------
    rate : int
        Steps of the simulation in a second: the arms' poses, and a multiple of every camera's rate (Hz).
    """

    name: str
    path: Path
    description: str
    rate: int
    arms: Mapping[str, ArmScene]
    surfaces: Mapping[str, SurfaceScene]

    def surfaces_of(self, arm: str) -> dict[str, SurfaceScene]:
        """The surfaces that the sensor of an arm can touch, by name."""
        sensor = self.arms[arm].sensor
        if sensor is None:
            return {}
        names = sensor.settings.touches or tuple(self.surfaces)
        return {name: self.surfaces[name] for name in names}

    def with_fidelity(self, fidelity: str, **model: Any) -> Scene:
        """The same scene with all sensors "image" or "ideal", and the model's settings given by name.

        Names are those of the model's settings class; it starts from its defaults where the fidelity changes.
        """
        arms = {}
        for name, arm in self.arms.items():
            sensor = arm.sensor
            if sensor is not None:
                same = sensor.settings.fidelity == fidelity
                base = sensor.model if same else _default_model(fidelity)
                settings = sensor.settings.replaced(fidelity=fidelity)
                sensor = SensorScene(settings, replace(base, **model) if model else base)
            arms[name] = replace(arm, sensor=sensor)
        return replace(self, arms=arms)


def scene_path(name_or_path: str | Path) -> Path:
    """The file of a scene: a path (with .yaml), or the name of one of the packaged scenes.

    Raises `SceneError` with the packaged names if there is none.
    """
    try:
        return named_file("scene", name_or_path)
    except FileNotFoundError as error:
        raise SceneError(str(error)) from error


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a packaged scene by its name, or any by its path.

    Raises
    ------
    SceneError
        With file, line and the valid choices.
    """
    path = scene_path(name_or_path)
    root = read_yaml(path, SceneError)
    root.allow("description", "rate", "arms", "surfaces")
    rate = root.number("rate", 120)
    if rate != int(rate) or not 1 <= rate <= 1000:
        root.fail(f"rate = {rate:g}: must be a whole number of Hz in [1, 1000]", "rate")
    surfaces = {name: _surface(name, section) for name, section in _named(root, "surfaces").items()}
    arms = {
        name: _arm(name, section, int(rate), list(surfaces)) for name, section in _named(root, "arms").items()
    }
    if not arms:
        root.fail("arms: a scene must have at least one")
    return Scene(path.stem, path, root.text("description", ""), int(rate), arms, surfaces)


def _named(root: Section, key: str) -> dict[str, Section]:
    sections = root.sections(key)
    for name in sections:
        if not _NAME.fullmatch(name):
            root.section(key).fail(
                f"{key}: '{name}' must be lower-case letters, digits and _, from a letter", name
            )
    return sections


def _surface(name: str, section: Section) -> SurfaceScene:
    section.allow("shape", "pose", "parameters")
    shape = section.choice("shape", list(SHAPES.names()))
    parameters = section.settings("parameters", SHAPES.load(shape).settings_class)
    return SurfaceScene(name, shape, _pose(section.section("pose")), parameters)


def _arm(name: str, section: Section, rate: int, surfaces: list[str]) -> ArmScene:
    section.allow("driver", "base", "start", "sensor_in_tool", "limits", "sensor")
    section.value("start")  # an arm has to start somewhere: there is no default
    return ArmScene(
        name=name,
        driver=section.choice("driver", DRIVERS, "sim"),
        T_world_base=_pose(section.section("base")),
        T_world_start=_pose(section.section("start")),
        T_tool_sensor=_pose(section.section("sensor_in_tool")),
        limits=section.settings("limits", ArmSettings),
        sensor=_sensor(section.section("sensor"), rate, surfaces) if "sensor" in section.values else None,
    )


def _sensor(section: Section, rate: int, surfaces: list[str]) -> SensorScene:
    section.allow("fidelity", "camera_rate", "touches", "protective_depth", *FIDELITIES)
    section.names("touches", surfaces, ())
    plain = {key: value for key, value in section.values.items() if key not in FIDELITIES}
    settings = section.checked(SensorSettings, plain)
    per_frame = rate / settings.camera_rate
    if per_frame != int(per_frame):
        section.fail(
            f"{section.name}.camera_rate = {settings.camera_rate:g} Hz: "
            f"the scene's rate, {rate} Hz, must be a multiple of it",
            "camera_rate",
        )
    model = (
        _image_model(section)
        if settings.fidelity == "image"
        else section.settings("ideal", IdealSensorSettings)
    )
    return SensorScene(settings, model)


def _image_model(section: Section) -> Any:
    """`TacTipSettings` from the sensor file and the groups under `image`."""
    groups = section.section("image")
    base = _from_sensor_file(groups) if "file" in groups.values else _default_model("image")
    names = [item.name for item in fields(base)]
    groups.allow("file", *names)
    changed = {}
    for name in names:
        if name in groups.values:
            group, settings = groups.section(name), getattr(base, name)
            changed[name] = group.checked(type(settings), {**asdict(settings), **group.values})
    return replace(base, **changed)


def _from_sensor_file(groups: Section) -> Any:
    from tactile_drivers.sim.sensor_file import load_sensor

    try:
        return load_sensor(groups.text("file")).sensor
    except FileNotFoundError as error:
        groups.fail(str(error), "file")


def _default_model(fidelity: str) -> Any:
    if fidelity == "ideal":
        return IdealSensorSettings()
    # here, since it needs the compiled contact solver, which a scene without images does without
    from tactile_drivers.sim.tactip import TacTipSettings

    return TacTipSettings()


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
