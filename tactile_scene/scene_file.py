"""Scene files: a scene is a YAML file (docs/scenes.md), of which only what it names is built and started.

scene = load_scene("ramp")            # config/scenes/ramp.yaml, or a path
scene.arms["arm"].T_base_start        # where the arm's controlled frame starts, in its base
scene.bodies["ramp"].make().distance(points)
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import named_file
from tactile_base.registry import Registry
from tactile_base.settings import SettingError
from tactile_base.yaml_file import Section, read_yaml
from tactile_scene.arm import ARMS
from tactile_scene.arm_settings import ArmLimits, Box, SafetySettings, TrackingSettings
from tactile_scene.camera import CAMERAS, ExternalCameraSettings
from tactile_scene.external_settings import check_external
from tactile_scene.kinematics.arm_file import load_arm
from tactile_scene.kinematics.chain import Chain
from tactile_scene.motions import CARRIED, FIXED, MOTIONS
from tactile_scene.scene import (
    EXTERNAL,
    SIM,
    ArmScene,
    BodyScene,
    Scene,
    SensorScene,
    SensorSettings,
    with_simulated_tips,
)
from tactile_scene.shapes import SHAPES
from tactile_scene.simulation import Simulation, read_simulation

Array = NDArray[np.float64]

_NAME = re.compile(r"[a-z][a-z0-9_]*")  # a ROS namespace and frame prefix
_POSE_KEYS = ("position", "rotation_deg")
_ARM_KEYS = (
    "driver", "driver_settings", "base", "start", "limits", "safety", "tracking", "keep_out", "sensor",
    "kinematics",
)  # fmt: skip


class SceneError(SettingError):
    """A scene that cannot be read or means nothing; the message says file, line and what would be valid."""


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
    return with_simulated_tips(scene)


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
