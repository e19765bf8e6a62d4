"""Scenes of pushing with another object, floor or trial: what an experiment changes from run to run.

Objects and floors are those of `config/pushed_objects.yaml`::

    scene = pushing_scene(load_scene("dual_pushing"), "red_square", "foam", seed=3)
    Cell(scene, seed=3)
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError, Settings, setting, unknown_name
from tactile_base.yaml_file import Section, read_yaml
from tactile_geometry import se3
from tactile_scene.scene import ArmScene, BodyScene, Scene
from tactile_scene.shapes import SHAPES
from tactile_scene.shapes.surface import Surface
from tactile_sim.pushed import PushedSettings

Array = NDArray[np.float64]

MOTION = "pushed"
SET = 5  # trials of one object on one floor, as in the paper: floor and foot are the same in them
# m between object and tip at the start: the first arm's as small as one places an object by hand, since the
# second arm presses the object against it.
GAP, GAP_FACING = 0.001, 0.005
_PROFILE = ("mass", "center_of_gravity")  # of an object, by their names in PushedSettings
_CLOSE = 1e-9  # m


@dataclass(frozen=True)
class PushVariation(Settings):
    """What differs: frictions, centre, place and angle are drawn evenly from minus to plus. Assumed.

    Friction and its centre belong to an object on a floor, and are drawn for each `SET` of trials; where the
    object is put, for each trial. How far apart the two spreads are is read off the paper's deviations
    (docs/results/pushing.md).
    """

    friction: float = setting(0.15, lower=0.0, upper=0.9, doc="of the floor, as a part of it; of a set")
    center_of_friction: float = setting(
        0.003, unit="m", lower=0.0, upper=0.05,
        doc="off the centre of pressure, along x and along y; of a set",
    )  # fmt: skip
    center_x: float = setting(
        0.0, unit="m", lower=-0.1, upper=0.1, doc="of that centre along x of the object, on top of it"
    )  # fmt: skip
    center_y: float = setting(
        0.0, unit="m", lower=-0.1, upper=0.1, doc="the same along its y"
    )  # fmt: skip
    push_friction: float = setting(
        0.0, lower=0.0, upper=0.9, doc="of the floor on top of that, as a part of it; of a trial"
    )
    friction_field: float = setting(
        0.0, lower=0.0, upper=1.0,
        doc="standard deviation of friction over the floor, as a part of it; a field of a set",
    )  # fmt: skip
    friction_field_length: float = setting(
        0.05, unit="m", lower=1e-3, upper=10.0, doc="over which that field changes"
    )
    friction_speed: float = setting(
        0.0, lower=-0.5, upper=1.0, doc="part by which friction grows with each tenfold of the speed"
    )
    placement: float = setting(
        0.0006, unit="m", lower=0.0, upper=0.1, doc="of the object, across the tip's axis; of a trial"
    )
    angle_deg: float = setting(
        0.3, unit="deg", lower=0.0, upper=30.0, doc="of the object about the vertical; of a trial"
    )
    offset: float = setting(
        0.0, unit="m", lower=-0.1, upper=0.1, doc="of the object to the left, on top of what is drawn"
    )
    turn_deg: float = setting(
        0.0, unit="deg", lower=-180.0, upper=180.0, doc="of the object, on top of what is drawn"
    )


@dataclass(frozen=True)
class PushedProfiles:
    """The file of objects and floors.

    Attributes
    ----------
    objects : mapping
        Name -> its section.
    floors : mapping
        Name -> friction.
    """

    objects: Mapping[str, Section]
    floors: Mapping[str, float]


def read_profiles(path: Path | None = None) -> PushedProfiles:
    """Objects and floors of the packaged file, or of another; raises `SettingError` with file and line."""
    root = read_yaml(path or config_path("pushed_objects.yaml"))
    root.allow("floors", "objects")
    for section in root.sections("floors").values():
        section.allow("friction")
    for section in root.sections("objects").values():
        section.allow("shape", "parameters", *_PROFILE)
    floors = {name: section.number("friction") for name, section in root.sections("floors").items()}
    return PushedProfiles(root.sections("objects"), floors)


def draw(name: str, floor: str, seed: int | None) -> Array:
    """What a trial draws, (6,) in -1 to 1; 0 without a seed.

    Friction, its centre's x and y, place, angle, and friction of the trial alone.
    """
    if seed is None:
        return np.zeros(6)
    row = zlib.crc32(f"{name}/{floor}".encode())
    of_set = np.random.default_rng([row, 0, seed // SET]).uniform(-1.0, 1.0, 3)
    return np.concatenate([of_set, np.random.default_rng([row, 1, seed]).uniform(-1.0, 1.0, 3)])


def pushing_scene(
    scene: Scene,
    name: str,
    floor: str,
    seed: int | None = None,
    variation: PushVariation | None = None,
    profiles: PushedProfiles | None = None,
) -> Scene:
    """The scene with that object on that floor, `GAP` in front of its first arm; other arms face it.

    Parameters
    ----------
    scene : Scene
        With one body whose motion is `pushed`, in front of the tip of its first arm; further arms face it.
    name, floor : str
        Names of the file of profiles.
    seed : int, optional
        Of the trial; without it nothing varies.

    Raises
    ------
    SettingError
        For an unknown name, or a scene that pushes nothing.
    """
    known = profiles or read_profiles()
    for kind, given, names in (("object", name, list(known.objects)), ("floor", floor, list(known.floors))):
        if given not in names:
            raise SettingError(f"{kind}: {unknown_name(given, names)}")
    body = next((body for body in scene.bodies.values() if body.motion == MOTION), None)
    if body is None:
        raise SettingError(f"scene {scene.name}: none of its bodies has the motion '{MOTION}'")
    profile, vary = known.objects[name], variation or PushVariation()
    drawn = draw(name, floor, seed)
    shape = profile.choice("shape", SHAPES.names())
    parameters = profile.settings("parameters", SHAPES.load(shape).settings_class)
    settings = {
        **{key: profile.values[key] for key in _PROFILE if key in profile.values},
        "friction": known.floors[floor]
        * (1 + vary.friction * drawn[0])
        * (1 + vary.push_friction * drawn[5]),
        **{key: getattr(vary, key) for key in ("friction_field", "friction_field_length", "friction_speed")},
        "friction_field_seed": 0 if seed is None else zlib.crc32(f"{name}/{floor}/{seed // SET}".encode()),
        "center_of_friction": tuple(vary.center_of_friction * drawn[1:3] + [vary.center_x, vary.center_y]),
    }
    new = replace(body, shape=shape, parameters=parameters, motion_settings=_motion_settings(body, settings))
    first, *others = scene.arms.values()
    aside, turn = vary.offset + vary.placement * drawn[3], vary.turn_deg + vary.angle_deg * drawn[4]
    new = _placed(new, first, aside, np.radians(turn))
    arms = {arm.name: _facing(arm, new) for arm in others}
    return replace(scene, arms={first.name: first, **arms}, bodies={**scene.bodies, body.name: new})


def _motion_settings(body: BodyScene, changes: Mapping[str, Any]) -> Section:
    """The body's own, with those of object and floor, and of the trial, in place."""
    old = body.motion_settings
    own = old.checked(PushedSettings, old.values)
    default = PushedSettings()
    return old.with_values({**asdict(own), **{key: getattr(default, key) for key in _PROFILE}, **changes})


