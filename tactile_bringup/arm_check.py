"""Is this arm what its scene says, and does it stop? Without ROS, and in the air at 10 mm/s.

Everything is told by a line with a verdict. Motions are of some millimetres, away from what the arm's
controlled frame points at and back, through the safe command stage that tasks go through. The last one is
made by a process that is then frozen and killed, as a computer that hangs: what stops the arm then is its
controller.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_bringup.findings import FAILED, LOOK, OK, Finding
from tactile_bringup.staged_arm import StagedArm, Stopped
from tactile_doubles.rehearsal import rehearsed
from tactile_geometry import se3
from tactile_scene.arm import ARMS, ArmMode, ArmState, open_arm
from tactile_scene.arm_settings import SafetySettings
from tactile_scene.scene import ArmScene, Scene
from tactile_scene.scene_file import load_scene

Array = NDArray[np.float64]

SPEED = 0.01  # m/s, of what is measured
SECONDS = 1.0  # of each motion
ROOM = 0.025  # m, that the motions need
LISTEN = 2.0  # s
FIRST_DAY, FIRST_TURN = 0.02, 0.2  # m/s, rad/s
START = (0.005, 0.015)  # m between the tip and the surface: an approach goes 15 mm
UPRIGHT = math.radians(10.0)
SLACK = 0.0005  # m: of a way that is measured from states
STATE_WAY = 0.002  # m at `SPEED`, for states that were under way, and a process that freezes late
HANGS = 1.0  # s, for which the process that moves the arm is frozen
UNKNOWN = 0.5  # s, that a watchdog may take of which nothing is known
MOVED = 2e-4  # m: an arm that has gone so far has begun to move

Findings = Iterator[Finding]


def check_scene(arm: ArmScene) -> Findings:
    """What the scene says of the arm, as far as it bears on a first contact."""
    speed, turn = arm.limits.linear_velocity, arm.limits.angular_velocity
    slow = speed <= FIRST_DAY and turn <= FIRST_TURN
    better = "" if slow else f"; {1e3 * FIRST_DAY:g} and {FIRST_TURN:g} until ten runs were good"
    yield Finding(OK if slow else LOOK, "speed", f"limits are {1e3 * speed:g} mm/s, {turn:g} rad/s{better}")
    given, default = arm.safety, SafetySettings()
    box = f"{list(given.workspace_lower)} to {list(given.workspace_upper)} m"
    if (given.workspace_lower, given.workspace_upper) == (default.workspace_lower, default.workspace_upper):
        yield Finding(FAILED, "workspace", f"{box}, the default: nothing bounds how deep the arm goes")
    elif reason := arm.out_of_bounds(arm.T_base_start[:3, 3]):
        yield Finding(FAILED, "workspace", f"the start of tasks: {reason}")
    else:
        below = _room_below(arm)
        yield Finding(LOOK, "workspace", f"{box}, {1e3 * below:.0f} mm from the start along the tip: is the "
            "surface within these, and no more than 8 mm of them behind it?")  # fmt: skip
    if arm.kinematics is None:
        yield Finding(LOOK, "kinematics", "none: nobody minds joints and singularities (docs/kinematics.md)")
    if arm.sensor is not None:
        in_tool = np.round(1e3 * arm.T_tool_controlled[:3, 3], 1).tolist()
        yield Finding(LOOK, "sensor", f"its dome's centre is {in_tool} mm from the tool: by the ruler, too?")


def check_start(scene: Scene, arm: ArmScene) -> Findings:
    """Where tasks begin: how far above which surface, and how the sensor is turned against that."""
    gaps = []
    for name, body in scene.bodies_of(arm.name).items():
        T = se3.inverse(scene.T_base_body(arm.name, name)) @ arm.T_base_start
        distances, normals = body.make().query(T[None, :3, 3])
        gaps.append((float(distances[0]), -float(normals[0] @ T[:3, 2]), name))
    if arm.sensor is None or not gaps:
        return
    distance, ahead, name = min(gaps)
    gap, tilt = distance - arm.sensor.settings.tip_radius, math.acos(min(1.0, max(-1.0, ahead)))
    text = f"{1e3 * gap:.1f} mm above '{name}', {math.degrees(tilt):.1f} deg from its normal"
    if gap < 0.0:
        yield Finding(FAILED, "start", f"tasks would begin {-1e3 * gap:.1f} mm inside of '{name}'")
    elif START[0] <= gap <= START[1] and tilt < UPRIGHT:
        yield Finding(LOOK, "start", f"tasks begin {text}: does the surface stand there, by the ruler?")
    else:
        yield Finding(LOOK, "start", f"tasks begin {text}; the first one better 5 to 15 mm above, upright")


def check_force(arm: ArmScene) -> Findings:
    """What force ends a contact when all else fails: that of the arm's own controller."""
    fields = {item.name for item in dataclasses.fields(ARMS.load(arm.driver).settings_class)}
    what = "the force at which it stops itself is set at its controller"
    if "collision_force" in fields:
        given = arm.driver_settings.values.get("collision_force", "the driver's default")
        what = f"driver_settings.collision_force is {given}"
    yield Finding(LOOK, "force", f"{what}: is it the lowest with which the arm moves freely?")


