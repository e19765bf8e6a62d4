"""The calibrations of a cell by name: from a run of an arm, and what its scene says, to a `Result`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_records.calibrating import mounting as mountings
from tactile_records.calibrating import time_offset
from tactile_records.calibrating import tip as tips
from tactile_records.calibrating.result import Result
from tactile_records.calibrating.touches import touches_of
from tactile_records.runs.record import RunRecord
from tactile_scene.scene import SensorScene

Array = NDArray[np.float64]
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


def tip(record: RunRecord, sensor: SensorScene) -> Result:
    """The tip's centre in the tool, by all touches of a run."""
    from tactile_records.calibrating import figures

    touches = touches_of(record)
    found = tips.estimated(np.array([touch.T_base_sensor for touch in touches]).reshape(-1, 4, 4))
    T_tool_sensor = sensor.T_tool_sensor.copy()
    T_tool_sensor[:3, 3] += sensor.T_tool_sensor[:3, :3] @ found.offset
    offset, sigma = 1e3 * found.offset, 1e3 * found.sigma
    along = f"{offset[2]:.2f} mm, sigma {sigma[2]:.2f} mm"
    if not found.along_observed:
        along = "is not told by these tilts: it stays as the scene says"
    return Result(
        numbers={
            "offset_mm": offset.tolist(),
            "sigma_mm": sigma.tolist(),
            "along_observed": found.along_observed,
            "residual_mm": 1e3 * found.residual,
            "touches": len(touches),
            "normal": found.normal.tolist(),
        },
        lines=(
            "the tip's centre, from where the scene says:",
            f"across the axis {offset[0]:.2f}, {offset[1]:.2f} mm, sigma {sigma[:2].max():.2f} mm",
            f"along the axis {along}",
            f"residual {1e3 * found.residual:.3f} mm over {len(touches)} touches",
        ),
        agrees=bool((np.abs(found.offset) <= AGREES * found.sigma).all()),
        sensor={"in_tool": pose_values(T_tool_sensor)},
        draw=lambda: figures.tip(found, touches),
    )


def mounting(record: RunRecord, sensor: SensorScene) -> Result:
    """How the sensor is turned in the tool, by all contacts of a run."""
    from tactile_records.calibrating import figures

    found = mountings.estimated(mountings.contacts_of(record))
    T_tool_sensor = sensor.T_tool_sensor.copy()
    T_tool_sensor[:3, :3] = sensor.T_tool_sensor[:3, :3] @ found.R
    turn, sigma = np.degrees(found.rotation), np.degrees(found.sigma)
    normals, motions = np.degrees(found.normal_residuals), np.degrees(found.motion_residuals)
    residuals = [float(np.sqrt(np.mean(v**2))) if len(v) else None for v in (normals, motions)]
    by_motion = "no motion along the surface"
    if residuals[1] is not None:
        by_motion = f"{residuals[1]:.2f} degrees in the direction of {len(motions)} motions"
    return Result(
        numbers={
            "rotation_deg": turn.tolist(),
            "sigma_deg": sigma.tolist(),
            "normal_residual_deg": residuals[0],
            "motion_residual_deg": residuals[1],
            "contacts": len(found.contacts),
            "shear_scale": [abs(one.turn) for one in found.contacts if len(one.moved)],
        },
        lines=(
            "the sensor's rotation vector from how the scene has it:",
            f"about its x and y {turn[0]:.2f}, {turn[1]:.2f} degrees, sigma {sigma[:2].max():.2f} degrees",
            f"about its axis {turn[2]:.2f} degrees, sigma {sigma[2]:.2f} degrees",
            f"residual {residuals[0]:.2f} degrees over {len(normals)} normals, {by_motion}",
        ),
        agrees=bool((np.abs(turn) <= AGREES * sigma).all()),
        sensor={"in_tool": pose_values(T_tool_sensor)},
        draw=lambda: figures.mounting(found),
    )


def pose_values(T: Array) -> dict[str, Any]:
    """A pose (4, 4) as scene files write it, to 0.01 mm and 0.01 degrees."""
    values = {"position": [round(float(x), 5) for x in T[:3, 3]]}
    turn = [round(float(np.degrees(x)), 2) for x in se3.euler_from_pose(T)[3:]]
    return values | ({"rotation_deg": turn} if any(turn) else {})


RESULTS: Mapping[str, Callable[[RunRecord, SensorScene], Result]] = {
    "time": time,
    "tip": tip,
    "mounting": mounting,
}
