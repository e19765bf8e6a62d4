"""Follows one object by the contacts of several sensors, from stamp to stamp.

`fuse_contacts` fuses what contacts know at one stamp. Here is what has to be known between stamps: which
contacts there are, how old their beliefs are, and where on the object each of them is. A contact's place is
given, or found by touch: by the object's belief at the moment when the contact began, or, where no place is
given and no other contact holds the object, by definition: then the object's frame is this contact's feature
frame. A place that was found is forgotten with its contact.

All contacts are taken to one stamp, that of the newest belief: added up as they came, an older one would pull
the object back to where it was. Until then the object is taken to stand still, within what `object_speed` and
`object_turn_rate` say. Such motion is common to all contacts that are older, and counts as correlated.

A contact that slides drags its feature frame along, as if the object moved: one that is sheared by more than
`slide_shear` of its depth is left out, and given a new place only when its shear has gone back.

Who repeats whom: a place that was found carries the errors that the contacts used for it had then, and those
have them still, for nobody knows how fast such errors fade. So as long as the place is in use all that these
contacts know counts as correlated, and a contact cannot confirm what came from itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_filter.fusion import FusionError, check_gaussian
from tactile_filter.object.belief import (
    Contact,
    ObjectBelief,
    SplitGaussian,
    estimate_feature,
    fuse_contacts,
    moved_covariance,
    object_from_contact,
)
from tactile_filter.object.settings import TrackerSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_geometry.se3 import usable_pose

Array = NDArray[np.float64]

_NOTHING = ObjectBelief(None, (), {})
_CLEARLY = 3.0  # standard deviations beyond the limit: noise at a light touch is no slip
_STICKS_AGAIN = 0.8  # of the limit: a contact at its very limit does not change with every belief


class ContactUpdate(NamedTuple):
    """What is known of one contact at a stamp: X_sf with its covariance, and T_world_sensor (4, 4) then."""

    belief: PoseGaussian
    T_world_sensor: Array


@dataclass(frozen=True)
class TrackedObject:
    """What is known of the object at a stamp.

    Attributes
    ----------
    stamp_ns : int
    belief : its pose is None where it follows from no contact; `reason` says why
    stale : contacts left out because of their belief's age, by name, in s
    sliding : contacts left out because they may slide, by name, with their shear over their depth
    unplaced : contacts left out because their place on the object was not known at this stamp
    reason : why there is no pose; empty where there is one
    """

    stamp_ns: int
    belief: ObjectBelief
    stale: dict[str, float] = field(default_factory=dict)
    sliding: dict[str, float] = field(default_factory=dict)
    unplaced: tuple[str, ...] = ()
    reason: str = ""


class _Touch(NamedTuple):
    """One contact from its beginning to its end; the next one of that sensor has another number."""

    name: str
    number: int


class _Place(NamedTuple):
    """Where a contact is on the object, and the contacts by which that was found."""

    T_object_feature: PoseGaussian
    given: bool
    sources: frozenset[_Touch] = frozenset()


@dataclass(frozen=True)
class _Held:
    """A contact that lasts: its last belief, and its place as far as it is known."""

    touch: _Touch
    began_ns: int
    stamp_ns: int
    update: ContactUpdate
    place: _Place | None
    refused_since_ns: int | None = None


class ObjectTracker:
    """Belief over an object's pose from the contacts of several sensors; see the module's text.

    Parameters
    ----------
    names : of the sensors
    places : where on the object the contacts of some of them are, T_object_feature; those of the others are
        found by touch

    Attributes
    ----------
    refused : updates that could not be used since the last reset, by reason: "not usable", "sensor pose",
        "out of order"
    resets : by reason, since construction
    """

    def __init__(
        self,
        names: Sequence[str],
        settings: TrackerSettings | None = None,
        places: Mapping[str, PoseGaussian] | None = None,
    ) -> None:
        self.names = tuple(sorted(names))
        self.settings = TrackerSettings() if settings is None else settings
        self.resets: Counter[str] = Counter()
        self._stamp_ns: int | None = None
        self._given: dict[str, PoseGaussian] = {}
        for name, place in (places or {}).items():
            self._check_name(name)
            self._given[name] = place
        self._forget()

    def configure(self, settings: TrackerSettings) -> None:
        """Take other settings from the next step on; contacts and places stay."""
        self.settings = settings

    def set_place(self, name: str, place: PoseGaussian | None) -> None:
        """Give the place of a contact, T_object_feature, or (None) have it found by touch.

        It may give the object another frame, so that places that were found mean nothing any more: a reset.
        """
        self._check_name(name)
        if place is None:
            self._given.pop(name, None)
        else:
            self._given[name] = place
        self.reset("place changed")

    def reset(self, reason: str) -> None:
        """Forget all contacts and the places that were found."""
        self._forget()
        self.resets[reason] += 1

    def step(self, stamp_ns: int, updates: Mapping[str, ContactUpdate | None]) -> TrackedObject | None:
        """Take what is new of some contacts at a stamp, and say what is known of the object then.

        For a stamp that is not later than the last one the answer is None: what is new counts from the next
        step on, and nothing is answered twice or backwards. `updates` are by sensor,
        None for one that has no contact.
        """
        for name in sorted(updates):
            self._check_name(name)
            self._update(name, stamp_ns, updates[name])
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            return None
        self._stamp_ns = stamp_ns
        self._end_forgotten(stamp_ns)
        return self._answer(stamp_ns)

    # ---- contacts ----

    def _forget(self) -> None:
        self.refused: Counter[str] = Counter()
        self._held: dict[str, _Held] = {}
        self._slid: dict[str, bool] = {}  # sensors whose contact has slid since it began: whether it does now
        #: The last stamp of each sensor, in contact or not.
        self._heard: dict[str, int] = {}
        self._stamp_ns = None
        self._touches = 0

    def _check_name(self, name: str) -> None:
        if name not in self.names:
            raise KeyError(unknown_name(name, self.names))

    def _update(self, name: str, stamp_ns: int, update: ContactUpdate | None) -> None:
        if stamp_ns <= self._heard.get(name, stamp_ns - 1):
            self.refused["out of order"] += 1
            return
        self._heard[name] = stamp_ns
        if update is None:
            self._held.pop(name, None)
            self._slid.pop(name, None)
            return
        usable = self._usable(update)
        if usable is None:
            return
        held = self._held.get(name)
        if held is None or stamp_ns - held.stamp_ns > self.settings.forget_after * SECOND_NS:
            self._touches += 1
            touch = _Touch(name, self._touches)
            given = None if name in self._slid else self._given.get(name)
            place = None if given is None else _Place(given, given=True)
            held = _Held(touch, stamp_ns, stamp_ns, usable, place)
        self._held[name] = dataclasses.replace(held, stamp_ns=stamp_ns, update=usable)
        self._look_for_slip(name)

    def _look_for_slip(self, name: str) -> None:
        """Take its place from a contact whose last belief says that it may slide."""
        held, slid = self._held[name], self._slid.get(name, False)
        if may_slide(held.update.belief, self.settings.slide_shear, slid):
            self._slid[name] = True
            self._held[name] = dataclasses.replace(held, place=None, refused_since_ns=None)
        elif slid:
            self._slid[name] = False

    def _usable(self, update: ContactUpdate) -> ContactUpdate | None:
        """The update with an orthonormal sensor pose; None, and counted, if it cannot be used."""
        sensor = usable_pose(update.T_world_sensor)
        if sensor is None:
            self.refused["sensor pose"] += 1
            return None
        try:
            check_gaussian(update.belief.mean, update.belief.cov, "belief")
        except FusionError:
            self.refused["not usable"] += 1
            return None
        return ContactUpdate(update.belief, sensor)

    def _end_forgotten(self, stamp_ns: int) -> None:
        limit_ns = self.settings.forget_after * SECOND_NS
        for name in [n for n, held in self._held.items() if stamp_ns - held.stamp_ns > limit_ns]:
            del self._held[name]

    # ---- the object ----

    def _answer(self, stamp_ns: int) -> TrackedObject:
        if not self._held:
            return TrackedObject(stamp_ns, _NOTHING, reason="no contact")
        limit_ns = self.settings.max_age * SECOND_NS
        ages = {name: stamp_ns - held.stamp_ns for name, held in sorted(self._held.items())}
        stale = {name: age_ns / SECOND_NS for name, age_ns in ages.items() if age_ns > limit_ns}
        sliding = {n: shear_ratio(self._held[n].update.belief.mean) for n in ages if self._slid.get(n)}
        fresh = [name for name in ages if name not in stale and name not in sliding]
        self._define_frame(fresh)
        placed = [name for name in fresh if self._held[name].place is not None]
        unplaced = tuple(name for name in fresh if name not in placed)
        repeated = self._repeated()
        try:
            known = {name: self._known(self._held[name], stamp_ns, repeated) for name in placed}
            belief = fuse_contacts(known, self.settings.gate_probability)
        except FusionError as error:
            reason = f"the contacts cannot be fused: {error}"
            return TrackedObject(stamp_ns, _NOTHING, stale, sliding, unplaced, reason)
        if belief.pose is not None:
            self._note_refused(belief, stamp_ns)
            self._find_places(belief, unplaced, stamp_ns)
        reason = "" if belief.pose is not None else _why_nothing(ages.keys(), sliding)
        return TrackedObject(stamp_ns, belief, stale, sliding, unplaced, reason)

    def _define_frame(self, fresh: Sequence[str]) -> None:
        """Where nothing else says what the object's frame is, let the oldest contact do so."""
        if self._given or not fresh or any(held.place is not None for held in self._held.values()):
            return
        first = min(fresh, key=lambda name: (self._held[name].began_ns, name))
        place = _Place(PoseGaussian(np.eye(4), np.zeros((6, 6))), given=False)
        self._held[first] = dataclasses.replace(self._held[first], place=place)

    def _repeated(self) -> frozenset[_Touch]:
        """The contacts whose errors are in a place that was found by them."""
        places = [held.place for held in self._held.values() if held.place is not None]
        return frozenset().union(*(place.sources for place in places))

    def _known(self, held: _Held, stamp_ns: int, repeated: frozenset[_Touch]) -> SplitGaussian:
        """What a contact says of the object at a stamp, in parts that others share or not."""
        assert held.place is not None
        contact = Contact(held.update.belief, held.update.T_world_sensor, held.place.T_object_feature)
        if held.touch in repeated:
            known = object_from_contact(contact, correlated_share=1.0)
        else:
            place_share = 0.0 if held.place.given else 1.0
            known = object_from_contact(contact, self.settings.correlated_share, place_share)
        if stamp_ns == held.stamp_ns:
            return known
        motion = moved_covariance(held.update.T_world_sensor, self._motion(stamp_ns - held.stamp_ns))
        return dataclasses.replace(known, correlated=known.correlated + motion)

    def _motion(self, elapsed_ns: int) -> Array:
        """Covariance (6, 6) of what the object may have moved at a sensor in this time."""
        sigma = np.repeat((self.settings.object_speed, self.settings.object_turn_rate), 3)
        return np.diag((sigma * (elapsed_ns / SECOND_NS)) ** 2)

    def _find_places(self, belief: ObjectBelief, unplaced: Sequence[str], stamp_ns: int) -> None:
        assert belief.pose is not None
        sources: frozenset[_Touch] = frozenset()
        for name in belief.used:
            used = self._held[name]
            assert used.place is not None
            sources |= used.place.sources | {used.touch}
        for name in unplaced:
            held = self._held[name]
            own = held.update.belief
            aged = PoseGaussian(own.mean, own.cov + self._motion(stamp_ns - held.stamp_ns))
            found = estimate_feature(belief.pose.gaussian, aged, held.update.T_world_sensor)
            self._held[name] = dataclasses.replace(held, place=_Place(found, given=False, sources=sources))

    def _note_refused(self, belief: ObjectBelief, stamp_ns: int) -> None:
        """Keep since when contacts are refused; take the place of one that has been for too long."""
        for name in (*belief.used, *belief.refused):
            held = self._held[name]
            if name in belief.used:
                self._held[name] = dataclasses.replace(held, refused_since_ns=None)
                continue
            since_ns = stamp_ns if held.refused_since_ns is None else held.refused_since_ns
            held = dataclasses.replace(held, refused_since_ns=since_ns)
            assert held.place is not None
            if not held.place.given and stamp_ns - since_ns > self.settings.replace_after * SECOND_NS:
                held = dataclasses.replace(held, place=None, refused_since_ns=None)
            self._held[name] = held


