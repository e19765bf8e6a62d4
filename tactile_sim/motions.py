"""How bodies of the simulated cell move: fixed in the world, carried by an arm's tool, or as a model says.

A motion is a class in the registry `tactile_scene.motions.MOTIONS`; a scene names it for a body, and another
package adds its own by an entry point of the group "tactile_servoing.motions"::

    class Swinging:
        settings_class = SwingingSettings             # checked against `motion_settings` of the scene

        def __init__(self, scene: Scene, body: BodyScene, settings: SwingingSettings) -> None: ...
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings
from tactile_scene.motions import MOTIONS
from tactile_scene.scene import BodyScene, Scene
from tactile_sim.frame import Truth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BodyContact:
    """The contact of one sensor with the body, as of its last exposure.

    Attributes
    ----------
    arm : str
        Whose sensor.
    T_body_sensor : ndarray (4, 4)
        The sensor in the body's frame.
    truth : Truth
        Depth, shear and normal force.
    force : ndarray (3,)
        Force of the sensor on the body, N, in the body's frame; NaN where the sensor does not model it.
    point, normal : ndarray (3,)
        Where it acts on the body's surface (m), and the outward normal there, in the body's frame.
    """

    arm: str
    stamp_ns: int
    T_body_sensor: Array
    truth: Truth
    force: Array
    point: Array
    normal: Array


class Motion(Protocol):
    """The pose of one body."""

    @property
    def carriers(self) -> tuple[str, ...]:
        """The arms that hold the body: a sensor that is pressed too deep into it stops these, too."""

    def step(self, dt: float, tools: Mapping[str, Array], contacts: Sequence[BodyContact]) -> Array:
        """T_world_body (4, 4) after `dt` seconds.

        Parameters
        ----------
        tools : mapping
            Arm -> T_world_tool (4, 4) of each simulated arm, now.
        contacts : sequence of BodyContact
            The sensors that touch the body.
        """


class MotionType(Protocol):
    """What an entry of `MOTIONS` is; a body starts at `scene.T_world_body(body.name)`."""

    settings_class: ClassVar[type[Settings]]

    def __call__(self, scene: Scene, body: BodyScene, settings: Any) -> Motion: ...


def make_motion(scene: Scene, body: BodyScene) -> Motion:
    """The motion that a scene names for a body; raises `SettingError` if its settings are wrong."""
    kind: MotionType = MOTIONS.load(body.motion)
    given = body.motion_settings
    return kind(scene, body, given.checked(kind.settings_class, given.values))


class Fixed:
    """A body that stands still in the world."""

    settings_class: ClassVar[type[Settings]] = Settings
    carriers: tuple[str, ...] = ()

    def __init__(self, scene: Scene, body: BodyScene, settings: Settings) -> None:
        self._T = scene.T_world_body(body.name)

    def step(self, dt: float, tools: Mapping[str, Array], contacts: Sequence[BodyContact]) -> Array:
        """Where it has always been."""
        return self._T


class Carried:
    """A body fixed to an arm's tool."""

    settings_class: ClassVar[type[Settings]] = Settings

    def __init__(self, scene: Scene, body: BodyScene, settings: Settings) -> None:
        self.carriers = (body.carried_by,)
        self._T_tool_body = body.T_parent_body

    def step(self, dt: float, tools: Mapping[str, Array], contacts: Sequence[BodyContact]) -> Array:
        """Where the tool has taken it."""
        return tools[self.carriers[0]] @ self._T_tool_body
