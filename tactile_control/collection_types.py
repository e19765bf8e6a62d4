"""What goes into and comes out of data collection: targets, inputs, captures, commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_control.phases import DONE, FAILED, GO_TO_START, RETREAT, STOPPING, StampedPose, TaskCommand

Array = NDArray[np.float64]

REFERENCE = "reference"
TOUCH = "touch"
ROTATE = "rotate"
CONTACT = "contact"
SHEAR = "shear"
CAPTURE = "capture"
PHASES = (GO_TO_START, REFERENCE, TOUCH, ROTATE, CONTACT, SHEAR, CAPTURE, RETREAT, STOPPING, DONE, FAILED)


@dataclass(frozen=True)
class Target:
    """A sample to collect: its number in the data set, and its surface contact pose (6,), m and rad."""

    number: int
    euler: Array


@dataclass(frozen=True)
class Exposure:
    """An image's stamp, T_base_sensor (4, 4) at it, and whether it shows contact.

    `in_contact` is None as long as nobody knows what the sensor looks like without contact.
    """

    stamp_ns: int
    T_base_sensor: Array
    in_contact: bool | None


@dataclass(frozen=True)
class CollectionInputs:
    """The latest of each input; None where none has arrived yet."""

    sensor_pose: StampedPose | None = None
    exposure: Exposure | None = None


@dataclass(frozen=True)
class Capture:
    """What to store: the image exposed at `stamp_ns`, as sample `number`.

    Attributes
    ----------
    euler : ndarray (6,)
        The label: measured Euler surface contact pose of X_fs, m and rad.
    target : ndarray (6,)
        What was asked for.
    T_base_sensor : ndarray (4, 4)
        Where the arm says that the sensor was.
    """

    number: int
    stamp_ns: int
    euler: Array
    target: Array
    T_base_sensor: Array


@dataclass(frozen=True)
class CollectionCommand(TaskCommand):
    """What one step of data collection says, beyond a `TaskCommand`; its phase is one of `PHASES`.

    Attributes
    ----------
    number : int
        Of the sample under way; 0 where there is none.
    collected, total : int
        Samples captured so far, and those asked for.
    travelled : float
        Way of the sensor's centre, m.
    capture : Capture or None
        What to store now.
    """

    number: int
    collected: int
    total: int
    travelled: float
    capture: Capture | None