def _room_below(arm: ArmScene) -> float:
    """How far the controlled frame can go ahead from its start within the workspace, m."""
    p, ahead = arm.T_base_start[:3, 3], arm.T_base_start[:3, 2]
    ends = np.where(ahead > 0.0, arm.safety.workspace_upper, arm.safety.workspace_lower)
    ways = [(end - at) / part for end, at, part in zip(ends, p, ahead, strict=True) if abs(part) > 1e-9]
    return float(min(ways))


def check_connection(staged: StagedArm) -> Findings:
    """What the open driver and its states say, while the arm rests."""
    time.sleep(LISTEN)
    arm, states = staged.arm, staged.states
    host = arm.driver_settings.values.get("host", "the arm")
    yield Finding(OK, "connection", f"{host} answered after {staged.opened_in:.1f} s")
    agreed = getattr(staged.driver, "agreed", "")
    text = (
        f"agrees with the scene in {agreed}"
        if agreed
        else "compared with nothing: tool and payload are yours"
    )
    yield Finding(OK if agreed else LOOK, "controller", text)
    if len(states) < 3:
        yield Finding(FAILED, "states", f"{len(states)} came in {LISTEN:g} s")
        return
    yield check_rate(arm, states)
    state = states[-1][1]
    if state.mode in (ArmMode.FAULT, ArmMode.ESTOP):
        yield Finding(FAILED, "state", f"{state.mode.name.lower()}: {state.reason or 'it does not say why'}")
    yield from _place(arm, state)


def check_rate(arm: ArmScene, states: list[tuple[int, ArmState]]) -> Finding:
    """How regularly states come, and how old they are when they do."""
    received = np.array([at for at, _ in states]) / SECOND_NS
    age = received - np.array([state.stamp_ns for _, state in states]) / SECOND_NS
    gaps = np.diff(received)
    text = (
        f"{1.0 / gaps.mean():.0f} a second, 99 % within {1e3 * np.percentile(gaps, 99):.1f} ms of the last, "
        f"{1e3 * np.median(age):.1f} ms old, at most {1e3 * age.max():.1f}"
    )
    fine = age.max() < 0.5 * arm.safety.state_age and gaps.max() < 0.5 * arm.limits.command_timeout
    return Finding(OK if fine else LOOK, "states", text if fine else f"{text}: a busy computer, or network?")


def _place(arm: ArmScene, state: ArmState) -> Findings:
    """Where the arm is, by its poses, its joints, and in the world."""
    T_world = arm.T_world_base @ state.T_base_controlled
    where = np.round(1e3 * T_world[:3, 3], 1).tolist()
    yield Finding(LOOK, "base", f"the controlled frame is at {where} mm in the world: by the ruler, too?")
    if arm.kinematics is not None and state.joints is not None:
        error = se3.log(se3.inverse(arm.kinematics.pose(state.joints)) @ state.T_base_controlled)
        way, turn = 1e3 * np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
        fits = way < 20.0 and turn < 3.0  # what the safe command stage asks for
        text = f"poses lie {way:.1f} mm and {turn:.1f} deg from what the joints give"
        yield Finding(OK if fits else FAILED, "joints", text)
    reason = arm.out_of_bounds(state.T_base_controlled[:3, 3])
    if reason:
        yield Finding(FAILED, "place", f"{reason}: move it there by hand first")


# ---- in motion ----


