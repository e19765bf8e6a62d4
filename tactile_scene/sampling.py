"""Which surface contact poses a data set consists of: the paper's sampling rules, by seed and number.

Sample `index` of a seed is the same pose wherever it is collected, in simulation without ROS or by an arm::

    pose = pose_of(SamplingSettings(), seed=1, index=0)     # (x, y, z, alpha, beta, gamma) of X_fs, m and rad

It is reached in two steps, pressed and then sheared, on a flat surface or on an edge: `contact_poses`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, Settings, setting

Array = NDArray[np.float64]

#: First index of validation samples, far behind any training sample of the same seed.
VALIDATION_START = 10_000_000


@dataclass(frozen=True)
class SamplingSettings(Settings):
    """Ranges of the samples; the defaults are the paper's ("Data Collection")."""

    disk_radius: float = setting(
        5e-3, unit="m", lower=0.0, upper=0.02, doc="of the disk that shear displacements fill"
    )
    depth: tuple[float, ...] = setting(
        (0.5e-3, 6e-3), unit="m", lower=0.0, upper=0.02, length=2, doc="least and largest depth"
    )
    cap_angle: float = setting(
        math.radians(25.0), unit="rad", lower=0.0, upper=1.2, doc="of the cap of contacts"
    )
    gamma: float = setting(math.radians(5.0), unit="rad", lower=0.0, upper=1.0, doc="largest shear rotation")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ordered(self, "depth")


#: On an edge it is pressed deeper than on a surface, sheared less and tilted less.
ON_EDGES = {"depth": (3e-3, 5.5e-3), "disk_radius": 3e-3, "cap_angle": math.radians(10.0)}


@dataclass(frozen=True)
class EdgeSampling(Settings):
    """Where contacts on an edge lie before the shear; x of their frame {f} is along it, y over the plate."""

    offset: tuple[float, ...] = setting(
        (-5e-3, 6e-3), unit="m", lower=-0.02, upper=0.02, length=2,
        doc="least and largest y of a contact before the shear; below 0 the tip's middle is beside the plate",
    )  # fmt: skip
    direction: float = setting(
        math.radians(170.0), unit="rad", lower=0.0, upper=math.radians(175.0),
        doc="largest gamma before the shear; less where the wrist cannot turn all round",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ordered(self, "offset")


def check_ordered(settings: Settings, *names: str) -> None:
    """Refuse a range (least, largest) that is upside down."""
    for name in names:
        low, high = getattr(settings, name)
        if low > high:
            raise SettingError(f"{name} = ({low:g}, {high:g}): the least must not exceed the largest")


def sample_pose(settings: SamplingSettings, rng: np.random.Generator) -> Array:
    """One surface contact pose (6,), m and rad, by the paper's sampling equations."""
    r = settings.disk_radius * np.sqrt(rng.uniform())
    theta = rng.uniform(0, 2 * np.pi)
    z = rng.uniform(settings.depth[0], settings.depth[1])
    phi = np.arccos(1 - (1 - np.cos(settings.cap_angle)) * rng.uniform())
    azimuth = rng.uniform(0, 2 * np.pi)
    alpha = -np.arcsin(np.sin(phi) * np.sin(azimuth))
    beta = -np.arctan2(np.sin(phi) * np.cos(azimuth), np.cos(phi))
    gamma = rng.uniform(-settings.gamma, settings.gamma)
    return np.array([r * np.cos(theta), r * np.sin(theta), z, alpha, beta, gamma])


def sample_rng(seed: int, index: int) -> np.random.Generator:
    """The random numbers of one sample; its pose is drawn first."""
    return np.random.default_rng([seed, index])


def pose_of(settings: SamplingSettings, seed: int, index: int) -> Array:
    """Surface contact pose (6,), m and rad, of sample `index` (from 0) of a seed."""
    return sample_pose(settings, sample_rng(seed, index))


def contact_poses(
    sampling: SamplingSettings, edge: EdgeSampling | None, seed: int, index: int
) -> tuple[Array, Array]:
    """Contact poses (6,), m and rad, of a sample: pressed, and after the shear. `edge` None: on a surface."""
    sheared = pose_of(sampling, seed, index)
    pressed = sheared.copy()
    pressed[[0, 1, 5]] = 0.0
    if edge is not None:
        rng = np.random.default_rng([seed, index, 1])  # beside the stream that `pose_of` draws from
        pressed[1] = rng.uniform(edge.offset[0], edge.offset[1])
        pressed[5] = rng.uniform(-edge.direction, edge.direction)
        sheared[[1, 5]] += pressed[[1, 5]]
    return pressed, sheared
