"""What data collection is made of: its settings and goal, and what it keeps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import (
    LARGEST_POSE,
    LARGEST_SEED,
    SMALLEST_POSE,
    SettingError,
    SettingGroups,
    Settings,
    setting,
)
from tactile_control.limiter import LimiterSettings
from tactile_control.motion import TravelSettings
from tactile_control.phases import DONE, FAILED, GO_TO_START, RETREAT, STOPPING, Goal
from tactile_control.watchdog import WatchdogSettings
from tactile_perception.datasets.writer import IMAGE_KINDS
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.estimating.presence import PresenceSettings
from tactile_scene.sampling import EdgeSampling, SamplingSettings

Array = NDArray[np.float64]

TASK = "data_collection"  # its name among the tasks

REFERENCE = "reference"
TOUCH = "touch"
ROTATE = "rotate"
TARE = "tare"
CONTACT = "contact"
SHEAR = "shear"
CAPTURE = "capture"
PHASES = (
    GO_TO_START,
    REFERENCE,
    TOUCH,
    ROTATE,
    TARE,
    CONTACT,
    SHEAR,
    CAPTURE,
    RETREAT,
    STOPPING,
    DONE,
    FAILED,
)


@dataclass(frozen=True)
class Target:
    """A sample to collect: its number in the data set, and its surface contact poses (6,), m and rad.

    First it is pressed, then sheared.
    """

    number: int
    pressed: Array
    sheared: Array


@dataclass(frozen=True)
class Capture:
    """What is kept of the image exposed at `stamp_ns`, as sample `number`.

    Attributes
    ----------
    euler : ndarray (6,)
        The label: measured Euler surface contact pose of X_fs, m and rad.
    target : ndarray (6,)
        What was asked for.
    T_base_sensor : ndarray (4, 4)
        Where the arm says that the sensor was.
    force : ndarray (3,), optional
        On the sensor, N, in {s}, where that is measured.
    """

    number: int
    stamp_ns: int
    euler: Array
    target: Array
    T_base_sensor: Array
    force: Array | None = None


@dataclass(frozen=True)
class CollectionMotionSettings(Settings):
    """Speeds, tolerances and time limits of `DataCollection`."""

    clearance: float = setting(
        0.003, lower=2e-4, upper=0.1, unit="m", doc="gap to the surface in which the sensor turns"
    )
    standoff: float = setting(
        0.010, lower=2e-4, upper=0.5, unit="m", doc="gap at which collection begins and ends"
    )
    air_speed: float = setting(0.05, lower=1e-3, upper=1.0, unit="m/s", doc="speed off the surface")
    air_angular_speed: float = setting(
        1.0, lower=1e-2, upper=6.3, unit="rad/s", doc="rotation speed off the surface"
    )
    contact_speed: float = setting(
        0.02, lower=1e-4, upper=0.2, unit="m/s", doc="speed of pressing and shearing"
    )
    contact_angular_speed: float = setting(
        0.35, lower=1e-3, upper=3.0, unit="rad/s", doc="rotation speed of shearing"
    )
    gain: float = setting(8.0, lower=0.1, upper=50.0, unit="1/s", doc="speed per distance left")
    position_tolerance: float = setting(
        5e-5, lower=1e-6, upper=0.005, unit="m", doc="a contact pose is reached within this"
    )
    angle_tolerance: float = setting(
        1e-3, lower=1e-5, upper=0.1, unit="rad", doc="and its orientation within this"
    )
    motion_timeout: float = setting(20.0, lower=0.5, upper=600.0, unit="s", doc="longest single motion")
    settle_time: float = setting(
        0.15, lower=0.0, upper=10.0, unit="s", doc="rest before the exposure that is kept"
    )
    still_distance: float = setting(
        2e-5, lower=1e-7, upper=0.005, unit="m", doc="rest: the sensor strays no further than this"
    )
    still_angle: float = setting(5e-4, lower=1e-6, upper=0.1, unit="rad", doc="and turns no further")
    capture_timeout: float = setting(
        5.0, lower=0.1, upper=60.0, unit="s", doc="longest wait for rest and an exposure of it"
    )
    certain_depth: float = setting(
        1e-3, lower=0.0, upper=0.02, unit="m",
        doc="a contact this deep must show in the image, one this far off must not: else the surface is not "
        "where it is said to be, and labels would be wrong",
    )  # fmt: skip

    @property
    def in_air(self) -> TravelSettings:
        """Pace off the surface, as the moves of `tactile_control.motion` take it."""
        return self._pace(self.air_speed, self.air_angular_speed)

    @property
    def in_contact(self) -> TravelSettings:
        """Pace of pressing and shearing."""
        return self._pace(self.contact_speed, self.contact_angular_speed)

    def _pace(self, speed: float, angular_speed: float) -> TravelSettings:
        return TravelSettings(
            speed=speed,
            angular_speed=angular_speed,
            gain=self.gain,
            height=self.standoff,
            timeout=self.motion_timeout,
            position_tolerance=self.position_tolerance,
            angle_tolerance=self.angle_tolerance,
        )


@dataclass(frozen=True)
class TouchSettings(Settings):
    """How the surface is found by touch before the first sample."""

    points: int = setting(
        0, lower=0, upper=24,
        doc="0: the surface is where it is said to be; 1: a touch finds its height; 3 and more: its tilt too",
    )  # fmt: skip
    radius: float = setting(0.015, lower=1e-3, upper=0.2, unit="m", doc="of the circle of 3 and more points")
    search: float = setting(
        0.005, lower=2e-4, upper=0.1, unit="m", doc="the surface is sought this far above and below"
    )
    speed: float = setting(0.002, lower=1e-4, upper=0.02, unit="m/s", doc="speed of the search")
    depth: float = setting(
        2e-4, lower=0.0, upper=0.005, unit="m", doc="depth at which contact first shows in the image"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.points == 2:
            raise SettingError("points = 2: two touches do not tell a plane; must be 0, 1, or 3 and more")


@dataclass(frozen=True)
class EdgeSettings(EdgeSampling):
    """Contacts on a straight edge in place of a flat surface."""

    pressed: bool = setting(False, doc="on an edge: x of {f} is along it, y to the side where the plate is")
    reach: float = setting(
        0.01, unit="m", lower=1e-3, upper=0.1,
        doc="touches that find the edge are so far beside the plate, and half as far; the others are on it",
    )  # fmt: skip
    tip_radius: float = setting(
        0.02, unit="m", lower=1e-3, upper=0.5, doc="of the sensor, of which a touch beside the edge tells it"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reach > 0.8 * self.tip_radius:
            raise SettingError(
                f"reach = {self.reach:g} m: a tip of {self.tip_radius:g} m would meet the edge with its "
                f"side; must be at most {0.8 * self.tip_radius:g}"
            )


@dataclass(frozen=True)
class ForceLabelSettings(Settings):
    """How contacts are labelled with what a force sensor between tool and tactile sensor says."""

    labelled: bool = setting(False, doc="whether they are; by default where the scene has a force sensor")
    sign: int = setting(
        1,
        choices=(1, -1),
        doc="-1 for a force sensor that tells what it presses with, not what presses on it",
    )
    window: float = setting(
        0.1,
        lower=0.0,
        upper=5.0,
        unit="s",
        doc="of rest, over which a force is averaged, in air and in contact",
    )


@dataclass(frozen=True)
class CollectionWatchdogSettings(WatchdogSettings):
    """Age limits; collection looks at the sensor's pose and at the image."""

    image_age: float = setting(0.2, lower=0.005, upper=2.0, unit="s", doc="oldest image acted upon")


