"""Parameters of the collector node that are not of its motion: what to collect, where to, over what."""

from __future__ import annotations

from dataclasses import dataclass

from tactile_base.settings import Settings, setting
from tactile_perception.datasets.writer import IMAGE_KINDS

#: Name of the task in goals of `run_task`.
TASK = "data_collection"


@dataclass(frozen=True)
class CollectorSettings(Settings):
    """What to collect, where to, and over which surface."""

    folder: str = setting("", doc="data folder, made if it is not there; one with samples is gone on with")
    samples: int = setting(6000, lower=1, doc="samples that the folder is to hold")
    seed: int = setting(0, lower=0, doc="of the poses; a sample's pose depends on seed and number only")
    first: int = setting(0, lower=0, doc="index of the folder's first sample in the seed's sequence")
    images: str = setting(
        "both", choices=IMAGE_KINDS, doc="processed (cropped, thresholded), raw (camera images), or both"
    )
    frame: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), length=6, lower=-10.0, upper=10.0, unit="m, rad",
        doc="contact frame {f} in the arm's base, Euler (x, y, z, alpha, beta, gamma): z into the surface, "
        "origin where the sensor's centre is at first touch",
    )  # fmt: skip
    step_period: float = setting(
        0.008, lower=0.001, upper=0.05, unit="s", doc="time between two twists of a running collection"
    )
    idle_period: float = setting(0.1, lower=0.01, upper=1.0, unit="s", doc="and without one")
    feedback_period: float = setting(0.1, lower=0.01, upper=10.0, unit="s", doc="of the action's feedback")