def check_motion(staged: StagedArm) -> Findings:
    """Measured in the air: direction, lag, stops; each as soon as it is known.

    Raises `RuntimeError` if a command is refused, with the reason; ends with the arm at rest.
    """
    arm, stage = staged.arm, staged.stage
    staged.drive()
    home = staged.pose.copy()
    ends = home @ se3.exp(_ahead(-ROOM))
    if reason := arm.out_of_bounds(ends[:3, 3]):
        yield Finding(FAILED, "room", f"no {1e3 * ROOM:.0f} mm to move away from what it points at: {reason}")
        return
    begun = staged.go(_ahead(-SPEED), SECONDS)
    stopped = staged.stopped(lambda: stage.stop("it is checked"))
    lag = _lag(staged, begun)
    yield from _direction(staged, home)
    yield Finding(OK if lag <= arm.tracking.lag else FAILED, "round trip",
        f"{1e3 * lag:.0f} ms from a command to the motion that it makes; tracking.lag is "
        f"{1e3 * arm.tracking.lag:.0f} ms")  # fmt: skip
    yield judge_stop(arm, "stop", stopped, lag)
    staged.go(_ahead(SPEED), SECONDS)
    yield judge_stop(arm, "emergency stop", staged.stopped(lambda: stage.estop("it is checked")), lag)
    yield from _after_reset(staged)
    staged.go(_ahead(-SPEED), SECONDS)
    yield _silence_row(arm, staged)
    _go_home(staged, home)


def _direction(staged: StagedArm, home: Array) -> Findings:
    alarm, went = staged.stage.alarm, se3.inverse(home) @ staged.pose
    away, aside = 1e3 * -went[2, 3], 1e3 * np.linalg.norm(went[:2, 3])
    text = f"told to go away by {1e3 * SPEED * SECONDS:.0f} mm it went {away:.1f}, and {aside:.1f} aside"
    fine = not alarm and 0.7 <= away / (1e3 * SPEED * SECONDS) <= 1.3 and aside < 1.0
    yield Finding(OK if fine else FAILED, "direction", f"{text}{f': {alarm}' if alarm else ''}")
    up = (staged.arm.T_world_base @ home)[:3, 2] @ [0.0, 0.0, -1.0]
    if up > 0.7:
        yield Finding(LOOK, "up", "was that straight up, by your eyes? If not, `base` or the tool is wrong")


def _lag(staged: StagedArm, begun_ns: int) -> float:
    """From the first command to where motion began, less what acceleration takes, s."""
    states = [(state.stamp_ns, state.T_base_controlled[:3, 3]) for _, state in staged.states]
    start = next(place for stamp, place in reversed(states) if stamp <= begun_ns)
    moved = next(
        (stamp for stamp, place in states if stamp > begun_ns and np.linalg.norm(place - start) > MOVED), None
    )
    if moved is None:
        return float("inf")
    ramp = staged.arm.limits.lead(SPEED / staged.arm.limits.linear_acceleration)
    return max(0.0, (moved - begun_ns) / SECOND_NS - MOVED / SPEED - 0.5 * ramp)


def judge_stop(arm: ArmScene, what: str, stopped: Stopped, lag: float) -> Finding:
    """Against the way that the limits and the lag allow."""
    most = arm.limits.braking_distance(SPEED, lag + arm.safety.reaction_time) + SLACK
    text = f"at rest after {1e3 * stopped.seconds:.0f} ms and {1e3 * stopped.way:.2f} mm from 10 mm/s"
    text = f"{text}; limits and lag allow {1e3 * most:.2f} mm"
    if not np.isfinite(stopped.seconds) or stopped.way > most + SPEED * stopped.gap:
        return Finding(FAILED, what, text)
    if stopped.way > most:
        gap = f"no state came for {1e3 * stopped.gap:.0f} ms"
        return Finding(LOOK, what, f"{text}, and {gap}: a busy computer, or network? Check again without")
    return Finding(OK, what, text)


def _after_reset(staged: StagedArm) -> Findings:
    """Nothing may move by itself once the emergency stop is left."""
    before = staged.pose[:3, 3].copy()
    staged.reset()
    time.sleep(LISTEN / 2)
    way = 1e3 * float(np.linalg.norm(staged.pose[:3, 3] - before))
    verdict = OK if way < 1e3 * SLACK else FAILED
    yield Finding(verdict, "reset", f"it moved by {way:.2f} mm by itself afterwards")


