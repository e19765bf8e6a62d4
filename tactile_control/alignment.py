"""Target alignment: the sideways velocity that steers a pushed object towards a target.

The paper's section "Tactile pushing controller". With the sensor's pose X_bs in the base, what is left to
move X_ss' as servoing has it, and the target X_bt (a position is enough), in the reference sensor frame {s'}

    X_s't = X_ss'^-1 X_bs^-1 X_bt        theta = atan2(y, z)        r = sqrt(y^2 + z^2)

A PID of the bearing's error gives the velocity along the y-axis of {s'}: tangential to the contact, and
parallel to the floor. Its gains are in degrees and mm/s, as in the paper's table (in radians they would move
less than 1 mm/s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import Settings, setting
from tactile_control.pid import CHANNELS, FEEDBACK, PidSettings, TangentPid
from tactile_geometry import se3

Array = NDArray[np.float64]

CHANNEL = CHANNELS.index("rho_y")  # of the 6-velocity in {s'} that the scalar output is
MM = 1e-3


@dataclass(frozen=True)
class AlignmentSettings(Settings):
    """Gains and limits of an `AlignmentController`; zero gains by default."""

    kp: float = setting(0.0, lower=0.0, upper=100.0, unit="mm/s per deg", doc="proportional gain")
    ki: float = setting(0.0, lower=0.0, upper=100.0, unit="mm/s per deg s", doc="integral gain")
    kd: float = setting(0.0, lower=0.0, upper=10.0, unit="mm/s per deg/s", doc="derivative gain")
    integral_limit_deg_s: float = setting(
        10.0,
        lower=0.0,
        upper=1e3,
        unit="deg s",
        doc="the integral of the bearing's error is clipped to +- this, before its gain",
    )
    output_limit_mm_s: float = setting(
        15.0,
        lower=0.0,
        upper=100.0,
        unit="mm/s",
        doc="the sideways velocity is clipped to +- this; the integral does not wind up meanwhile",
    )
    ewma_decay: float = setting(
        0.5, lower=0.0, upper=0.999, doc="weight of the past in the average whose derivative is taken"
    )
    reference_bearing_deg: float = setting(
        0.0, lower=-90.0, upper=90.0, unit="deg", doc="bearing of the target that is steered to"
    )
    cutoff_distance: float = setting(
        0.12,
        lower=0.0,
        upper=10.0,
        unit="m",
        doc="nearer to the target than this there is no output: the bearing may answer the other way there",
    )

    def pid(self) -> PidSettings:
        """Settings of a six-channel PID that is this law, with one channel in use: in deg and mm/s."""

        def only(value: float, others: float = 0.0) -> tuple[float, ...]:
            return tuple(value if channel == CHANNEL else others for channel in range(6))

        return PidSettings(
            kp=only(self.kp),
            ki=only(self.ki),
            kd=only(self.kd),
            integral_limit=only(self.integral_limit_deg_s, np.inf),
            output_limit=only(self.output_limit_mm_s, np.inf),
            ewma_decay=self.ewma_decay,
        )


@dataclass(frozen=True)
class Bearing:
    """Where a target is, in the reference sensor frame {s'}.

    Attributes
    ----------
    position : ndarray (3,)
        Of the target, m.
    angle_deg : float
        From the z-axis towards the y-axis: 0 straight ahead, beyond +-90 behind.
    distance : float
        In the yz-plane, m.
    """

    position: Array
    angle_deg: float
    distance: float


def target_bearing(target: ArrayLike, T_base_reference: Array) -> Bearing:
    """Bearing of a position (3,) in the base, m, from the reference sensor frame {s'} (4, 4) there."""
    position = se3.point_in(T_base_reference, target)
    _, y, z = position.tolist()
    return Bearing(position, math.degrees(math.atan2(y, z)), math.hypot(y, z))


class AlignmentController:
    """The paper's target alignment controller: a PID from the target's bearing to a sideways velocity."""

    def __init__(self, settings: AlignmentSettings) -> None:
        self.settings = settings
        self.pid = TangentPid(settings.pid())

    def configure(self, settings: AlignmentSettings) -> None:
        """Replace the settings between two steps; gains go over without a jump."""
        if settings != self.settings:
            self.settings = settings
            self.pid.configure(settings.pid())

    def step(self, stamp_ns: int, bearing: Bearing, hold_integral: bool = False) -> Array:
        """The velocity (6,) in {s'}, m/s, of which all but the y-component is zero.

        Raises `ControlInputError` for a bearing that is not finite and for a stamp that is not later than the
        last one; nothing changes then.
        """
        error, velocity = np.zeros((2, 6))
        error[CHANNEL] = self.settings.reference_bearing_deg - bearing.angle_deg
        feedback = self.pid.update(stamp_ns, error, hold_integral)[FEEDBACK]
        if bearing.distance >= self.settings.cutoff_distance:
            velocity[CHANNEL] = feedback[CHANNEL] * MM
        return velocity