def _placed(body: BodyScene, arm: ArmScene, aside: float, turn: float) -> BodyScene:
    """The body on the floor in front of the arm's tip, to the side by `aside` (m) and turned (rad)."""
    T_sensor, surface = arm.T_world_start, body.make()
    ahead = T_sensor[:3, 2]
    T = se3.pose_from_euler([0, 0, 0, 0, 0, turn])
    T[:3, 3] = T_sensor[:3, 3] + 0.2 * ahead + aside * np.cross([0.0, 0.0, 1.0], ahead)
    T[2, 3] = -float(surface.grid()[..., 2].min())
    return replace(body, T_parent_body=_moved(T, -ahead, lambda T: _gap(arm, T_sensor, surface, T) - GAP))


def _facing(arm: ArmScene, body: BodyScene) -> ArmScene:
    """An arm that starts on its axis at the gap from the body."""
    start, surface = arm.T_world_start, body.make()

    def excess(T: Array) -> float:
        return _gap(arm, T, surface, body.T_parent_body) - GAP_FACING

    return replace(arm, T_world_start=_moved(start, start[:3, 2], excess))


def _moved(T: Array, direction: Array, excess: Callable[[Array], float]) -> Array:
    """A pose (4, 4) moved along a direction, which brings things nearer, until nothing is in excess (m)."""
    T = T.copy()
    for _ in range(50):
        left = excess(T)
        T[:3, 3] += left * direction
        if abs(left) < _CLOSE:
            break
    return T


def _gap(arm: ArmScene, T_world_sensor: Array, surface: Surface, T_world_body: Array) -> float:
    """Between the arm's tip and the body, m."""
    center = (se3.inverse(T_world_body) @ T_world_sensor)[:3, 3]
    return float(surface.distance(center[None])[0]) - _radius(arm)


def _radius(arm: ArmScene) -> float:
    if arm.sensor is None:
        raise SettingError(f"arm '{arm.name}' has no sensor, so that it cannot push")
    return arm.sensor.settings.tip_radius
