"""Numbers of a run: what report.json holds, from a `RunRecord`.

Everything about quality is taken over the task's own phase (follow, track), against the truth at the same
exposure stamps. The meaning and unit of each number are in `REPORT_FIELDS`, which is the schema: a report
has these names, no others; a number that cannot be computed from the record (no truth on a real arm) is null.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_records.runs.euler_poses import COMPONENTS, UNITS, euler_poses, euler_sigmas, inverses
from tactile_records.runs.record import GaussianSeries, PresenceSeries, RunRecord, StageSeries, TruthSeries

Array = NDArray[Any]

SETTLED_AFTER = 1.0  # s of following before oscillation is looked for: the feedforward has come in by then
OSCILLATION_ABOVE = 0.5  # Hz: slower is the surface's own shape at 10 mm/s
COMMAND_STAGE = "controller"  # the stage whose latency is that of the loop: exposure to command emission

HEAD_FIELDS: dict[str, str] = {
    "scene": "name of the scene",
    "task": "name of the task",
    "task_file": "name of the task file",
    "role": "what the arm does in it",
    "arm": "name of the arm",
    "source": "offline (loop in one process) or ros (nodes)",
    "seed": "seed of the simulated cell",
    "succeeded": "the task did all that it was asked to",
    "reason": "why it failed, in words; empty where it did not",
    "complaints": "what nodes complained about then, each with its node",
    "duration_s": "from the first command to the last",
    "wall_s": "wall-clock time of the run",
    "bag_problem": "what the bag lacks, and why; empty where it lacks nothing, and without a bag",
}

REPORT_FIELDS: dict[str, str] = {
    **HEAD_FIELDS,
    "work_s": "time spent at work: following, tracking",
    "path_length_mm": "arc length of the sensor's centre at work, all goals",
    "speed_mm_s": "path length over time, after the feedforward has come in",
    "contact_fraction": "part of the work with true contact (0..1)",
    "depth_rms_mm": "RMS of true depth less reference depth",
    "depth_bias_mm": "mean of true depth less reference depth",
    "depth_max_mm": "largest absolute value of the same",
    "normal_rms_deg": "RMS angle between the sensor's axis and the reference axis at the true surface normal",
    "normal_max_deg": "largest of these angles",
    "slip_fraction": "mean part of the contact that slides (0..1)",
    "depth_overshoot_mm": "largest true depth over the reference while settling and following",
    "oscillation.depth_mm": f"amplitude of the strongest sinusoid above {OSCILLATION_ABOVE} Hz in true depth",
    "oscillation.depth_hz": "its frequency",
    "oscillation.normal_deg": f"the same for the two tilt angles, above {OSCILLATION_ABOVE} Hz",
    "oscillation.normal_hz": "its frequency",
    "estimate.depth_rms_mm": "RMS error of the estimator's depth",
    "estimate.depth_bias_mm": "its mean error",
    "estimate.normal_rms_deg": "RMS error of the estimated surface normal",
    "belief.depth_rms_mm": "RMS error of the filter's depth",
    "belief.depth_bias_mm": "its mean error",
    "belief.normal_rms_deg": "RMS error of the believed surface normal",
    "belief.depth_in_2_sigma": "part of the beliefs whose true depth lies within 2 sigma (0..1)",
    "belief.nis_per_dof": "mean of NIS over its degrees of freedom (1 for a consistent filter)",
    "belief.refused": "measurements refused by the gate while following",
    "contact.*.bias": "mean error of the believed contact pose in this component (mm, deg)",
    "contact.*.rms": "RMS error of the believed contact pose in this component (mm, deg)",
    "contact.*.in_2_sigma": "part of the beliefs whose true component lies within 2 sigma (0..1)",
    "novelty.mean": "how unlike the training images those in contact were, foreign above 1",
    "novelty.max": "the largest of them",
    "force.mean_n.*": "mean of the believed force on the sensor at work, x, y, z in its frame (N)",
    "force.deviation_n.*": "its standard deviation (N)",
    "force.largest_n": "the largest believed force (N)",
    "force.reference_n": "reference of the normal force (N); where there is one",
    "force.normal_rms_n": "RMS of the believed normal force about it, from a second after the work began",
    "force.normal_bias_n": "its mean deviation",
    "force.nis_per_dof": "mean of the force's NIS over its 3 degrees of freedom (1 for a consistent filter)",
    "latency_ms.p50": "median time from exposure to command emission",
    "latency_ms.p99": "its 99th percentile",
    "latency_ms.max": "its largest",
    "latency_ms.stages.*.p50": "median time from exposure to the output of this stage",
    "latency_ms.stages.*.p99": "its 99th percentile",
    "latency_ms.stages.*.max": "its largest",
    "frames.exposed": "images exposed in the run",
    "frames.estimated": "images with an estimate",
    "frames.believed": "images with a belief",
    "frames.commands": "commands emitted",
    "frames.lost.*": "frames lost by this stage (dropped and counted)",
    "frames.lost_at_work": "those of them lost while the task was at work, all stages",
    "frames.silent": "frames that a stage neither answered nor counted as dropped",
    "goals.*.succeeded": "this goal was reached",
    "goals.*.length_mm": "its way while at work",
    "goals.*.contact_fraction": "as above, of this goal",
    "goals.*.depth_rms_mm": "as above, of this goal",
    "goals.*.normal_rms_deg": "as above, of this goal",
    "goals.*.normal_max_deg": "as above, of this goal",
}


def report(record: RunRecord) -> dict[str, Any]:
    """All numbers of the run, nested as the names of `REPORT_FIELDS` are dotted."""
    following = record.working(record.truth.stamp_ns)
    truth = record.truth.rows(following)
    return {
        **head(record),
        **_motion(record),
        **_quality(truth, record.reference_at(truth.stamp_ns)),
        "slip_fraction": mean(truth.slip_fraction),
        "depth_overshoot_mm": _overshoot_mm(record),
        "oscillation": oscillation(record),
        "estimate": _errors(record, record.estimate),
        "belief": _errors(record, record.belief) | _consistency(record),
        "contact": _components(record),
        "novelty": _novelty(record.presence),
        **({"force": _force(record)} if len(record.force) else {}),
        "latency_ms": _latency(record),
        "frames": _frames(record),
        "goals": {name: _goal(record, index, truth) for index, name in enumerate(record.goals)},
    }


def head(record: RunRecord) -> dict[str, Any]:
    """What the report of any arm begins with: `HEAD_FIELDS`."""
    of_record = ("scene", "task", "task_file", "role", "arm", "source", "seed")
    return {
        **{name: getattr(record, name) for name in of_record},
        "succeeded": bool(record.result.get("succeeded", False)),
        "reason": str(record.result.get("reason", "")),
        "complaints": list(record.result.get("complaints", [])),
        "duration_s": duration(record.command.stamp_ns),
        "wall_s": record.result.get("wall_s"),
        "bag_problem": str(record.result.get("bag_problem", "")),
    }


# ---- parts of the report ----


def depth_of(X_fs: Array) -> Array:
    """Depth (N,) m of contact poses (N, 4, 4)."""
    return X_fs[:, 2, 3]


def normal_angle(X_fs: Array, reference: Array) -> Array:
    """Angle (N,) rad between surface normals in {s} and those of Euler reference contact poses (N, 6).

    NaN where there is no reference (NaN).
    """
    angle, known = np.full(len(X_fs), np.nan), np.isfinite(reference).all(axis=1)
    kinds, which = np.unique(reference[known], axis=0, return_inverse=True)
    wanted = np.array([se3.pose_from_euler(kind)[2, :3] for kind in kinds]).reshape(-1, 3)
    angle[known] = angle_between(X_fs[known, 2, :3], wanted[which.ravel()])
    return angle


def oscillation(record: RunRecord) -> dict[str, float]:
    """Strongest sinusoid above `OSCILLATION_ABOVE` in true depth and tilt, of all paths, once settled."""
    found = {"depth_mm": 0.0, "depth_hz": np.nan, "normal_deg": 0.0, "normal_hz": np.nan}
    any_signal = False
    for stamps, X_fs in _settled_stretches(record):
        any_signal = True
        signals = {
            ("depth_mm", "depth_hz"): [depth_of(X_fs) * 1e3],
            ("normal_deg", "normal_hz"): [np.degrees(X_fs[:, 2, 0]), np.degrees(X_fs[:, 2, 1])],
        }
        for (size, rate), series in signals.items():
            amplitude, frequency = max(strongest_sinusoid(stamps, values) for values in series)
            if amplitude > found[size]:
                found[size], found[rate] = amplitude, frequency
    return found if any_signal else dict.fromkeys(found, np.nan)


def strongest_sinusoid(
    stamp_ns: Array, values: Array, above_hz: float = OSCILLATION_ABOVE
) -> tuple[float, float]:
    """Amplitude and frequency (Hz) of the strongest spectral line above `above_hz`; (0, nan) where too short.

    A cubic trend is removed and a Hann window applied; the amplitude is that of a sinusoid with this line.
    """
    n = len(values)
    seconds = (stamp_ns - stamp_ns[0]) * 1e-9 if n else np.zeros(0)
    if n < 16 or seconds[-1] * above_hz < 1.0:
        return 0.0, np.nan
    even = np.linspace(0.0, seconds[-1], n)
    signal = np.interp(even, seconds, values)
    signal = signal - np.polyval(np.polyfit(even, signal, 3), even)
    window = np.hanning(n)
    amplitude = 2.0 * np.abs(np.fft.rfft(signal * window)) / window.sum()
    frequency = np.fft.rfftfreq(n, even[1])
    high = frequency >= above_hz
    best = int(np.argmax(np.where(high, amplitude, -1.0)))
    return float(amplitude[best]), float(frequency[best])


def _settled_stretches(record: RunRecord) -> Iterator[tuple[Array, Array]]:
    """Stamps and true contact poses of each path's following, without its first second."""
    truth = record.truth
    following = record.working(truth.stamp_ns)
    path = record.goal_at(truth.stamp_ns)
    for index in np.unique(path[following]):
        rows = truth.rows(following & (path == index))
        late = rows.stamp_ns >= rows.stamp_ns[0] + SETTLED_AFTER * 1e9
        if late.any():
            yield rows.stamp_ns[late], rows.T_fs[late]