def shear_ratio(X_sf: Array) -> float:
    """How far a contact is sheared along the surface, over its depth; inf where it has none."""
    x, y, depth = se3.inverse(X_sf)[:3, 3]
    return math.hypot(x, y) / depth if depth > 0.0 else math.inf


def may_slide(belief: PoseGaussian, limit: float, slides: bool) -> bool:
    """Whether a contact is sheared by clearly more than `limit` of its depth.

    Parameters
    ----------
    limit : 0: no contact slides
    slides : whether it did so far; then it sticks again only when its shear is clearly below the limit
    """
    if limit == 0.0:
        return False
    x, y, depth = se3.inverse(belief.mean)[:3, 3]
    shear = math.hypot(x, y)
    if slides:
        return shear > _STICKS_AGAIN * limit * depth
    # X_fs = mean^-1 exp(-eps^) has the translation p - R^T rho
    gradient = belief.mean[:3, :3] @ (x / shear, y / shear, -limit) if shear > 0.0 else np.zeros(3)
    return bool(shear - limit * depth > _CLEARLY * math.sqrt(gradient @ belief.cov[:3, :3] @ gradient))


def _why_nothing(held: Collection[str], sliding: Collection[str]) -> str:
    if len(sliding) == len(held):
        return "all contacts may slide"
    return "no contact whose place on the object is known"