def _silence_row(arm: ArmScene, staged: StagedArm) -> Finding:
    """No command comes any more, and nobody says stop: what the driver does about it."""
    since = time.time_ns()
    time.sleep(max(5.0 * arm.limits.command_timeout, 0.5))
    rest, alarm = staged.rest_since(since), staged.stage.alarm
    if np.isfinite(rest.seconds) and not alarm:
        text = f"at rest after {1e3 * rest.seconds:.0f} ms and {1e3 * rest.way:.1f} mm without commands"
        return Finding(OK, "commands end", f"{text}, by the driver")
    staged.stage.halt("it goes on without commands")
    time.sleep(LISTEN / 2)
    staged.reset()
    text = "the driver goes on: only the arm's node stops it, while it runs"
    return Finding(LOOK, "commands end", f"{text} ({alarm})" if alarm else text)


def _go_home(staged: StagedArm, home: Array) -> None:
    ahead = (se3.inverse(staged.pose) @ home)[2, 3]
    if abs(ahead) > SLACK:
        staged.go(_ahead(np.copysign(SPEED, ahead)), abs(ahead) / SPEED)
    staged.stopped(lambda: staged.stage.stop("it is back"))


def _ahead(speed: float) -> Array:
    return np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])


# ---- a computer that hangs ----


def check_hang(reopen: Callable[[], StagedArm], command: list[str], home: Array) -> Findings:
    """A process moves the arm, is frozen in mid motion and killed: how far the arm goes then.

    Parameters
    ----------
    reopen : opens the arm, afterwards
    command : runs `move_until_killed` in a process of its own
    home : ndarray (4, 4)
        Where the arm goes in the end.
    """
    last = _frozen_at(command)
    try:
        staged = reopen()
    except (OSError, RuntimeError) as error:
        yield Finding(LOOK, "computer hangs", f"it cannot be opened afterwards: {error}; how far did it go?")
        return
    with staged:
        time.sleep(HANGS)
        if not staged.states:
            yield Finding(FAILED, "computer hangs", "the arm says nothing when it is opened again")
            return
        state = staged.states[-1][1]
        way = float(np.linalg.norm(state.T_base_controlled[:3, 3] - last))
        watchdog = getattr(staged.driver, "watchdog", None)
        most = SPEED * (watchdog or UNKNOWN) + staged.arm.limits.braking_distance(SPEED) + STATE_WAY
        text = f"frozen at 10 mm/s, the arm went on for {1e3 * way:.1f} mm (at most {1e3 * most:.1f}: "
        text += f"its watchdog has {1e3 * watchdog:.0f} ms)" if watchdog else "its watchdog is not known)"
        yield Finding(OK if way <= most else FAILED, "computer hangs", text)
        if state.mode not in (ArmMode.FAULT, ArmMode.ESTOP):
            staged.drive()
            _go_home(staged, home)


def _frozen_at(command: list[str]) -> Array:
    """Freeze a process once it moves the arm at its speed; the last place that it told before, (3,) m."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    told: list[list[float]] = []
    try:
        for line in process.stdout:
            told.append(json.loads(line))
            if told[-1][3] > 0.9 * SPEED:
                break
        os.killpg(process.pid, signal.SIGSTOP)
        time.sleep(HANGS)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    moving = bool(told) and told[-1][3] > 0.9 * SPEED
    for line in process.stdout:  # told before it was frozen
        if line.endswith("]\n"):
            told.append(json.loads(line))
    if not moving:
        raise RuntimeError("another process could not move the arm")
    return np.array(told[-1][:3])


def move_until_killed(arm: ArmScene) -> None:
    """Move an arm away; print, a line for each state, where it is (x, y, z, m) and its speed (m/s)."""

    def open_driver(report: Callable[[ArmState], None]) -> Any:
        def tell(state: ArmState) -> None:
            report(state)
            speed = float(np.linalg.norm(state.twist[:3]))
            print(json.dumps([*state.T_base_controlled[:3, 3].tolist(), speed]), flush=True)

        return open_arm(arm, tell)

    with StagedArm(arm, open_driver) as staged:
        staged.drive()
        staged.go(_ahead(-SPEED), SECONDS)


def hang_command(scene: str, arm: str, rehearse: bool) -> list[str]:
    """The command that runs `move_until_killed`."""
    return [sys.executable, "-m", __name__, scene, arm, *(["--rehearse"] if rehearse else [])]


if __name__ == "__main__":
    _scene = load_scene(sys.argv[1])
    move_until_killed((rehearsed(_scene) if "--rehearse" in sys.argv else _scene).arms[sys.argv[2]])