def _motion(record: RunRecord) -> dict[str, float]:
    pose = record.pose
    following = record.working(pose.stamp_ns)
    path = record.goal_at(pose.stamp_ns)
    length, seconds, late_length, late_seconds = 0.0, 0.0, 0.0, 0.0
    for index in np.unique(path[following]):
        rows = pose.rows(following & (path == index))
        length += arc_length(rows.T_base_sensor)
        seconds += duration(rows.stamp_ns)
        late = rows.rows(rows.stamp_ns >= rows.stamp_ns[0] + SETTLED_AFTER * 1e9)
        late_length += arc_length(late.T_base_sensor)
        late_seconds += duration(late.stamp_ns)
    speed = late_length / late_seconds if late_seconds > 0.0 else np.nan
    return {"work_s": seconds, "path_length_mm": length * 1e3, "speed_mm_s": speed * 1e3}


def arc_length(T_base_sensor: Array) -> float:
    """Length (m) of the polygon through the positions of poses (N, 4, 4)."""
    return float(np.linalg.norm(np.diff(T_base_sensor[:, :3, 3], axis=0), axis=1).sum())


def _quality(truth: TruthSeries, reference: Array) -> dict[str, float]:
    """Of the truth at some stamps against the reference contact poses (N, 6) in force there."""
    error_mm = (depth_of(truth.T_fs) - reference[:, 2]) * 1e3
    angle_deg = np.degrees(normal_angle(truth.T_fs, reference))
    return {
        "contact_fraction": mean(truth.in_contact),
        "depth_rms_mm": rms(error_mm),
        "depth_bias_mm": mean(error_mm),
        "depth_max_mm": largest(np.abs(error_mm)),
        "normal_rms_deg": rms(angle_deg),
        "normal_max_deg": largest(angle_deg),
    }


