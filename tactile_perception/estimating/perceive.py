"""Check, presence, estimate: what perception makes of one image, live, offline and in a replay alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import nan
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_filter.force import ForceGaussian
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.image import Image
from tactile_perception.estimating.image_check import SIDE, ImageCheck, ImageRefused
from tactile_perception.estimating.labels import EstimateError
from tactile_perception.estimating.presence import ContactPresence, Presence

if TYPE_CHECKING:  # percepts of an ideal sensor need no onnxruntime
    from tactile_perception.estimating.estimator import Estimator


PLAIN_ERRORS = 4.0  # RMS errors of a plain depth that an estimate may be off it
APART = 2  # images on end in which it is further off, so that it is refused
# of its depth, that an estimate may be off as well: deeper than the contacts of the training both guess, and
# in tracking with the paper's gains, which press up to 9 mm, they are up to 2.2 mm apart (simulated)
DEPTH_SHARE = 0.3


@dataclass(frozen=True)
class Percept:
    """What perception says of one exposure.

    Attributes
    ----------
    in_contact : bool or None
        None while the reference of the contact presence is being captured, and where presence is not asked.
    score : float
        Of the contact presence; NaN where `in_contact` is None.
    estimate : PoseGaussian or None
        Gaussian over X_sf (SI, left perturbation); None without contact, and where the network failed.
    fault : str
        Why there is no estimate although one was due, or why images are no reference; else empty.
    still : bool
        Whether the latest images have shown nothing but noise.
    plain_depth : float
        How deep (m) the contact is by the image's brightness (`PlainDepth`); NaN where that is not known.
    novelty : float
        How unlike the training images the image is, foreign above 1 (`Novelty`); NaN where that is not known.
        From what is usual on, the estimate's covariance has grown with it.
    force : ForceGaussian or None
        The force on the sensor (N, in {s}), beside `estimate`; None where the model does not tell it.
    """

    in_contact: bool | None
    score: float
    estimate: PoseGaussian | None = None
    fault: str = ""
    still: bool = False
    plain_depth: float = nan
    novelty: float = nan
    force: ForceGaussian | None = None


class DepthAgreement:
    """Refuses estimates whose depth is far from `plain_depth` in several images on end.

    Of the first of them nothing is refused: a depth that jumps is known sooner by what follows.
    """

    def __init__(self) -> None:
        self._apart = 0  # images on end

    def __call__(self, percept: Percept, limit: float) -> Percept:
        """A percept, without its estimate where that is too often further than `limit` (m) from it."""
        if percept.estimate is None:
            return percept
        depth, plain = depth_of(percept.estimate), percept.plain_depth
        limit = max(limit, DEPTH_SHARE * depth)
        self._apart = self._apart + 1 if abs(depth - plain) > limit else 0  # of NaN nothing is known
        if self._apart < APART:
            return percept
        return replace(
            percept,
            estimate=None,
            force=None,
            fault=f"the network says that the contact is {depth * 1e3:.1f} mm deep, and the brightness of "
            f"the image {plain * 1e3:.1f} mm",
        )


def depth_of(estimate: PoseGaussian) -> float:
    """Depth (m) of a contact, the z of X_fs, of a Gaussian over X_sf."""
    return -float(estimate.mean[:3, 2] @ estimate.mean[:3, 3])


class Perceiver:
    """Image -> percept. A network always answers, but without contact there is nothing to estimate.

    With a `ContactPresence` images are those of a sensor at work: they are checked, and an estimate is made
    in contact only. Without one each stands for itself, and an estimate is made of it::

        perceive = Perceiver(Estimator(), ContactPresence())
        percept = perceive(image)
    """

    def __init__(
        self, estimator: Estimator, presence: ContactPresence | None = None, check: ImageCheck | None = None
    ) -> None:
        self.estimator = estimator
        self.presence = presence
        self.check = check or ImageCheck()
        self._kept: Image | None = None
        self._captured: list[Image] = []  # of a reference, before the difference to it
        self._agreement = DepthAgreement()
        if presence is not None:
            self.check.binary = estimator.metadata.preprocessing.binary
            presence.objection = self._no_reference

    def __call__(self, image: Image, processed: bool = False, stamp_ns: int | None = None) -> Percept:
        """The percept of one camera image, or of one that is already cropped and thresholded.

        `stamp_ns` is the time of its exposure; without it images follow one another without a gap.

        Raises `ImageError` if the image has the wrong size or type, `ImageRefused` if it cannot show the
        sensor: then nothing is known of this exposure.
        """
        if self.presence is None:
            make = self.estimator.estimate_processed if processed else self.estimator.estimate
            percept = self._estimated(make, image, None, float("nan"))
            if self.estimator.metadata.novelty is None:
                return percept
            return self._widened(percept, self._novelty(self.estimator.preprocessor.again()))
        self.catch_up()
        prepare = self.estimator.preprocessor
        prepared = prepare.from_processed(image) if processed else prepare(image)
        if not processed:  # what is drawn at the network's input has no noise: it repeats itself
            self.check.exposure(image)
            self._kept = image
        view, novelty = prepare.view(SIDE), self._novelty(prepared)
        if self.presence.ready:
            self.check.look(view, self.presence.touched, stamp_ns)
            if why := self.check.foreign(novelty):
                raise ImageRefused(why)
        else:
            self.check.capture(view)
        presence = self.presence.update(prepared)
        if presence.in_contact is None:
            self._capture(presence)
        if not presence.in_contact:
            return Percept(presence.in_contact, presence.score, fault=presence.refused, novelty=novelty)
        percept = self._estimated(self.estimator.estimate_prepared, prepared, True, presence.score)
        percept = replace(self._widened(percept, novelty), still=self.check.still)
        plain, limit = self.estimator.metadata.plain_depth, self.check.settings.depth_difference
        if plain is None or not limit:
            return percept
        percept = replace(percept, plain_depth=plain(prepared))
        return self._agreement(percept, max(limit, PLAIN_ERRORS * plain.rms))

    def _capture(self, presence: Presence) -> None:
        """An image was taken for the reference; its last one decides whether they become that."""
        assert self.presence is not None
        prepare = self.estimator.preprocessor
        if self.estimator.metadata.preprocessing.difference:
            self._captured.append(prepare.latest.copy())
        if not (self.presence.ready or presence.refused):
            return
        self.check.take(not presence.refused)
        captured, self._captured = self._captured, []
        if captured and not presence.refused:
            prepare.reference = np.rint(np.mean(captured, axis=0)).astype(np.uint8)
            self.presence.set_reference([prepare.from_processed(image) for image in captured])

    def catch_up(self) -> None:
        """Do what need not be known before a percept is on its way; at the next image at the latest."""
        if self._kept is not None:
            self.check.remember(self._kept)
            self._kept = None

    def _novelty(self, prepared: NDArray[np.float32]) -> float:
        measure = self.estimator.metadata.novelty
        return measure(prepared) if measure is not None else nan

    def _widened(self, percept: Percept, novelty: float) -> Percept:
        """A percept with its image's novelty, by which its covariance grows."""
        measure, estimate = self.estimator.metadata.novelty, percept.estimate
        if measure is not None and estimate is not None and novelty > measure.usual:
            growth = measure.growth(novelty) ** 2
            estimate = replace(estimate, cov=growth * estimate.cov)
            if percept.force is not None:
                percept = replace(percept, force=replace(percept.force, cov=growth * percept.force.cov))
        return replace(percept, estimate=estimate, novelty=novelty)

    def _no_reference(self, prepared: NDArray) -> str:
        """Why an image is not one without contact, as the camera of the training was mounted; else empty."""
        metadata = self.estimator.metadata
        if metadata.layout is not None and (
            why := metadata.layout.objection(prepared, metadata.preprocessing)
        ):
            return why
        return self.check.foreign(self._novelty(prepared)) or self._touching(prepared)

    def _touching(self, prepared: NDArray) -> str:
        """Why an image is not one without contact, by the depth that the network sees; else empty."""
        assert self.presence is not None
        estimate = self._estimated(self.estimator.estimate_prepared, prepared, None, float("nan")).estimate
        if estimate is None:
            return ""  # what the network fails on says nothing
        depth = depth_of(estimate)
        limit = self.presence.settings.reference_depth
        text = f"the network sees a contact of {depth * 1e3:.1f} mm, must be at most {limit * 1e3:g} mm"
        return text if depth > limit else ""

    def _estimated(
        self, make: Callable[..., PoseGaussian], image: NDArray, in_contact: bool | None, score: float
    ) -> Percept:
        try:
            return Percept(in_contact, score, make(image), force=self.estimator.force)
        except EstimateError as error:
            return Percept(in_contact, score, fault=str(error))
