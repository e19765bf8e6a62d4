"""Pictures of the calibrations of a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from tactile_records.runs.figures import BELIEF, ESTIMATE, REFERENCE, TRUTH

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tactile_records.calibrating.mounting import Mounting
    from tactile_records.calibrating.time_offset import TimeOffset
    from tactile_records.calibrating.tip import Tip
    from tactile_records.calibrating.touches import Touch

_SHOWN = 2.5  # s of the signals


def time_offset(found: TimeOffset) -> Figure:
    """The correlation over the offset, the signals with and without it, and the offset of each stretch."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
    left.plot(1e3 * found.tried, found.correlations, color=BELIEF)
    left.axvline(1e3 * found.seconds, color=REFERENCE, label=f"{1e3 * found.seconds:.1f} ms")
    left.set(title="Correlation", xlabel="added to the camera's stamps [ms]", ylabel="of depth and motion")
    left.legend(loc="lower left")
    centre = 0.5 * (found.times[0] + found.times[-1])
    shown = np.abs(found.times - centre) <= 0.5 * _SHOWN
    times = found.times[shown]
    middle.plot(times, 1e3 * found.depth[shown], ".", ms=4, color=ESTIMATE, label="depth in the images")
    middle.plot(times, 1e3 * found.unshifted[shown], "--", color=TRUTH, lw=1, label="arm, stamps as they are")
    middle.plot(times, 1e3 * found.explained[shown], color=REFERENCE, label="arm, offset added")
    middle.set(title="Depth while the arm moves", xlabel="time [s]", ylabel="depth [mm]")
    middle.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    sizes = 20.0 + 200.0 * found.stretch_weights
    right.scatter(found.stretch_times, 1e3 * found.stretch_offsets, s=sizes, color=BELIEF)
    mean_time = float(found.stretch_weights @ found.stretch_times)
    mean = float(found.stretch_weights @ found.stretch_offsets)
    line = mean + found.drift * (found.stretch_times - mean_time)
    right.plot(
        found.stretch_times, 1e3 * line, color=BELIEF, lw=1, label=f"drift {1e6 * found.drift:.0f} ppm"
    )
    low, high = (1e3 * (found.seconds + sign * found.sigma) for sign in (-1, 1))
    right.axhspan(low, high, color=REFERENCE, alpha=0.25, label="offset and its sigma")
    right.set(title="Stretches (size: motion in it)", xlabel="time [s]", ylabel="offset [ms]")
    right.legend(loc="lower right")
    return figure


def tip(found: Tip, touches: Sequence[Touch]) -> Figure:
    """How each touch began, how far the tip was from the plane in each, and where it is."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
    colors = plt.get_cmap("viridis")(found.tilts / max(float(found.tilts.max()), 1e-9) * 0.9)
    for touch, color in zip(touches, colors, strict=True):
        left.plot(1e3 * touch.way, touch.score, ".-", ms=4, lw=0.8, color=color)
    left.axvline(0.0, color=REFERENCE, label="taken for the first contact")
    left.set(title="Begin of each touch (light: tilted)", xlabel="way [mm]", ylabel="change in the image")
    left.legend(loc="upper left")
    numbers = np.arange(1, len(touches) + 1)
    middle.bar(numbers - 0.2, 1e3 * found.uncorrected, 0.4, color=ESTIMATE, label="tip where the scene says")
    middle.bar(numbers + 0.2, 1e3 * found.residuals, 0.4, color=BELIEF, label="tip as found")
    ticks = [f"{np.degrees(tilt):.0f}" for tilt in found.tilts]
    middle.set_xticks(numbers, ticks)
    middle.set(title="Distance from one plane", xlabel="tilt of the touch [deg]", ylabel="[mm]")
    middle.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    x, y, z = 1e3 * found.offset
    sx, sy, sz = 3e3 * found.sigma
    right.errorbar([x], [y], xerr=[sx], yerr=[sy], fmt="o", color=BELIEF, label="across: x, y")
    right.plot([0.0], [0.0], "+", ms=14, color=TRUTH, label="where the scene says")
    if found.along_observed:
        edge = 1.3 * max(abs(x) + sx, abs(y) + sy, abs(z) + sz, 0.5)
        right.errorbar([edge], [z], yerr=[sz], fmt="s", color=REFERENCE, label="along: z, at the right edge")
    right.set(title="Centre of the tip, 3 sigma", xlabel="x [mm]", ylabel="y, or z [mm]")
    right.set_aspect("equal", adjustable="datalim")
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    return figure


def mounting(found: Mounting) -> Figure:
    """Normals and motions as the network sees them and as the arm has them, and the rotation between both."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
    said, seen = (np.array([getattr(one, name) for one in found.contacts]) for name in ("said", "seen"))
    drawn = (
        (said, "o", TRUTH, "none", "arm, sensor as the scene has it"),
        (said @ found.R, "o", REFERENCE, "none", "arm, sensor turned as found"),
        (seen, ".", ESTIMATE, ESTIMATE, "network"),
    )
    for normals, marker, color, face, label in drawn:
        x, y = np.degrees(normals[:, :2].T)
        left.plot(x, y, marker, ms=9, mfc=face, color=color, label=label)
    left.set(title="Normal in each contact", xlabel="x [deg]", ylabel="y [deg]")
    left.set_aspect("equal", adjustable="datalim")
    figure.legend(loc="outside lower center", ncols=3)
    for one in found.contacts:
        if len(one.moved):
            turned = one.moved @ found.R[:2, :2]
            for points, color in ((one.moved, TRUTH), (turned, REFERENCE), (one.felt, ESTIMATE)):
                middle.plot(*(1e3 * points.T), ".", ms=2, color=color)
    middle.set(title="Motion along the surface", xlabel="x [mm]", ylabel="y [mm]")
    middle.set_aspect("equal", adjustable="datalim")
    values, errors = np.degrees(found.rotation), 3.0 * np.degrees(found.sigma)
    right.bar(["about x", "about y", "about the axis"], values, yerr=errors, color=BELIEF, capsize=6)
    right.axhline(0.0, color=TRUTH, lw=1)
    right.set(title="Rotation from the scene's, 3 sigma", ylabel="[deg]")
    return figure
