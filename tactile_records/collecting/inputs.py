"""What a collection makes of its inputs: whether an image shows contact, and what a force sensor measures."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import NANOSECOND
from tactile_control.force_reference import StampedForce
from tactile_perception.estimating.image import Image, check_image
from tactile_perception.estimating.preprocessing import Preprocessor
from tactile_perception.estimating.presence import ContactPresence
from tactile_records.collecting.settings import DataCollectionSettings, ForceLabelSettings

Array = NDArray[np.float64]


class Look:
    """Whether an image shows contact, by a reference that the first images without contact make."""

    def __init__(self, settings: DataCollectionSettings) -> None:
        # that compares with its own reference: a difference would need one before
        self._preprocessor = Preprocessor(settings.preprocessing.replaced(difference=0.0))
        self._presence = ContactPresence(settings.presence)

    def forget(self) -> None:
        """Forget the reference."""
        self._presence.reset()

    def __call__(self, image: Image, without_contact: bool) -> bool | None:
        """None where there is no reference; only images `without_contact` make one. Raises `ImageError`."""
        settings = self._preprocessor.settings
        check_image(image, settings.raw_shape, "camera image", settings.color)
        if not (without_contact or self._presence.ready):
            return None
        return self._presence.update(self._preprocessor(image)).in_contact


class MeasuredForces:
    """Means of what a force sensor says at rest, less what it says in the air, which is weight."""

    def __init__(self, settings: ForceLabelSettings) -> None:
        self.settings = settings
        self._forces: list[StampedForce] = []
        self._zero = np.zeros(3)

    def forget(self) -> None:
        """Forget what has been measured, but for what no force is."""
        self._forces.clear()

    def take(self, forces: Iterable[StampedForce]) -> None:
        """Keep what has been measured, by its stamps; what is older than the last is left out."""
        for force in forces:
            if not self._forces or force.stamp_ns > self._forces[-1].stamp_ns:
                self._forces.append(force)

    def tare(self, since_ns: int) -> bool:
        """Take the mean since a stamp for no force; False as long as that is too short a time."""
        mean = self._mean(since_ns)
        if mean is not None:
            self._zero = mean
        return mean is not None

    def force(self, since_ns: int) -> Array | None:
        """On the sensor (3,), N, in {s}, the mean since a stamp; None as long as that is too short a time."""
        mean = self._mean(since_ns)
        return None if mean is None else self.settings.sign * (mean - self._zero)

    def _mean(self, since_ns: int) -> Array | None:
        """Of what was measured from a stamp on until the window is over; None as long as it is not."""
        until_ns, within = since_ns + round(self.settings.window / NANOSECOND), []
        for measured in self._forces:
            if measured.stamp_ns >= since_ns:
                within.append(measured.force)
                if measured.stamp_ns >= until_ns:
                    return np.asarray(np.mean(within, axis=0))
        return None
