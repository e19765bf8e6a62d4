"""Rehearsals: a scene with the real drivers of its arms, against doubles, and with simulated cameras.

A double stands for the controller of an arm and speaks its protocol, so that nodes, driver and wire are those
of the real cell; the sensor's images are simulated where the double's arm stands. Another package adds a
double for its driver by an entry point of the group "tactile_servoing.doubles", under the driver's name.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_base.contract import Contract
from tactile_base.registry import Registry
from tactile_base.settings import SettingError
from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_scene.arm import ArmMode
from tactile_scene.scene import SIM, ArmScene, Scene
from tactile_sim.arm import SimArm

Array = NDArray[np.float64]


class Double(Protocol):
    """A double that has been opened for an arm of a rehearsed scene; raises `OSError` if that cannot be.

    Attributes
    ----------
    stopped : bool
        Whether safety had stopped it when `now` was asked for last.
    """

    stopped: bool

    def __call__(self, arm: ArmScene) -> Double: ...

    @staticmethod
    def settings(address: str) -> Mapping[str, Any]:
        """What `driver_settings` say in a rehearsal, for a loopback address that no other arm has."""

    @staticmethod
    def wait(arm: ArmScene, seconds: float) -> None:
        """Return when the double of a rehearsed arm takes connections, or after that time."""

    def now(self) -> tuple[int, Array, Array]:
        """Time (ns), pose (4, 4) in the base and twist (6,), in itself, of the controlled frame."""

    def protective_stop(self) -> None:
        """Stop as after a collision."""

    def ask(self, line: str) -> Any:
        """What it answers to a line that its user has typed: something that may go wrong."""

    def close(self) -> None:
        """End it."""


#: Doubles by the name of the driver that they are driven by.
DOUBLES: Registry[Double] = Registry(
    "double",
    "tactile_servoing.doubles",
    {
        "franka": "tactile_doubles.franka_rehearsal:FrankaRehearsal",
        "ur": "tactile_doubles.ur_rehearsal:UrRehearsal",
    },
    Contract(
        ("arm",),
        {
            "settings": ("address",),
            "wait": ("arm", "seconds"),
            "now": (),
            "protective_stop": (),
            "ask": ("line",),
            "close": (),
        },
    ),
)


def rehearsed(scene: Scene) -> Scene:
    """The scene with doubles in place of its arms, and simulated cameras in place of its cameras.

    Raises
    ------
    SettingError
        If an arm has a driver for which there is no double, or a camera's rate does not fit the simulation's.
    """
    arms = dict(scene.arms)
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    for number, (name, arm) in enumerate(scene.arms.items(), start=1):
        if arm.driver == SIM:
            continue
        if arm.driver not in DOUBLES.names():
            raise SettingError(
                f"{scene.path}: a rehearsal needs a double of each arm; there is none for the driver "
                f"'{arm.driver}' of '{name}', but for {', '.join(DOUBLES.names())}"
            )
        settings = copy.copy(arm.driver_settings)
        address = f"127.{domain % 250 + 1}.0.{number}"  # of this ROS domain alone
        settings.values = settings.values | dict(DOUBLES.load(arm.driver).settings(address))
        arms[name] = replace(arm, driver_settings=settings, sensor=_simulated(scene, arm))
    return replace(scene, arms=arms)


def simulated(scene: Scene) -> Scene:
    """The scene with a simulated arm and camera for each that a driver or somebody else stands for.

    For runs in one process, which need neither drivers nor doubles.
    """
    arms = {
        name: arm if arm.driver == SIM else replace(arm, driver=SIM, sensor=_simulated(scene, arm))
        for name, arm in scene.arms.items()
    }
    return replace(scene, arms=arms)


def doubled(arm: ArmScene) -> bool:
    """Whether an arm of a rehearsed scene has a double."""
    return arm.driver != SIM and arm.driver in DOUBLES.names()


def _simulated(scene: Scene, arm: ArmScene) -> Any:
    """The arm's sensor with a simulated camera."""
    if arm.sensor is None:
        return None
    rate, steps = arm.sensor.settings.camera_rate, scene.simulation.rate
    if steps / rate != int(steps / rate):
        raise SettingError(
            f"{scene.path}: camera_rate = {rate:g} Hz: where it is simulated the simulation's rate, "
            f"{steps} Hz, must be a multiple of it"
        )
    tip = scene.simulation.sensors[arm.name].tip_radius
    # what was measured of the real camera's stamps is not true of the simulated one's
    settings = arm.sensor.settings.replaced(tip_radius=tip, time_offset=0.0)
    return replace(arm.sensor, camera=SIM, settings=settings)


class FollowedArm(SimArm):
    """The arm of a simulated cell that stands where the arm of a double does."""

    def __init__(self, arm: ArmScene, double: Double, stamp_ns: int = 0) -> None:
        super().__init__(arm.limits, arm.T_base_start, stamp_ns)
        self._double, self._twist = double, np.zeros(6)

    @property
    def twist(self) -> Array:
        """Twist (6,) of the controlled frame, in that frame."""
        return self._twist

    @property
    def target(self) -> Array:
        """The measured twist: what the double was asked for is not known here."""
        return self._twist

    @property
    def mode(self) -> ArmMode:
        """FAULT in a stop by safety of the double."""
        return ArmMode.FAULT if self._double.stopped else ArmMode.MOVING

    def fault(self, reason: str) -> None:
        """A protective stop of the double."""
        self._double.protective_stop()

    def advance_to(self, stamp_ns: int) -> Array:
        """Look where the double's arm is, and where it will be at the stamp (ns)."""
        now_ns, T, self._twist = self._double.now()
        self._stamp_ns = int(stamp_ns)
        ahead = (stamp_ns - now_ns) / SECOND_NS
        self._pose = T @ se3.exp(self._twist * ahead) if abs(ahead) < _LARGEST_LEAD else T
        return self.T_base_controlled


_LARGEST_LEAD = 0.05  # s, over which a motion is carried on
