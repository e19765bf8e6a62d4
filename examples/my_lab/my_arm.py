"""An arm driver that computes where a perfect arm would be; `robot:` marks where a robot library comes in."""

import threading
import time
from dataclasses import dataclass

import numpy as np

from tactile_base.settings import Settings, setting
from tactile_geometry import se3
from tactile_scene.arm import ArmMode, ArmState


@dataclass(frozen=True)
class MyArmSettings(Settings):
    host: str = setting("192.168.0.2", doc="address of the robot")
    rate: float = setting(125.0, lower=10.0, upper=1000.0, unit="Hz", doc="rate of its control loop")


class MyArm:
    settings_class = MyArmSettings
    keeps_limits = False  # of acceleration and jerk: it is given twists that do

    def __init__(self, arm, settings, report):
        # robot: connect to settings.host here; raise OSError if it does not answer
        self._period, self._report = 1.0 / settings.rate, report
        self._T, self._twist, self._why = arm.T_base_start, np.zeros(6), ""  # robot: ask it where it is
        self._open = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def command(self, stamp_ns, twist):
        self._twist, self._why = np.array(twist), ""

    def stop(self, reason):
        self._twist, self._why = np.zeros(6), reason  # robot: its own command for a stop

    def recover(self):
        pass  # robot: leave a protective stop; raise RuntimeError if it does not

    def close(self):
        self._open = False
        self._thread.join()

    def _run(self):
        last = time.monotonic()
        while self._open:
            time.sleep(self._period)
            twist, now = self._twist, time.monotonic()
            self._T, last = self._T @ se3.exp(twist * (now - last)), now  # robot: send it, read back the pose
            mode = ArmMode.MOVING if twist.any() else ArmMode.RESTING  # robot: FAULT in a protective stop
            self._report(ArmState(time.time_ns(), self._T, twist, mode, self._why))
