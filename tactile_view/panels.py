"""What stands beside the cell: tactile image, belief over time, twists, latency, and the state in words."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from tactile_base.stamps import SECOND_NS
from tactile_perception.estimating.image import gray, in_color
from tactile_records.replay.images import image_of
from tactile_records.runs.euler_poses import (
    UNITS,
    component,
    euler_poses,
    euler_sigmas,
    inverses,
)
from tactile_records.runs.record import GaussianSeries
from tactile_view.cell_state import WINDOW, ArmState, Types
from tactile_view.in_loop import handler
from tactile_view.marker_picture import marker_picture
from tactile_view.words import BOX, estimate_in_words, latency_in_words, set_html

Array = NDArray[Any]

PLAIN, MARKERS = "the image", "markers and density"
MOST_POINTS = 300  # of a line
BELIEF, REFERENCE, TRUTH, BAND = "#1e78dc", "#787878", "#14963c", "rgba(30, 120, 220, 0.18)"
SMALL_PLOT, IMAGE_WIDTH = 150, 480  # pixels
ROOM, MOST_ROOM = 0.3, 5.0  # times the numbers' own range: beside them; of all of it
LEAST_RANGE = 0.2  # mm or deg, so that noise does not fill a chart
NO_IMAGE = "no image: a recording has them if it was made with --record-images<br>"
ORDER = "z", "alpha", "beta", "x", "y", "gamma"  # in which a user wants to see them


def thinned(n: int) -> slice:
    """Every so manieth of n points, so that no more than MOST_POINTS are left."""
    return slice(None, None, max(1, math.ceil(n / MOST_POINTS)))


class Plot:
    """One small chart over the last seconds, made of lines; the first two may be the edges of a band."""

    def __init__(
        self, server: viser.ViserServer, title: str, lines: Iterable[tuple[str, str]], band: bool = False
    ) -> None:
        series = [uplot.Series(label="s")]
        series += [
            uplot.Series(label=label, stroke=color, width=1.5 if color != BAND else 0.0)
            for label, color in lines
        ]
        self._range = 0.0, 1.0
        self._handle = server.gui.add_uplot(
            data=tuple(np.zeros(1) for _ in series),
            series=tuple(series),
            bands=(uplot.Band(series=(2, 1), fill=BAND),) if band else None,
            scales=_scales(*self._range),
            title=title,
            height=SMALL_PLOT,
            legend=uplot.Legend(show=False),
        )

    def show(self, seconds: Array, *lines: Array) -> None:
        """Draw lines (N,) over times (N,); NaN is a gap."""
        values = np.array([line[thinned(len(seconds))] for line in lines], dtype=np.float64)
        if not np.isfinite(values).any():
            return
        self._fit(float(np.nanmin(values)), float(np.nanmax(values)))
        self._handle.data = (seconds[thinned(len(seconds))], *values)

    def _fit(self, low: float, high: float) -> None:
        """Another range where these do not fit, or get lost: for one the page makes the chart anew."""
        span, (bottom, top) = max(high - low, LEAST_RANGE), self._range
        if bottom <= low and high <= top and top - bottom < MOST_ROOM * span:
            return
        self._range = low - ROOM * span, high + ROOM * span
        self._handle.scales = _scales(*self._range)


def _scales(low: float, high: float) -> dict[str, uplot.Scale]:
    """Our own range: to find one, uPlot would take NaN for a number."""
    return {
        "x": uplot.Scale(time=False, range=(-WINDOW, 0.0)),
        "y": uplot.Scale(range=(low, high)),
    }


class TouchPanel:
    """The tactile image, with its markers if wanted, and what the network has made of it, in words."""

    def __init__(self, server: viser.ViserServer, types: Types) -> None:
        self._types, self._shown, self._markers = types, 0, ""
        self.choice: Any = server.gui.add_dropdown("show", (PLAIN, MARKERS))
        self.choice.on_update(handler(lambda event: self._draw_anew()))
        self._image = server.gui.add_image(
            np.full((4, 4, 3), 235, np.uint8), label="tactile image", format="jpeg", visible=False
        )
        self._words = server.gui.add_html("no image yet")

    def show(self, state: ArmState) -> None:
        """Show the newest image and estimate."""
        message = state.image
        if message is None:
            set_html(self._words, NO_IMAGE + estimate_in_words(state))
            return
        if message.received_ns != self._shown:
            self._shown = message.received_ns
            found = image_of(self._types(message.type).fielddefs, message, color=True)
            if found.pixels is None:
                set_html(self._words, f"image refused: {escape(found.fault)}")
                return
            self._draw(found.pixels)
        set_html(self._words, self._markers + estimate_in_words(state))

    def _draw_anew(self) -> None:
        self._shown = 0

    def _draw(self, pixels: Array) -> None:
        if not self._image.visible:  # until there is one
            self._image.visible = True
        if self.choice.value == MARKERS:
            self._image.image, words = marker_picture(gray(pixels))
            self._markers = f"{escape(words)}<br>"
            return
        every = max(1, round(pixels.shape[1] / IMAGE_WIDTH))
        self._image.image, self._markers = in_color(pixels[::every, ::every])[:, :, ::-1], ""


class BeliefPanel:
    """Each component of the belief, with two standard deviations, against its reference and the truth."""

    def __init__(self, server: viser.ViserServer) -> None:
        lines = (("-2σ", BAND), ("+2σ", BAND), ("belief", BELIEF), ("reference", REFERENCE), ("truth", TRUTH))
        words = (
            "Sensor in the feature frame: <span style='color:#1e78dc'>belief, ± 2σ</span>, "
            "<span style='color:#787878'>reference</span>, <span style='color:#14963c'>truth</span>, of the "
            f"last {WINDOW:g} s"
        )
        server.gui.add_html(BOX.format(words))
        self._plots = {}
        for name in ORDER:
            column, _, what = component(name)
            self._plots[column] = Plot(server, what, lines, band=True)

    def show(self, state: ArmState, now_ns: int) -> None:
        """Draw the last seconds."""
        rows = list(state.streams["belief"])
        if len(rows) < 2:
            return
        stamps = np.array([row["stamp_ns"] for row in rows])
        part = thinned(len(rows))
        series = GaussianSeries(
            stamps[part], np.array([r["mean"] for r in rows[part]]), np.array([r["cov"] for r in rows[part]])
        )
        mean, sigma = euler_poses(inverses(series.mean)) * UNITS, euler_sigmas(series) * UNITS
        reference = held(state, "command", "reference", series.stamp_ns, 6) * UNITS
        truth = self._truth(state, series.stamp_ns) * UNITS
        seconds = (series.stamp_ns - now_ns) / SECOND_NS
        for k, plot in self._plots.items():
            low, high = mean[:, k] - 2 * sigma[:, k], mean[:, k] + 2 * sigma[:, k]
            plot.show(seconds, low, high, mean[:, k], reference[:, k], truth[:, k])

    def _truth(self, state: ArmState, stamps: Array) -> Array:
        poses = held(state, "truth", "T_fs", stamps, 4, 4)
        touching = held(state, "truth", "in_contact", stamps)
        poses[touching != 1.0] = np.nan
        return euler_poses(poses)


def held(state: ArmState, stream: str, name: str, stamps: Array, *shape: int) -> Array:
    """A column of a stream at other stamps (N, ...): the last row at or before each; NaN before the first."""
    found = np.full((len(stamps), *shape), np.nan)
    rows = list(state.streams[stream])
    if rows:
        index = np.searchsorted([row["stamp_ns"] for row in rows], stamps, side="right") - 1
        values = np.array([row[name] for row in rows], dtype=np.float64)
        found[index >= 0] = values[index[index >= 0]]
    return found


class MotionPanel:
    """Twist that the task wants against what the arm does, and the latency of each stage."""

    def __init__(self, server: viser.ViserServer) -> None:
        lines = (("wanted", REFERENCE), ("sent", BELIEF), ("arm", TRUTH))
        words = (
            "<span style='color:#787878'>wanted</span>, <span style='color:#1e78dc'>sent</span> and "
            "<span style='color:#14963c'>done by the arm</span>"
        )
        server.gui.add_html(BOX.format(words))
        names = (*(f"v{axis} (mm/s)" for axis in "xyz"), *(f"ω{axis} (deg/s)" for axis in "xyz"))
        self._plots = [Plot(server, name, lines) for name in names]
        self._latency = server.gui.add_html("")

    def show(self, state: ArmState, now_ns: int) -> None:
        """Draw the last seconds."""
        rows = list(state.streams["command"])
        if len(rows) > 1:
            rows = rows[thinned(len(rows))]
            stamps = np.array([row["stamp_ns"] for row in rows])
            wanted, sent = (np.array([row[name] for row in rows]) * UNITS for name in ("unlimited", "twist"))
            done = held(state, "arm_twist", "twist", stamps, 6) * UNITS
            for k, plot in enumerate(self._plots):
                plot.show((stamps - now_ns) / SECOND_NS, wanted[:, k], sent[:, k], done[:, k])
        set_html(self._latency, latency_in_words(state))
