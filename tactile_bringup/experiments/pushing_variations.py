"""What a trial of pushing is made of, and what can be set in it apart from its own random draw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tactile_base.settings import SettingError, shown, unknown_name
from tactile_bringup.offline import OfflineOptions
from tactile_control.task_file import Task
from tactile_filter.filter_settings import load_filter_settings
from tactile_geometry import se3
from tactile_scene.scene import Scene
from tactile_scene.simulated_sensors import IdealSensorSettings, TacTipSettings
from tactile_scene.simulation import SimulatedSensor
from tactile_sim.pushing_scene import MOTION, PushedProfiles, PushVariation, pushing_scene

Value = float | str

DEG = np.pi / 180.0


@dataclass(frozen=True)
class Setup:
    """A trial before its object is put into the scene.

    Attributes
    ----------
    scene : Scene
        With sensors of the fidelity that is wanted.
    object, floor : names of `profiles`
    variation : PushVariation
        What is drawn, by the trial's seed, `options.seed`.
    """

    scene: Scene
    task: Task
    options: OfflineOptions
    object: str
    floor: str
    profiles: PushedProfiles
    variation: PushVariation

    def pushing_scene(self) -> Scene:
        """The scene of the trial."""
        return pushing_scene(
            self.scene, self.object, self.floor, self.options.seed, self.variation, self.profiles
        )


def drawn(scene: Scene) -> dict[str, float]:
    """What differs from trial to trial in a scene of pushing: numbers for the trial's row."""
    body = next(body for body in scene.bodies.values() if body.motion == MOTION)
    start = next(iter(scene.arms.values())).T_world_start
    settings, T = body.motion_settings.values, body.T_parent_body
    across = np.cross([0.0, 0.0, 1.0], start[:3, 2])
    return {
        "friction": float(settings["friction"]),
        "mass_kg": float(settings["mass"]),
        "center_of_friction_x_mm": 1e3 * float(settings["center_of_friction"][0]),
        "center_of_friction_y_mm": 1e3 * float(settings["center_of_friction"][1]),
        "offset_mm": 1e3 * float(across @ (T[:3, 3] - start[:3, 3])),
        "angle_deg": float(np.degrees(np.arctan2(T[1, 0], T[0, 0]))),
    }


def varied(setup: Setup, values: Sequence[tuple[str, Value]]) -> Setup:
    """The setup with each of these variables set; `SettingError` for an unknown one or a wrong value."""
    for name, value in values:
        if name not in VARIABLES:
            raise SettingError(f"variable: {unknown_name(name, list(VARIABLES))}")
        if isinstance(value, str) != (name == "filter"):
            raise SettingError(
                f"{name} = {shown(value)}: must be a {'name' if name == 'filter' else 'number'}"
            )
        setup = VARIABLES[name].change(setup, value)
    return setup


@dataclass(frozen=True)
class Variable:
    """Something that can be set: what it is, with its unit, and how."""

    text: str
    change: Callable[[Setup, Any], Setup]


def _friction(setup: Setup, factor: float) -> Setup:
    floors = {name: friction * factor for name, friction in setup.profiles.floors.items()}
    return replace(setup, profiles=replace(setup.profiles, floors=floors))


def _profile(setup: Setup, **changes: Any) -> Setup:
    """The object with other values in its section of the file."""
    old = setup.profiles.objects[setup.object]
    objects = {**setup.profiles.objects, setup.object: old.with_values({**old.values, **changes})}
    return replace(setup, profiles=replace(setup.profiles, objects=objects))


def _mass(setup: Setup, factor: float) -> Setup:
    return _profile(setup, mass=setup.profiles.objects[setup.object].number("mass") * factor)


def _size(setup: Setup, factor: float) -> Setup:
    """Along the floor: all lengths of the shape but its height."""
    section = setup.profiles.objects[setup.object].section("parameters")
    values = dict(section.values)
    for name, value in values.items():
        if isinstance(value, list):  # x, y and z
            values[name] = [*(each * factor for each in value[:2]), *value[2:]]
        elif name in ("radius", "width"):
            values[name] = value * factor
    return _profile(setup, parameters=section.with_values(values))


def _variation(name: str, unit: float = 1.0) -> Callable[[Setup, float], Setup]:
    def change(setup: Setup, value: float) -> Setup:
        return replace(setup, variation=setup.variation.replaced(**{name: value * unit}))

    return change


def _noise(setup: Setup, factor: float) -> Setup:
    if factor <= 0.0:
        raise SettingError(f"noise = {factor:g}: must be above 0, for the filter takes no certain estimate")

    def change(name: str, sensor: SimulatedSensor) -> SimulatedSensor:
        if type(sensor.model) is not IdealSensorSettings:
            raise SettingError("noise: can be set of fidelity 'ideal' alone; choose it with --fidelity ideal")
        scaled = {
            key: tuple(factor * sigma for sigma in asdict(sensor.model)[key])
            for key in ("sigma_position", "sigma_rotation")
        }
        return sensor.changed("ideal", **scaled)

    return _sensors(setup, change)


