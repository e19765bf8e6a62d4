"""An arm, a camera and a motion of bodies, as a package outside this repository would bring them along."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_geometry import se3
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.camera import CameraFrame

PERIOD = 0.008  # s


@dataclass(frozen=True)
class BenchArmSettings(Settings):
    """What the scene says of the arm."""

    host: str = setting("here", doc="'nowhere' is not reached")
    states: int = setting(10**9, lower=0, doc="states that are reported before the arm falls silent")
    jump_after: int = setting(10**9, lower=0, doc="states after which it says that it is somewhere else")
    nowhere: bool = setting(False, doc="it says that it is at no pose at all")
    flips: bool = setting(False, doc="along y it goes the other way")
    deaf: bool = setting(False, doc="it does not stop")
    slow: float = setting(0.0, lower=0.0, unit="s", doc="time that a command takes that moves it")


class BenchArm:
    """Follows twists exactly, from a thread of its own, with no watchdog; prints what it is told."""

    settings_class = BenchArmSettings
    keeps_limits = False

    def __init__(self, arm, settings, report):
        if settings.host == "nowhere":
            raise ConnectionError(f"no answer from {settings.host}")
        self.kinematics, self._joints = arm.kinematics, None
        if self.kinematics is not None:
            self._joints = self.kinematics.reach(arm.T_base_start, self.kinematics.ready)
        self._pose, self._twist, self._why = arm.T_base_start, np.zeros(6), ""
        if settings.nowhere:
            self._pose = np.full((4, 4), np.nan)
        self._settings = settings
        self._report, self._left, self._jump = report, settings.states, settings.jump_after
        self._open = True
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def command(self, stamp_ns, twist):
        if np.any(twist):
            time.sleep(self._settings.slow)
        turn = [1.0, -1.0 if self._settings.flips else 1.0, 1.0, 1.0, 1.0, 1.0]
        self._twist, self._why = np.array(twist) * turn, ""

    def stop(self, reason):
        print(f"stop: {reason}\nstopped at {time.time_ns()}", flush=True)
        if not self._settings.deaf:
            self._twist, self._why = np.zeros(6), reason

    def recover(self):
        print("recover", flush=True)

    def close(self):
        print("close", flush=True)
        self._open = False
        self._thread.join()

    def _run(self):
        last = time.monotonic()
        while self._open:
            time.sleep(PERIOD)
            twist, now = self._twist, time.monotonic()
            self._pose, last = self._pose @ se3.exp(twist * (now - last)), now
            if self.kinematics is not None:
                self._joints = self.kinematics.follow(self._joints, self._pose)
            mode = ArmMode.MOVING if twist.any() else ArmMode.RESTING
            if self._left > 0:
                self._left -= 1
                self._jump -= 1
                if self._jump == 0:
                    self._pose = self._pose @ se3.exp(np.array([0, 0.3, 0, 0, 0, 0]))
                state = ArmState(time.time_ns(), self._pose, twist, mode, self._why, self._joints)
                self._report(state)


@dataclass(frozen=True)
class BenchCameraSettings(Settings):
    """What the scene says of the camera."""

    gray: int = setting(50, lower=0, upper=255, doc="of all pixels")
    channels: int = setting(1, lower=1, upper=3, doc="1 is gray")


class BenchCamera:
    """Exposes the same image at the rate of the scene, and loses every tenth."""

    settings_class = BenchCameraSettings

    def __init__(self, arm, settings, report):
        self.rate = arm.sensor.settings.camera_rate
        shape = (480, 640) if settings.channels == 1 else (480, 640, settings.channels)
        self._image = np.full(shape, settings.gray, np.uint8)
        self._report, self._open = report, True
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self):
        self._open = False
        self._thread.join()

    def _run(self):
        number = 0
        while self._open:
            time.sleep(1 / self.rate)
            number += 1
            if number % 10:
                self._report(CameraFrame(time.time_ns(), self._image, number // 10))


@dataclass(frozen=True)
class DriftSettings(Settings):
    """How a body drifts."""

    speed: float = setting(0.01, unit="m/s", lower=-1.0, upper=1.0, doc="along the world's x axis")


class Drift:
    """A body that drifts along x, until a sensor touches it; keeps what it was told."""

    settings_class = DriftSettings
    carriers = ()

    def __init__(self, scene, body, settings):
        self._T, self._speed = scene.T_world_body(body.name), settings.speed
        self.contacts = []

    def step(self, dt, tools, contacts):
        self.contacts += contacts
        T = self._T.copy()
        if not contacts:
            T[0, 3] += dt * self._speed
        self._T = T
        return T