def _goal(record: RunRecord, index: int, following_truth: TruthSeries) -> dict[str, Any]:
    truth = following_truth.rows(record.goal_at(following_truth.stamp_ns) == index)
    pose = record.pose
    chosen = (record.working(pose.stamp_ns)) & (record.goal_at(pose.stamp_ns) == index)
    phases = record.command.phase[record.command.goal == index]
    quality = _quality(truth, record.reference_at(truth.stamp_ns))
    wanted = ("contact_fraction", "depth_rms_mm", "normal_rms_deg", "normal_max_deg")
    return {
        "succeeded": bool(len(phases) and phases[-1] == "done"),
        "length_mm": arc_length(pose.T_base_sensor[chosen]) * 1e3,
        **{name: quality[name] for name in wanted},
    }


def _overshoot_mm(record: RunRecord) -> float:
    rows = record.truth.rows(np.isin(record.phase_at(record.truth.stamp_ns), ("settle", record.work)))
    over = depth_of(rows.T_fs) - record.reference_at(rows.stamp_ns)[:, 2]
    return float(np.maximum(0.0, over.max() * 1e3)) if len(over) else np.nan


def _errors(record: RunRecord, series: GaussianSeries) -> dict[str, float]:
    """Errors of Gaussians over X_sf against the truth of the same exposure, while following."""
    mine, true = _matched(record, series)
    X_fs, T_fs = inverses(series.mean[mine]), record.truth.T_fs[true]
    depth_mm = (depth_of(X_fs) - depth_of(T_fs)) * 1e3
    angle_deg = np.degrees(angle_between(X_fs[:, 2, :3], T_fs[:, 2, :3]))
    return {"depth_rms_mm": rms(depth_mm), "depth_bias_mm": mean(depth_mm), "normal_rms_deg": rms(angle_deg)}