def _sensors(setup: Setup, change: Callable[[str, SimulatedSensor], SimulatedSensor]) -> Setup:
    """The setup with the sensor of each arm changed."""
    sensors = {name: change(name, sensor) for name, sensor in setup.scene.simulation.sensors.items()}
    simulation = replace(setup.scene.simulation, sensors=sensors)
    return replace(setup, scene=replace(setup.scene, simulation=simulation))


def _misplaced(arm: int, x: int, unit: float) -> Callable[[Setup, float], Setup]:
    """The sensor of an arm stands elsewhere in its tool, which nothing knows of: by so much along x, y, ...

    Turns are to the left: its x-axis points down.
    """

    def change(setup: Setup, value: float) -> Setup:
        arms = list(setup.scene.arms.values())
        if arm >= len(arms):
            raise SettingError(f"the scene has no arm that follows: {setup.scene.path}")
        chosen, by = arms[arm], np.zeros(6)
        by[x] = unit * value
        T = chosen.T_tool_controlled @ setup.scene.T_controlled_sensor(chosen.name)
        in_tool = tuple(map(float, se3.euler_from_pose(T @ se3.pose_from_euler(by))))
        return _sensors(
            setup, lambda name, old: replace(old, in_tool=in_tool) if name == chosen.name else old
        )

    return change


def _pin_wear(setup: Setup, part: float) -> Setup:
    def change(name: str, sensor: SimulatedSensor) -> SimulatedSensor:
        if not isinstance(sensor.model, TacTipSettings):
            raise SettingError("pin_wear: only images have pins; choose --fidelity input or image")
        return replace(sensor, model=replace(sensor.model, markers=sensor.model.markers.replaced(worn=part)))

    return _sensors(setup, change)


def _rate(setup: Setup, rate: float) -> Setup:
    steps = setup.scene.simulation.rate
    if rate <= 0.0 or steps % rate:
        raise SettingError(f"rate = {rate:g} Hz: the simulation's rate, {steps} Hz, must be a multiple of it")
    arms = {}
    for name, arm in setup.scene.arms.items():
        if arm.sensor is not None:
            settings = arm.sensor.settings.replaced(camera_rate=float(rate))
            arm = replace(arm, sensor=replace(arm.sensor, settings=settings))
        arms[name] = arm
    return replace(setup, scene=replace(setup.scene, arms=arms))


def _latency(setup: Setup, milliseconds: float) -> Setup:
    if not 0.0 <= milliseconds <= 1000.0:
        raise SettingError(f"latency = {milliseconds:g} ms: must lie in [0, 1000] ms")
    return replace(setup, options=replace(setup.options, latency=milliseconds * 1e-3))


def _filter(setup: Setup, name: str) -> Setup:
    return replace(setup, options=replace(setup.options, filter=load_filter_settings(name)))


#: What a map can set, by name.
VARIABLES = {
    "friction": Variable("friction of the floor over the profile's", _friction),
    "mass": Variable("mass over the profile's", _mass),
    "size": Variable("size along the floor over the profile's", _size),
    "center_of_friction": Variable(
        "largest draw of the centre of friction [mm]", _variation("center_of_friction", 1e-3)
    ),
    "center_x": Variable(
        "centre of friction off the middle, along the object's x [mm]", _variation("center_x", 1e-3)
    ),
    "center_y": Variable("the same along its y [mm]", _variation("center_y", 1e-3)),
    "push_friction": Variable(
        "largest draw of friction from push to push, over it", _variation("push_friction")
    ),
    "friction_field": Variable("deviation of friction over the floor, over it", _variation("friction_field")),
    "friction_field_length": Variable("length of that field [mm]", _variation("friction_field_length", 1e-3)),
    "friction_speed": Variable("part of friction for each tenfold of speed", _variation("friction_speed")),
    "contact_angle": Variable("sensor turned in its tool to the left [deg]", _misplaced(0, 3, -DEG)),
    "contact_offset": Variable("sensor shifted in its tool to the left [mm]", _misplaced(0, 1, 1e-3)),
    "follower_angle": Variable("the other arm's sensor turned to the left [deg]", _misplaced(1, 3, -DEG)),
    "follower_offset": Variable("the other arm's sensor shifted to the left [mm]", _misplaced(1, 1, 1e-3)),
    "pin_wear": Variable("part of the pins worn off", _pin_wear),
    "placement": Variable(
        "largest draw of the object's place to the side [mm]", _variation("placement", 1e-3)
    ),
    "placement_angle": Variable("largest draw of its angle [deg]", _variation("angle_deg")),
    "offset": Variable("object to the side at the start [mm]", _variation("offset", 1e-3)),
    "angle": Variable("object turned at the start [deg]", _variation("turn_deg")),
    "noise": Variable("noise of the sensor over the ideal sensor's", _noise),
    "rate": Variable("exposures a second [Hz]", _rate),
    "latency": Variable("exposure to command [ms]", _latency),
    "filter": Variable("profile of the filter", _filter),
}
