"""How well this machine keeps time: its kernel, how late it wakes, camera, arm, exposure to twist."""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base.stamps import SECOND_NS
from tactile_bringup.arm_check import check_rate
from tactile_bringup.findings import FAILED, LOOK, OK, Finding
from tactile_bringup.staged_arm import StagedArm
from tactile_scene.camera import CameraFrame, open_camera
from tactile_scene.scene import EXTERNAL, SIM, ArmScene

Findings = Iterator[Finding]

LISTEN = 5.0  # s
PERIOD = 0.001  # s, of what is woken
LATE = 1.0  # ms: a machine that wakes later than this has to do with something else
GOOD, BAD = 30.0, 100.0  # ms from exposure to twist: what high gains bear, and what stops the arm
CLI = [sys.executable, "-m", "tactile_bringup.cli"]
LAUNCH = [*CLI, "launch"]


def check_machine() -> Findings:
    """Kernel, cores, clock, priorities."""
    realtime = _text("/sys/kernel/realtime") == "1"
    kernel = f"{platform.release()}, {'PREEMPT_RT' if realtime else 'no real-time kernel'}"
    yield Finding(OK if realtime else LOOK, "kernel", kernel if realtime else f"{kernel}: Franka needs one")
    cores = sorted(os.sched_getaffinity(0))
    isolated = _text("/sys/devices/system/cpu/isolated")
    yield Finding(OK, "cores", f"{len(cores)}: {cores}; isolated: {isolated or 'none'} (--cores takes some)")
    files = Path("/sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor")
    governors = {_text(str(path)) for path in files}
    slow = governors - {"performance"}
    clock = ", ".join(sorted(governors)) or "not told"
    better = "; performance is steadier" if slow else ""
    yield Finding(LOOK if slow else OK, "clock of the cores", f"{clock}{better}")
    allowed = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] != 0
    text = "may be had" if allowed else "rtprio in /etc/security/limits.conf allows --priority"
    yield Finding(OK if allowed else LOOK, "real-time priority", text)


def _text(path: str) -> str:
    """The first line of a file of the kernel; '' where there is none."""
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def check_wakeups(seconds: float = LISTEN) -> Finding:
    """How late a process without a priority is woken, a thousand times a second."""
    late, due = list[float](), time.monotonic()
    while len(late) < seconds / PERIOD:
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
        late.append(time.monotonic() - due)
        due = max(due, time.monotonic() - PERIOD)
    middle, worst, most = 1e3 * np.percentile(late, [50, 99, 100])
    what_else = "" if worst < LATE else ": what else runs?"
    text = f"{middle:.2f} ms late, 99 % within {worst:.2f}, at most {most:.1f}{what_else}"
    return Finding(OK if worst < LATE else LOOK, "waking up", text)


def check_camera(arm: ArmScene) -> Findings:
    """Period, jitter and losses of the camera of an arm's sensor, if it has one of its own."""
    if arm.sensor is None or arm.sensor.camera in (SIM, EXTERNAL):
        return
    frames: list[tuple[int, CameraFrame]] = []
    camera = open_camera(arm, lambda frame: frames.append((time.time_ns(), frame)))
    time.sleep(LISTEN)
    camera.close()
    if len(frames) < 3:
        yield Finding(FAILED, "camera", f"{len(frames)} frames in {LISTEN:g} s")
        return
    stamps = np.array([frame.stamp_ns for _, frame in frames]) / SECOND_NS
    gaps, period = 1e3 * np.diff(stamps), 1e3 / camera.rate
    age = 1e3 * (np.array([at for at, _ in frames]) / SECOND_NS - stamps)
    lost = frames[-1][1].lost - frames[0][1].lost
    text = (
        f"{gaps.mean():.2f} ms apart ({period:.2f} set), within {np.abs(gaps - gaps.mean()).max():.2f}; "
        f"{np.median(age):.1f} ms old, at most {age.max():.1f}; {lost} lost"
    )
    fine = abs(gaps.mean() - period) < 0.05 * period and gaps.max() < 1.5 * period and not lost
    yield Finding(OK if fine else LOOK, "camera", text)


def check_arm_link(arm: ArmScene) -> Findings:
    """States of an arm with a driver of its own, at rest."""
    if arm.driver in (SIM, EXTERNAL):
        return
    with StagedArm(arm) as staged:
        time.sleep(LISTEN)
    yield check_rate(arm, staged.states)


def check_exposure_to_twist(options: Sequence[str] = ()) -> Finding:
    """Of real nodes that follow a simulated ramp, simulation and rendering on this machine included."""
    values = measured(["surface_following", *options])
    latency = values.get("latency_ms")
    if not latency or latency["p99"] is None:  # no twist was sent
        return Finding(FAILED, "exposure to twist", f"no run: {values['end']}")
    text = f"p50 {latency['p50']:.1f}, p99 {latency['p99']:.1f}, at most {latency['max']:.1f} ms, simulated"
    verdict = OK if latency["p99"] < GOOD else LOOK if latency["p99"] < BAD else FAILED
    advice = "" if verdict == OK else "; --priority 20, --cores, or lower gains (docs/control.md)"
    return Finding(verdict, "exposure to twist", f"{text}{advice}")


def measured(task: Sequence[str]) -> dict[str, Any]:
    """The report of one launch, recorded, with its `exit` code and how it came to its `end`."""
    with tempfile.TemporaryDirectory() as folder:
        launch = [*LAUNCH, *task, "--headless", "--out", folder, "--record", f"{folder}/bag"]
        done = subprocess.run(launch, capture_output=True, text=True, check=False)
        values = reported(Path(folder))
    return values | {"exit": done.returncode, "end": (done.stdout + done.stderr).strip()[-200:]}


def reported(folder: Path) -> dict[str, Any]:
    """What `tactile report` has to say of the recording `bag` in a folder; empty where that is nothing."""
    report = [*CLI, "report", f"{folder}/bag", "--out", f"{folder}/report"]
    subprocess.run(report, capture_output=True, check=False)
    found = next((folder / "report").rglob("report.json"), None)
    return json.loads(found.read_text()) if found is not None else {}