def _components(record: RunRecord) -> dict[str, dict[str, float]]:
    """Of the belief in each component of the Euler contact pose, against the truth of the same exposure."""
    mine, true = _matched(record, record.belief)
    belief = record.belief.rows(mine)
    errors = (euler_poses(inverses(belief.mean)) - euler_poses(record.truth.T_fs[true])) * UNITS
    sigmas = euler_sigmas(belief) * UNITS
    return {
        name: {
            "bias": mean(errors[:, k]),
            "rms": rms(errors[:, k]),
            "in_2_sigma": mean(np.abs(errors[:, k]) <= 2.0 * sigmas[:, k]),
        }
        for k, name in enumerate(COMPONENTS)
    }


def _consistency(record: RunRecord) -> dict[str, float | int]:
    belief = record.belief
    mine, true = _matched(record, belief)
    error = depth_of(inverses(belief.mean[mine])) - depth_of(record.truth.T_fs[true])
    within = np.abs(error) <= 2.0 * euler_sigmas(belief.rows(mine))[:, 2]
    with_nis = np.isfinite(belief.nis[mine]) & (belief.nis_dof[mine] > 0)
    per_dof = belief.nis[mine][with_nis] / belief.nis_dof[mine][with_nis]
    return {
        "depth_in_2_sigma": mean(within),
        "nis_per_dof": mean(per_dof),
        "refused": int(np.count_nonzero(~belief.accepted[mine])),
    }


def _matched(record: RunRecord, series: GaussianSeries) -> tuple[Array, Array]:
    """Rows of the series and of the truth that have the same exposure stamp and lie in the follow phase."""
    common, mine, true = np.intersect1d(series.stamp_ns, record.truth.stamp_ns, return_indices=True)
    following = record.working(common)
    return mine[following], true[following]


def _novelty(presence: PresenceSeries) -> dict[str, float]:
    known = presence.novelty[presence.in_contact & np.isfinite(presence.novelty)]
    return {"mean": mean(known), "max": largest(known)}


def _force(record: RunRecord) -> dict[str, Any]:
    """Of what is believed of the force while at work."""
    series = record.force.rows(record.working(record.force.stamp_ns))
    columns = series.force.T
    return {
        "mean_n": dict(zip("xyz", map(mean, columns), strict=True)),
        "deviation_n": {
            axis: rms(column - mean(column)) for axis, column in zip("xyz", columns, strict=True)
        },
        "largest_n": largest(np.linalg.norm(series.force, axis=1)),
        "nis_per_dof": mean(series.nis[np.isfinite(series.nis)]) / 3.0,
        **_about_reference(record),
    }


def _about_reference(record: RunRecord) -> dict[str, float]:
    """How far the believed normal force is from the reference that the controller's settings name."""
    reference = float(record.settings.get("controller", {}).get("force.normal", 0.0))
    if not reference:
        return {}
    belief, force = record.belief, record.force
    at = np.searchsorted(belief.stamp_ns, force.stamp_ns).clip(0, max(0, len(belief) - 1))
    work = record.working(force.stamp_ns)
    begun = force.stamp_ns >= (force.stamp_ns[work][0] + SECOND_NS if work.any() else 0)
    chosen = work & begun & (belief.stamp_ns[at] == force.stamp_ns)
    normal = np.abs(np.einsum("ni,ni->n", belief.mean[at[chosen], :3, 2], force.force[chosen]))
    return {
        "reference_n": reference,
        "normal_rms_n": rms(normal - reference),
        "normal_bias_n": mean(normal - reference),
    }


