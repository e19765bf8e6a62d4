"""Estimates anew from the images of a bag, as the live estimator makes them, in the place of recorded ones.

They go through messages as they would from node to node, so that the filter takes the same bits.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_base.topics import (
    ESTIMATE,
    FORCE_ESTIMATE,
    IMAGE,
    PRESENCE,
    WRENCH,
    Topic,
    compressed,
    sensor_frame,
)
from tactile_filter.force import ForceGaussian
from tactile_perception.estimating.encodings import decompressed, pixels_of
from tactile_perception.estimating.estimator import Estimator, ModelError
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.image_check import ImageCheck, ImageCheckSettings
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_records.bags.contents import Recorded, noted
from tactile_records.bags.message_columns import Needed, lacking, rows_of
from tactile_records.bags.reader import Bag
from tactile_records.replay.run import force_rows, pose_rows
from tactile_records.replay.topics import ReplayError, wanted_topics
from tactile_wire.cdr import blank_layout, layout_of
from tactile_wire.errors import MessageError as Unreadable

Array = NDArray[Any]

COMPRESSED = compressed(IMAGE)
_PACKED: Needed = {"header.stamp.sec": (), "header.stamp.nanosec": (), "header.frame_id": None}
_RAW: Needed = {**_PACKED, "encoding": None, "height": (), "width": (), "step": ()}
AHEAD = 64  # images that are decoded before they are needed


@dataclasses.dataclass(frozen=True)
class Image:
    """One image of a bag, or why there is none."""

    message: Recorded
    stamp_ns: int
    frame_id: str
    pixels: Array | None
    fault: str = ""


def wanted_with_images(topic: str, type_name: str) -> bool:
    """Whether a replay from images needs a topic."""
    return wanted_topics(topic, type_name) or _arm_of(topic) is not None


def estimated(bag: Bag, model: Path | None) -> tuple[Bag, list[str]]:
    """The bag with estimates and presences made from its images, without the recorded ones; and remarks.

    Parameters
    ----------
    model : Path or None
        None for the one that was live where the bag names it and it is there, else the shipped one.

    Raises
    ------
    ReplayError
        The bag holds no images, or the model cannot be used.
    """
    arms = sorted({arm for topic in bag.topics if (arm := _arm_of(topic)) is not None})
    if not arms:
        topics = ", ".join(sorted(bag.topics)) or "none"
        raise ReplayError(
            f"{bag.folder}: no images on <arm>/{IMAGE.name} or <arm>/{COMPRESSED.name} "
            f"(--record-images records them); topics with messages: {topics}"
        )
    remarks: list[str] = []
    replaced = {kind.of(arm).name for arm in arms for kind in (ESTIMATE, PRESENCE, WRENCH, FORCE_ESTIMATE)}
    made = {arm: _Estimates(bag, arm, model, remarks) for arm in arms}
    messages: list[Recorded] = []
    for item in _decoded(bag, {arm: each.color for arm, each in made.items()}):
        if isinstance(item, Image):
            messages += made[str(_arm_of(item.message.topic))].of(item)
        elif item.topic not in replaced:
            messages.append(item)
    for each in made.values():
        each.report(remarks)
    counts = Counter(message.topic for message in messages)
    types = bag.types | {message.topic: message.type for message in messages}
    return dataclasses.replace(bag, messages=messages, counts=dict(counts), types=types), remarks


def _arm_of(topic: str) -> str | None:
    """The arm whose images a topic has."""
    return IMAGE.arm_of(topic) or COMPRESSED.arm_of(topic)


def _decoded(bag: Bag, colors: dict[str, bool]) -> Iterator[Recorded | Image]:
    """All messages in their order, images decoded on all cores ahead of their use; in color for some arms."""
    names = {message.type for message in bag.messages if _arm_of(message.topic) is not None}
    fields = {name: bag.typestore(name).fielddefs for name in names}
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        queue: list[Any] = []
        for message in bag.messages:
            arm = _arm_of(message.topic)
            queue.append(
                message if arm is None else pool.submit(image_of, fields[message.type], message, colors[arm])
            )
            if len(queue) > AHEAD:
                yield _result(queue.pop(0))
        yield from map(_result, queue)


def _result(item: Any) -> Recorded | Image:
    return item if isinstance(item, Recorded) else item.result()


def image_of(fields: Any, message: Recorded, color: bool = False) -> Image:
    """One image, decoded, gray or in color, or why there is none.

    Parameters
    ----------
    fields : mapping
        Type -> (constants, fields), see `message_definitions.type_fields`.
    """
    try:
        layout = layout_of(fields, message.type, message.data)
    except Unreadable as error:
        return Image(message, -1, "", None, str(error))
    if missing := lacking(layout, _PACKED if "format" in layout.texts else _RAW):
        return Image(message, -1, "", None, f"{message.type}: has no field {missing} of its kind")
    if not layout.lengths.get("data"):
        return Image(message, -1, "", None, "has no pixels")
    values = np.frombuffer(message.data, layout.dtype, 1)[0]
    stamp_ns = int(values["header.stamp.sec"]) * SECOND_NS + int(values["header.stamp.nanosec"])
    frame_id = layout.texts["header.frame_id"]
    try:
        if "format" in layout.texts:
            pixels = decompressed(values["data"], layout.texts["format"], color)
        else:
            height, width, step = (int(values[name]) for name in ("height", "width", "step"))
            pixels = pixels_of(values["data"], height, width, step, layout.texts["encoding"], color)
    except ImageError as error:
        return Image(message, stamp_ns, frame_id, None, str(error))
    return Image(message, stamp_ns, frame_id, pixels)


class _Estimates:
    """What the live estimator node does with each image of one arm."""

    def __init__(self, bag: Bag, arm: str, model: Path | None, remarks: list[str]) -> None:
        self.arm = arm
        parameters = noted(bag.note, "parameters").get(f"/{arm}/estimator", {})
        recorded = parameters.get("model", "")
        if model is None and recorded and not Path(recorded).exists():
            remarks.append(f"{arm}: the model {recorded} is not there: the shipped one is taken")
        chosen = model or (recorded if recorded and Path(recorded).exists() else "")
        try:
            estimator = Estimator(chosen)
        except ModelError as error:
            raise ReplayError(str(error)) from error
        self.color = estimator.metadata.preprocessing.color
        presence = {
            n.removeprefix("presence."): v for n, v in parameters.items() if n.startswith("presence.")
        }
        self.presence = ContactPresence(PresenceSettings.from_mapping(presence))
        check = {n.removeprefix("check."): v for n, v in parameters.items() if n.startswith("check.")}
        self.perceive = Perceiver(
            estimator, self.presence, ImageCheck(ImageCheckSettings.from_mapping(check))
        )
        self.last_ns = -1
        self.faults: Counter[str] = Counter()
        self.first_fault: dict[str, str] = {}

    def of(self, image: Image) -> list[Recorded]:
        """The messages that an image gives rise to."""
        if image.pixels is None:
            return self._refuse("images cannot be used", image.fault)
        if self.last_ns - SECOND_NS <= image.stamp_ns <= self.last_ns:
            return self._refuse("images are not later than the one before them", f"stamp {image.stamp_ns} ns")
        self.last_ns = image.stamp_ns
        try:
            percept = self.perceive(image.pixels, stamp_ns=image.stamp_ns)
        except ImageError as error:
            return self._refuse("images cannot be used", str(error))
        if percept.in_contact is None:
            return self._refuse("references are none", percept.fault) if percept.fault else []
        frame = image.frame_id or sensor_frame(self.arm)
        numbers = percept.score, self.presence.settings.on, percept.in_contact, percept.novelty
        messages = [_presence_message(self.arm, image, frame, *numbers)]
        if percept.fault:
            messages += self._refuse("estimates are no Gaussians", percept.fault)
        if percept.estimate is not None:
            rows = pose_rows([(image.stamp_ns, percept.estimate.mean, percept.estimate.cov)], frame)
            messages.insert(0, _recorded(self.arm, ESTIMATE, next(rows_of(rows)), image))
        if percept.force is not None:
            messages += _force_messages(self.arm, image, frame, percept.force)
        return messages

    def report(self, remarks: list[str]) -> None:
        """Add what was odd."""
        for what, count in self.faults.items():
            remarks.append(f"{self.arm}: {count} {what}, the first: {self.first_fault[what]}")
        if not self.presence.ready:
            remarks.append(f"{self.arm}: too few images for the reference of the contact presence")

    def _refuse(self, what: str, fault: str) -> list[Recorded]:
        self.faults[what] += 1
        self.first_fault.setdefault(what, fault)
        return []


def _presence_message(
    arm: str, image: Image, frame: str, score: float, threshold: float, in_contact: bool, novelty: float
) -> Recorded:
    layout = blank_layout(PRESENCE.type, {"header.frame_id": frame})
    row = np.frombuffer(bytearray(layout.template), layout.dtype)
    row["header.stamp.sec"], row["header.stamp.nanosec"] = divmod(image.stamp_ns, SECOND_NS)
    row["score"], row["threshold"], row["in_contact"] = score, threshold, in_contact
    row["novelty"] = novelty
    return _recorded(arm, PRESENCE, row.tobytes(), image)


def _force_messages(arm: str, image: Image, frame: str, force: ForceGaussian) -> list[Recorded]:
    """The force as a wrench, whose torque is 0, and with its covariance."""
    wrench = blank_layout(WRENCH.type, {"header.frame_id": frame})
    row = np.frombuffer(bytearray(wrench.template), wrench.dtype)
    row["header.stamp.sec"], row["header.stamp.nanosec"] = divmod(image.stamp_ns, SECOND_NS)
    for axis, value in zip("xyz", force.mean.tolist(), strict=True):
        row[f"wrench.force.{axis}"] = value
    rows = force_rows([(image.stamp_ns, force, math.nan)], frame)
    return [
        _recorded(arm, WRENCH, row.tobytes(), image),
        _recorded(arm, FORCE_ESTIMATE, next(rows_of(rows)), image),
    ]


def _recorded(arm: str, topic: Topic, data: bytes, image: Image) -> Recorded:
    received_ns = image.message.received_ns
    return Recorded(topic.of(arm).name, topic.type, data, received_ns, received_ns)