@dataclass(frozen=True)
class DataSettings(Settings):
    """Where samples go, and over which surface they are taken."""

    folder: str = setting("", doc="data folder, made if it is not there; one with samples is gone on with")
    images: str = setting(
        "both", choices=IMAGE_KINDS, doc="processed (cropped, thresholded), raw (camera images), or both"
    )
    frame: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), length=6, lower=SMALLEST_POSE, upper=LARGEST_POSE, unit="m, rad",
        doc="contact frame {f} in the arm's base, Euler (x, y, z, alpha, beta, gamma): z into the surface, "
        "origin where the sensor's centre is at first touch",
    )  # fmt: skip


@dataclass(frozen=True)
class DataCollectionSettings(SettingGroups):
    """All that can be set of `DataCollection`; a run keeps `data` to `edge`, and `force`, as it began."""

    data: DataSettings = field(default_factory=DataSettings)
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    preprocessing: PreprocessingSettings = field(default_factory=PreprocessingSettings)
    presence: PresenceSettings = field(default_factory=PresenceSettings)
    edge: EdgeSettings = field(default_factory=EdgeSettings)
    motion: CollectionMotionSettings = field(default_factory=CollectionMotionSettings)
    touch: TouchSettings = field(default_factory=TouchSettings)
    force: ForceLabelSettings = field(default_factory=ForceLabelSettings)
    limiter: LimiterSettings = field(default_factory=LimiterSettings)
    watchdog: CollectionWatchdogSettings = field(default_factory=CollectionWatchdogSettings)


@dataclass(frozen=True)
class CollectionGoal(Goal):
    """Which samples a data folder is to hold when the goal is done; those that it holds already are kept."""

    samples: int = setting(6000, lower=1, upper=10_000_000, doc="how many")
    seed: int = setting(
        0, lower=0, upper=LARGEST_SEED, doc="of the poses; a sample's pose depends on seed and number only"
    )
    first: int = setting(
        0, lower=0, upper=1_000_000_000, doc="index of the folder's first sample in the seed's sequence"
    )
