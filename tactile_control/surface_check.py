"""SurfaceCheck: does what is believed of the contact fit the arm's own motion?

The pose of the surface in the base follows from the arm's pose, which is measured by other means, and the
believed contact: T_base_feature = T_base_sensor X_sf. The filter predicts as if the surface stood still; here
what the beliefs make of the surface over some time is held against what a surface can do. With depth z,
normal n and the sensor's centre p, of a surface of any shape that stands still

    z(t) - z(t0)  =  integral of n . dp                    the tip goes deeper by as much as the arm goes in

whatever the arm does meanwhile. On the way its normal turns by no more than curvature times the way slid, and
a contact that slides, slides along with its shear, never against it: friction takes work. A surface that may
move (`speed`, `turn_rate`) or give way (`yields`) leaves more room::

    check = SurfaceCheck(SurfaceSettings())
    check.begin()                                    # a new contact
    check.add(belief.stamp_ns, belief.T, T_base_sensor)
    check.doubt, check.contradiction                 # 0 to 1; '' or what contradicts what, with numbers
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_geometry import se3

Array = NDArray[np.float64]

LATELY = 0.1  # weight of an image in the share of those that gave nothing to believe
# s; beliefs of so long, and so many, are averaged: what differs between images is noise
BIN, LEAST_NUMBER = 0.1, 3
JUMP = 1.5  # depth errors between one belief and the next, which have more noise than means
ACCELERATION = 1.0  # m/s^2, of a surface that may move, as far as its speed lets it
SLOWEST = 0.25  # part of the twist that is left where a limit is all but reached
LEAST_SHEAR, LEAST_TURN = 0.001, 0.03  # m, rad; smaller ones hardly have a direction

# columns of what is kept of a bin
_TIME, _OFFSET, _INTO, _SLID, _SHEARED, _TWISTED, _NORMAL, _COLUMNS = 0, 1, 2, 3, 4, 5, slice(6, 9), 9


@dataclass(frozen=True)
class SurfaceSettings(Settings):
    """What the touched surface is and does at most: beliefs that need more contradict the arm's motion."""

    checked: bool = setting(True, doc="hold the beliefs against the arm's own motion")
    speed: float = setting(
        0.0, lower=0.0, upper=1.0, unit="m/s",
        doc="the surface moves at most so fast during the task's own phase; 0: it stands still",
    )  # fmt: skip
    turn_rate: float = setting(
        0.0, lower=0.0, upper=10.0, unit="rad/s", doc="and turns at most so fast during it"
    )
    rests_at_first: bool = setting(
        True, doc="until the task's own phase begins the surface stands still; false: it may move then, too"
    )
    yields: float = setting(
        0.0, lower=0.0, upper=0.1, unit="m",
        doc="the surface gives way by at most so much where the tip presses, as an object that is held, and "
        "comes back as the tip does",
    )  # fmt: skip
    curvature: float = setting(
        25.0, lower=0.0, upper=1000.0, unit="1/m", doc="largest curvature of the surface: 1 / its radius"
    )
    depth_error: float = setting(
        0.001, lower=1e-5, upper=0.05, unit="m", doc="two believed depths are wrong by at most so much in sum"
    )
    normal_error: float = setting(
        0.03, lower=0.0, upper=0.5, unit="rad",
        doc="a believed normal may be off by so much all the time: on a way slid that adds up to a depth",
    )  # fmt: skip
    angle_error: float = setting(
        0.07, lower=1e-3, upper=1.0, unit="rad", doc="two believed normals are wrong by so much at most"
    )
    shear_error: float = setting(
        0.003, lower=1e-4, upper=0.05, unit="m", doc="a contact slides at most so far against its own shear"
    )
    twist_error: float = setting(
        0.3, lower=1e-2, upper=2.0, unit="rad", doc="and turns so far against its own twist"
    )
    depth_margin: float = setting(
        0.002, lower=0.0005, upper=0.1, unit="m",
        doc="a contact that is believed deeper than the reference (servoing.reference) by more has something "
        "in its way: the task fails",
    )  # fmt: skip
    width_error: float = setting(
        0.0, lower=0.0, upper=0.05, unit="m",
        doc="where another arm holds the object, too: it becomes thinner by at most so much in between, more "
        "if it gives way; 0: any",
    )  # fmt: skip
    carried: bool = setting(
        False,
        doc="an arm that waits for this task and feels nothing carries what is touched: its tool says how "
        "that moves, and the depth is held against this arm's way into it",
    )
    carried_error: float = setting(
        0.0016, lower=1e-5, upper=0.05, unit="m",
        doc="depth_error of that, which holds the errors of both arms' poses as well",
    )  # fmt: skip
    carried_yields: float = setting(
        0.0, lower=0.0, upper=0.1, unit="m",
        doc="yields of that: how far what is carried gives way in its grip, and in itself",
    )  # fmt: skip
    refused_share: float = setting(
        0.5, lower=0.05, upper=1.0,
        doc="of the latest ten images, about: more of them than this, in contact, gave nothing to believe",
    )  # fmt: skip
    still_way: float = setting(
        0.003, lower=0.0, upper=0.1, unit="m",
        doc="the arm goes so far at most in contact while the images show nothing but noise; further with an "
        "object that is carried along, whose contact may stand still for a while; 0: any way",
    )  # fmt: skip
    memory: float = setting(
        10.0, lower=0.5, upper=60.0, unit="s", doc="beliefs are compared with those up to so long ago"
    )
    slow_from: float = setting(
        0.7, lower=0.0, upper=1.0,
        doc="from this part of a limit on the arm moves slower, at the limit it stops; 1: not before",
    )  # fmt: skip


