"""The calibrations of a cell by name: from a run of an arm, and what its scene says, to a `Result`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tactile_drivers.scene import SensorScene
from tactile_records.calibrating import time_offset
from tactile_records.calibrating.result import Result
from tactile_records.runs.record import RunRecord

AGREES = 3.0  # standard deviations


def time(record: RunRecord, sensor: SensorScene) -> Result:
    """The offset between camera and arm; the run's stamps have the scene's in them already."""
    from tactile_records.calibrating import figures

    found, said = time_offset.of_record(record), sensor.settings.time_offset
    offset = said + found.seconds
    drift, drift_sigma = found.drift * 1e6, found.drift_sigma * 1e6
    return Result(
        numbers={
            "time_offset_ms": 1e3 * offset,
            "said_ms": 1e3 * said,
            "sigma_ms": 1e3 * found.sigma,
            "drift_ppm": drift,
            "drift_sigma_ppm": drift_sigma,
            "correlation": found.correlation,
            "residual_mm": 1e3 * found.residual,
            "exposures": len(found.times),
        },
        lines=(
            f"time offset {1e3 * offset:.1f} ms, sigma {1e3 * found.sigma:.1f} ms; "
            f"the scene says {1e3 * said:.1f} ms",
            f"correlation {found.correlation:.4f}, residual {1e3 * found.residual:.3f} mm over "
            f"{len(found.times)} exposures",
            f"drift {drift:.0f} ppm, sigma {drift_sigma:.0f} ppm",
        ),
        agrees=abs(found.seconds) <= AGREES * found.sigma,
        sensor={"time_offset": round(offset, 4)},
        draw=lambda: figures.time_offset(found),
    )


RESULTS: Mapping[str, Callable[[RunRecord, SensorScene], Result]] = {"time": time}