def _latency(record: RunRecord) -> dict[str, Any]:
    stages = {
        stage: _percentiles_ms(series.seconds[record.working(series.stamp_ns)])
        for stage, series in record.latency.items()
    }
    return _percentiles_ms(_loop_latency(record)) | {"stages": stages}


def _loop_latency(record: RunRecord) -> Array:
    """Seconds from exposure to the first command based on it, of those acted upon while following."""
    stage = record.latency.get(COMMAND_STAGE)
    if stage is not None and len(stage):
        return stage.seconds[record.working(stage.stamp_ns)]
    command = record.command
    used = (command.exposure_ns > 0) & (command.phase == record.work)
    exposure, first = np.unique(command.exposure_ns[used], return_index=True)
    return (command.stamp_ns[used][first] - exposure) * 1e-9


def _percentiles_ms(seconds: Array) -> dict[str, float]:
    found = np.percentile(seconds * 1e3, [50.0, 99.0, 100.0]) if len(seconds) else np.full(3, np.nan)
    return dict(zip(("p50", "p99", "max"), found.tolist(), strict=True))


def _frames(record: RunRecord) -> dict[str, Any]:
    return {
        "exposed": len(record.truth) or len(record.presence),
        "estimated": len(record.estimate),
        "believed": len(record.belief),
        "commands": len(record.command),
        "lost": record.lost,
        "lost_at_work": sum(_lost_at_work(record, series) for series in record.latency.values()),
        "silent": _silent(record),
    }


def _lost_at_work(record: RunRecord, series: StageSeries) -> int:
    """Frames that a stage dropped before an answer at work, since the one before."""
    lost = np.diff(series.dropped, prepend=series.dropped[:1])
    return int(lost[record.working(series.stamp_ns)].sum())


def _silent(record: RunRecord) -> int:
    """Frames that a stage answered, and the next one neither answered nor counted while both were at work."""
    stages = [(stage, series.stamp_ns) for stage, series in record.latency.items()]
    silent = 0
    for (_, given), (stage, answered) in itertools.pairwise(stages):
        if len(given) and len(answered):
            asked = given[(given >= answered[0]) & (given <= answered[-1])]
            missing = len(np.setdiff1d(asked, answered))
            silent += max(0, missing - record.lost.get(stage, 0))
    return silent


# ---- small things ----


def angle_between(a: Array, b: Array) -> Array:
    """Angle (N,) rad between rows of unit vectors, exact near 0 and pi."""
    cross = np.linalg.norm(np.cross(a, np.broadcast_to(b, a.shape)), axis=1)
    return np.arctan2(cross, np.sum(a * b, axis=1))


def duration(stamp_ns: Array) -> float:
    return float(stamp_ns[-1] - stamp_ns[0]) * 1e-9 if len(stamp_ns) else 0.0


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan


def mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def largest(values: Array) -> float:
    return float(np.max(values)) if len(values) else np.nan


def without_nan(value: Any) -> Any:
    """Numbers as JSON has them: what is not finite becomes null."""
    if isinstance(value, dict):
        return {name: without_nan(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def text(value: float | None, unit: str, digits: int) -> str:
    return "unknown" if value is None or not math.isfinite(value) else f"{value:.{digits}f} {unit}"


def task_row(values: Mapping[str, Any]) -> tuple[str, str, str]:
    """The first row of a summary."""
    return "task", "succeeded" if values["succeeded"] else f"failed: {values['reason']}", ""


def loop_rows(values: Mapping[str, Any], p50: str = "", p99: str = "") -> list[tuple[str, str, str]]:
    """Its last ones: latency, with what its percentiles have to be, and frames that were lost."""
    latency, frames = values["latency_ms"], values["frames"]
    return [
        ("latency p50", text(latency["p50"], "ms", 1), p50),
        ("latency p99", text(latency["p99"], "ms", 1), p99),
        (
            "frames dropped and counted",
            f"{sum(frames['lost'].values())}, {frames['lost_at_work']} at work",
            "",
        ),
        ("frames lost in silence", str(frames["silent"]), "0"),
    ]


def percent(value: float | None) -> str:
    return "unknown" if value is None or not math.isfinite(value) else f"{100.0 * value:.1f} %"
