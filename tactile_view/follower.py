"""CameraFollower: the camera of one page goes along with the tips, and stays where its user has put it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_view.drawing import look_from

Array = NDArray[np.float64]

FIRST = 2.0  # s in which a new page is told again where to look from: its own default comes late
REMEMBERED = 100  # places that it was sent to; it reports each of them some time later
SAME, MOVED = 1e-4, 1e-5  # m


class CameraFollower:
    """See the module's text. What a page reports that it was sent to is no wish of its user."""

    def __init__(self) -> None:
        self._count = 0
        self._until = 0.0
        self._eye = self._look_at = self._middle = np.zeros(3)  # both from the middle of the tips
        self._sent: deque[Array] = deque(maxlen=REMEMBERED)

    def step(self, camera: Any, tips: Sequence[Array], follows: bool) -> None:
        """Move a camera (viser's) as the tips (4, 4) do, at each look at the cell."""
        middle = np.mean(tips, axis=0)[:3, 3]
        if self._count != len(tips):
            eye, at = look_from(tips)
            self._count, self._until = len(tips), time.monotonic() + FIRST
            self._middle, self._eye, self._look_at = middle, eye - middle, at - middle
        elif time.monotonic() > self._until:
            self._take_wish(camera)
            if not follows or not (abs(middle - self._middle) > MOVED).any():
                return
        self._middle = middle
        self._sent.append(middle + self._eye)
        camera.position = middle + self._eye
        camera.look_at = middle + self._look_at

    def _take_wish(self, camera: Any) -> None:
        """Keep where the user has put it, which is none of the places that it was sent to."""
        reported = np.asarray(camera.position)
        if any(np.abs(reported - sent).max() < SAME for sent in self._sent):
            return
        self._eye, self._look_at = reported - self._middle, np.asarray(camera.look_at) - self._middle
        self._sent.append(reported)