class Check:
    """What a check of beliefs says.

    Attributes
    ----------
    doubt : float
        How near the beliefs are to a contradiction: the largest part of a limit that is reached.
    contradiction : str
        What contradicts what, with numbers; '' as long as nothing does. It lasts until `begin`.
    unheard : bool
        Whether it is that there was too little to believe, for which others may know the reason.
    """

    settings: SurfaceSettings
    doubt = 0.0
    contradiction = ""
    unheard = False

    def begin(self) -> None:
        """A new contact: nothing is known of it."""
        self.doubt, self.contradiction, self.unheard = 0.0, "", False

    def pace(self) -> float:
        """How much of a twist is to be followed: 1 while all fits, less in doubt, 0 for a contradiction."""
        slow_from = self.settings.slow_from
        if self.contradiction:
            return 0.0
        if self.doubt <= slow_from or slow_from >= 1.0:
            return 1.0
        return 1.0 - (1.0 - SLOWEST) * (self.doubt - slow_from) / (1.0 - slow_from)


class SurfaceCheck(Check):
    """Compares the latest beliefs of one contact with the earlier ones; see the module's text.

    Parameters
    ----------
    reference : float
        How deep the contact is to be, m.
    """

    def __init__(self, settings: SurfaceSettings, reference: float = 0.003) -> None:
        self._bins: Array = np.zeros((0, _COLUMNS))
        self._count = self._next = 0  # bins that are filled, and which is the next
        # m: how deep the contact is to be, and how much deeper it may still be since that was changed
        self._reference, self._above = reference, 0.0
        self.begin()
        self.configure(settings)

    def configure(self, settings: SurfaceSettings, reference: float | None = None) -> None:
        """Replace what is known of the surface; what the beliefs said so far stays.

        A `reference` (m; None: as it was) that is less deep than before leaves time to come up to it.
        """
        reference = self._reference if reference is None else reference
        self._above = max(0.0, self._above + self._reference - reference)
        self._reference = reference
        rows = max(2, math.ceil(settings.memory / BIN))
        if len(self._bins) != rows:
            kept = self._bins[: self._count]
            kept = kept[kept[:, _TIME].argsort()][-rows:]
            self._bins = np.zeros((rows, _COLUMNS))
            self._bins[: len(kept)] = kept
            self._count, self._next = len(kept), len(kept) % rows
        self.settings = settings

    def begin(self) -> None:
        """See `Check`."""
        super().begin()
        self.moves = False
        self._count = self._next = 0
        self._last: tuple[list[float], list[float]] | None = None  # centre and normal
        self._into = self._slid = self._offset = self._refused = 0.0
        self._above = 0.0
        self._stamp_ns = self._begin_ns = 0
        self._gathered: list[float] = [0.0] * 4
        self._sums: list[Array] = []
        self._number = 0
        self._before: _Middle | None = None
        self._sheared = self._twisted = 0.0
        self._rate: float | None = None  # of the surface along its normal between two beliefs, m/s
        self._still: list[float] | None = None  # where the sensor was when images began to show only noise

    def work(self) -> None:
        """The task's own phase begins: from now on the surface may move, if it may at all."""
        self.moves = True

    def see(self, believed: bool, still: bool = False) -> None:
        """Take notice of an image that shows contact: whether it gave something to believe.

        `still` says whether the latest images have shown nothing but noise.
        """
        self._refused += LATELY * ((not believed) - self._refused)
        if not self.settings.checked or self.contradiction:
            return
        if self._refused > self.settings.refused_share:
            self.unheard = True
            self.contradiction = (
                f"no belief came of {self._refused:.0%} of the latest images that show contact"
            )
        elif (way := self._gone_still(still)) > self.settings.still_way > 0.0:
            self.contradiction = (
                f"the arm went {way * 1e3:.1f} mm in contact while the images showed nothing but noise: do "
                "they show the sensor as it is now?"
            )

    def _gone_still(self, still: bool) -> float:
        """How far the sensor is, m, from where it was when the images began to stand still."""
        if not still or self._last is None:
            self._still = None
            return 0.0
        here, _ = self._last
        self._still = self._still or here
        return math.dist(here, self._still)

    def add(self, stamp_ns: int, X_sf: Array, T_base_sensor: Array) -> None:
        """Take a belief's mean (4, 4) and the sensor's pose (4, 4), both of a stamp later than the last."""
        if not self.settings.checked or self.contradiction:
            return
        T_base_feature = se3.compose(T_base_sensor, X_sf)
        offset = self._follow(T_base_sensor, T_base_feature)
        if self._number >= LEAST_NUMBER and stamp_ns - self._begin_ns >= 0.999 * BIN * SECOND_NS:
            self._close()
        if not self._number:
            self._begin_ns = stamp_ns
            self._sums = [T_base_feature.copy(), T_base_sensor.copy()]
            self._gathered = [0.0] * 4
        else:
            self._sums[0] += T_base_feature
            self._sums[1] += T_base_sensor
        self._number += 1
        for index, value in enumerate((stamp_ns * NANOSECOND, offset, self._into, self._slid)):
            self._gathered[index] += value
        if self._stamp_ns:
            self._jumped((stamp_ns - self._stamp_ns) * NANOSECOND, offset - self._offset)
        self._stamp_ns, self._offset = stamp_ns, offset

    def _follow(self, T_base_sensor: Array, T_base_feature: Array) -> float:
        """Carry on what the arm has done along and across the normal; the surface's place along it, m."""
        p, f = T_base_sensor[:3, 3].tolist(), T_base_feature[:3, 3].tolist()
        n = T_base_feature[:3, 2].tolist()
        if self._last is not None:
            (px, py, pz), (nx, ny, nz) = self._last
            dx, dy, dz = p[0] - px, p[1] - py, p[2] - pz
            mx, my, mz = n[0] + nx, n[1] + ny, n[2] + nz
            size = math.sqrt(mx * mx + my * my + mz * mz) or 1.0
            along, way = (mx * dx + my * dy + mz * dz) / size, dx * dx + dy * dy + dz * dz
            self._into += along
            self._slid += math.sqrt(max(0.0, way - along * along))
        self._last = p, n
        depth = n[0] * (p[0] - f[0]) + n[1] * (p[1] - f[1]) + n[2] * (p[2] - f[2])
        return depth - self._into

    # ---- one bin after the other ----

    def _close(self) -> None:
        """Take the beliefs gathered as one, and compare it with those kept."""
        part = 1.0 / self._number
        middle = _Middle(*(part * total for total in self._sums))
        if self._before is not None:
            sheared, twisted = middle.slid_along(self._before)
            self._sheared += sheared
            self._twisted += twisted
        self._before = middle
        gathered = (part * value for value in self._gathered)
        now = np.array([*gathered, self._sheared, self._twisted, *middle.normal])
        self._number = 0
        self._compare(now)
        self._look_at_depth(now[_OFFSET] + now[_INTO])
        self._bins[self._next] = now
        self._next = (self._next + 1) % len(self._bins)
        self._count = min(self._count + 1, len(self._bins))

    def _look_at_depth(self, depth: float) -> None:
        self._above = min(self._above, max(0.0, depth - self._reference))
        limit = self._reference + self._above + self.settings.depth_margin
        if depth > limit and not self.contradiction:
            self.contradiction = f"the contact is {depth * 1e3:.1f} mm deep, which is over {limit * 1e3:g} mm"

    def _compare(self, now: Array) -> None:
        """Each of the kept beliefs against that of now: the worst is the doubt."""
        self.doubt = 0.0
        if not self._count:
            return
        kept, settings = self._bins[: self._count], self.settings
        since = now[_TIME] - kept[:, _TIME]
        moved, turned = self._own_motion(since)
        slid = now[_SLID] - kept[:, _SLID]
        apart = now[_OFFSET] - kept[:, _OFFSET]
        room = settings.depth_error + settings.normal_error * slid + moved
        into = now[_INTO] - kept[:, _INTO]
        given = np.where(apart * into < 0.0, np.minimum(np.abs(into), settings.yields), 0.0)  # or come back
        self._judge(np.abs(apart) / (room + given), self._depth_text, now)
        angle = np.arccos(np.clip(kept[:, _NORMAL] @ now[_NORMAL], -1.0, 1.0))
        room = settings.angle_error + settings.curvature * slid + turned
        self._judge(angle / room, self._normal_text, now)
        back = (kept[:, _SHEARED] - now[_SHEARED]) / (settings.shear_error + moved)
        self._judge(back, self._shear_text, now)
        back = (kept[:, _TWISTED] - now[_TWISTED]) / (settings.twist_error + turned)
        self._judge(back, self._twist_text, now)

    def _own_motion(self, since: Array | float) -> tuple[Array | float, Array | float]:
        """How far (m) and by how much (rad) the surface may have moved by itself in this time, s."""
        free = self.moves or not self.settings.rests_at_first
        speed, rate = (self.settings.speed, self.settings.turn_rate) if free else (0.0, 0.0)
        return speed * since, rate * since

    def _judge(self, parts: Array, text: Callable[[Array, Array], str], now: Array) -> None:
        worst = int(parts.argmax())
        self._doubt(float(parts[worst]), lambda: text(self._bins[worst], now))

    def _doubt(self, part: float, text: Callable[[], str]) -> None:
        self.doubt = max(self.doubt, part)
        if part > 1.0 and not self.contradiction:
            self.contradiction = f"{text()}: the estimates contradict the arm's motion"

    def _jumped(self, since: float, apart: float) -> None:
        """One belief that is far from the last one need not wait for the mean of some.

        A surface that moves goes on as it did between the two before, but for its acceleration.
        """
        moved = float(self._own_motion(since)[0])
        expected, room = 0.0, moved
        if self._rate is not None:
            expected = min(max(self._rate * since, -moved), moved)
            room = min(moved, ACCELERATION * since * since)
        self._rate = apart / since
        if abs(apart - expected) > JUMP * self.settings.depth_error + room:
            way = "deeper" if apart > 0.0 else "less deep"
            went = f"{abs(apart) * 1e3:.1f} mm {way}"
            self._doubt(2.0, lambda: f"within {since:.2f} s the contact went {went} by itself")

    # ---- in words ----

    def _depth_text(self, then: Array, now: Array) -> str:
        since, into = now[_TIME] - then[_TIME], now[_INTO] - then[_INTO]
        apart = now[_OFFSET] - then[_OFFSET]
        deeper = apart + into
        contact = f"{abs(deeper) * 1e3:.1f} mm {'deeper' if deeper >= 0.0 else 'less deep'}"
        arm = f"{abs(into) * 1e3:.1f} mm {'into' if into >= 0.0 else 'out of'} it"
        return f"within {since:.1f} s the contact went {contact} while the arm went {arm}"

    def _normal_text(self, then: Array, now: Array) -> str:
        cosine = float(then[_NORMAL] @ now[_NORMAL])
        angle, slid = math.degrees(math.acos(min(1.0, cosine))), (now[_SLID] - then[_SLID]) * 1e3
        since = now[_TIME] - then[_TIME]
        return f"within {since:.1f} s the surface's normal turned by {angle:.1f} degrees over {slid:.1f} mm"

    def _shear_text(self, then: Array, now: Array) -> str:
        back, since = (then[_SHEARED] - now[_SHEARED]) * 1e3, now[_TIME] - then[_TIME]
        return f"within {since:.1f} s the contact slid {back:.1f} mm against its own shear"

    def _twist_text(self, then: Array, now: Array) -> str:
        back, since = math.degrees(then[_TWISTED] - now[_TWISTED]), now[_TIME] - then[_TIME]
        return f"within {since:.1f} s the contact turned {back:.0f} degrees against its own twist"


