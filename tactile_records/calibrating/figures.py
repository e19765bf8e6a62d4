"""Pictures of the calibrations of a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from tactile_records.runs.figures import BELIEF, ESTIMATE, REFERENCE, TRUTH

if TYPE_CHECKING:
    from tactile_records.calibrating.time_offset import TimeOffset

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