class _Middle:
    """The mean of some beliefs: T_base_feature and T_base_sensor, (4, 4) and nearly rigid."""

    def __init__(self, T_base_feature: Array, T_base_sensor: Array) -> None:
        self.feature: list[float] = T_base_feature[:3, 3].tolist()
        self.x: list[float] = T_base_feature[:3, 0].tolist()
        self.y: list[float] = T_base_feature[:3, 1].tolist()
        n = T_base_feature[:3, 2].tolist()
        size = math.sqrt(_dot(n, n)) or 1.0
        self.normal = [part / size for part in n]
        p, sensor_x = T_base_sensor[:3, 3].tolist(), T_base_sensor[:3, 0].tolist()
        lead = [a - b for a, b in zip(p, self.feature, strict=True)]
        depth = _dot(lead, self.normal)
        self.shear = [a - depth * b for a, b in zip(lead, self.normal, strict=True)]
        self.twist = math.atan2(_dot(sensor_x, self.y), _dot(sensor_x, self.x))

    def slid_along(self, before: _Middle) -> tuple[float, float]:
        """How far the feature slid (m) and turned (rad) since then along with shear and twist."""
        shear = [0.5 * (a + b) for a, b in zip(self.shear, before.shear, strict=True)]
        size = max(math.sqrt(_dot(shear, shear)), LEAST_SHEAR)
        moved = [a - b for a, b in zip(self.feature, before.feature, strict=True)]
        along = _dot(moved, self.normal)
        across = [a - along * b for a, b in zip(moved, self.normal, strict=True)]
        twist = 0.5 * (self.twist + before.twist)
        turned = math.atan2(_dot(self.x, before.y), _dot(self.x, before.x))
        return _dot(across, shear) / size, turned * twist / max(abs(twist), LEAST_TURN)


def _dot(a: list[float], b: list[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
