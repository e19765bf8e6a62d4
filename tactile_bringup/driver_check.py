"""Opens arms and cameras of plug-ins, and holds what they report against their contracts (`plugin_check`)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError
from tactile_base.stamps import SECOND_NS
from tactile_bringup.staged_arm import WATCHED, StagedArm, arm_of
from tactile_scene.arm import LONGEST_CALL, ArmState, is_at_rest
from tactile_scene.camera import CameraFrame
from tactile_scene.scene_file import load_scene

Array = NDArray[np.float64]
Problems = Iterator[str]

LISTEN = 2.0  # s


def check_camera(kind: Any, scene: str, arm: str) -> Problems:
    """Two seconds of its frames, and its end."""
    one = _arm(scene, arm)
    if one.sensor is None:
        raise SettingError(f"arm '{one.name}' has no sensor in this scene")
    frames: list[tuple[int, Any, bytes]] = []

    def take(frame: Any) -> None:
        image = np.asarray(getattr(frame, "image", None))
        frames.append(
            (time.time_ns(), frame, image[:: max(1, len(image) // 8)].tobytes() if image.ndim else b"")
        )

    given = one.sensor.camera_settings
    camera = kind(one, given.checked(kind.settings_class, given.values), take)
    rate = float(camera.rate)
    _listen(lambda: len(frames) > LISTEN * rate)
    yield from _closes(camera, lambda: len(frames), "frame")
    if len(frames) < 3:
        yield f"{len(frames)} frames came in {LISTEN:g} s"
        return
    if wrong := [type(frame).__name__ for _, frame, _ in frames if not isinstance(frame, CameraFrame)]:
        yield f"reports a {wrong[0]}, must be a CameraFrame"
        return
    stamps = np.array([frame.stamp_ns for _, frame, _ in frames], dtype=np.float64) / SECOND_NS
    yield from _stamps(stamps, np.array([at for at, _, _ in frames]) / SECOND_NS, 1.0)
    measured = (len(stamps) - 1) / max(stamps[-1] - stamps[0], 1e-9)
    if not 0.8 * rate <= measured <= 1.2 * rate:
        yield f"rate says {rate:g} Hz, frames are stamped at {measured:.1f} Hz"
    yield from _images([frame for _, frame, _ in frames], [kept for _, _, kept in frames])


def _images(frames: list[Any], kept: list[bytes]) -> Problems:
    first = np.asarray(frames[0].image)
    if first.dtype != np.uint8 or first.ndim not in (2, 3) or first.shape[2:] not in ((), (3,)):
        yield f"images are {first.dtype} {first.shape}, must be uint8 (height, width) or (height, width, 3)"
        return
    if any(np.asarray(frame.image).shape != first.shape for frame in frames):
        yield "images change their size"
        return
    later = [frame.image[:: max(1, len(frame.image) // 8)].tobytes() for frame in frames]
    if sum(a != b for a, b in zip(kept, later, strict=True)) > 0:
        yield "an image changes after it was reported: each frame needs memory of its own"
    if any(b.lost < a.lost for a, b in itertools.pairwise(frames)):
        yield "the number of lost exposures falls; it counts from the start"


def check_arm(kind: Any, scene: str, arm: str, moves: bool) -> Problems:
    """Two seconds of its states, calls of zero twists and stops, and its end; with `moves`, a millimetre."""
    one = _arm(scene, arm)
    given = one.driver_settings
    settings = given.checked(kind.settings_class, given.values)
    staged = StagedArm(one, lambda report: kind(one, settings, report))
    driver = staged.driver
    if not isinstance(getattr(driver, "keeps_limits", None), bool):
        yield "has no keeps_limits, must be True or False"
    _listen(lambda: False)
    calls: dict[str, Callable[[], None]] = {
        "command": lambda: driver.command(time.time_ns(), np.zeros(6)),
        "stop": lambda: driver.stop("it is tried out"),
    }
    for name, call in calls.items():
        begun = time.perf_counter()
        call()
        if (took := time.perf_counter() - begun) > LONGEST_CALL:
            yield f"{name} took {took * 1e3:.0f} ms, may take {LONGEST_CALL * 1e3:.0f}"
    problems = list(_states(one, staged.states, at_rest=True))
    yield from problems
    if moves and not problems:
        yield from _moved(staged)
    yield from _closes(driver, lambda: len(staged.states), "state")


def _states(arm: Any, states: list[tuple[int, Any]], at_rest: bool) -> Problems:

    if len(states) < 3:
        yield f"{len(states)} states came in {LISTEN:g} s"
        return
    if wrong := [type(state).__name__ for _, state in states if not isinstance(state, ArmState)]:
        yield f"reports a {wrong[0]}, must be an ArmState"
        return
    received = np.array([at for at, _ in states]) / SECOND_NS
    stamps = np.array([state.stamp_ns for _, state in states]) / SECOND_NS
    yield from _stamps(stamps, received, arm.safety.state_age)
    poses = (not_rigid(np.asarray(state.T_base_controlled)) for _, state in states)
    if problem := next(filter(None, poses), ""):
        yield f"a pose {problem}"
    twists = [np.asarray(state.twist, dtype=np.float64) for _, state in states]
    if any(twist.shape != (6,) or not np.isfinite(twist).all() for twist in twists):
        yield "twists are not six finite numbers"
    elif at_rest and (moving := [twist for twist in twists if not is_at_rest(twist)]):
        yield f"it reports the twist {numbers(moving[0])} though nobody commands it"


def _moved(staged: StagedArm) -> Problems:
    """A millimetre from the surface and back, through the safe command stage; commands end in motion."""
    stage = staged.stage
    staged.drive()
    begun = staged.pose[:3, 3].copy()
    for speed in (-0.005, 0.005):
        staged.go(np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0]), 0.2)
        time.sleep(staged.arm.limits.command_timeout)
        rest = staged.stopped(lambda: stage.stop("no command came"))  # as the arm's node
        if stage.alarm or np.isinf(rest.seconds):
            stage.halt("it does not stop")
            yield f"{WATCHED:g} s after it was stopped: {stage.alarm or 'it still moves'}"
            return
    if np.linalg.norm(staged.pose[:3, 3] - begun) > 5e-4:
        yield "a millimetre away and back does not end where it began"


def _stamps(stamps: Array, received: Array, limit: float) -> Problems:
    if not (np.diff(stamps) > 0.0).all():
        yield "stamps do not rise from one to the next"
    age = received - stamps
    if np.abs(age).max() > limit:
        yield f"stamps are {age.min():.3f} to {age.max():.3f} s old when they come, must be below {limit:g} s"


def _closes(driver: Any, count: Callable[[], int], what: str) -> Problems:
    begun = time.monotonic()
    driver.close()
    if (took := time.monotonic() - begun) > LISTEN:
        yield f"close took {took:.1f} s"
    before = count()
    time.sleep(0.3)
    if count() > before:
        yield f"a {what} is reported after close"


def _listen(enough: Callable[[], bool]) -> None:
    end = time.monotonic() + LISTEN
    while time.monotonic() < end and not enough():
        time.sleep(0.01)


def _arm(scene: str, arm: str) -> Any:
    if not scene:
        raise SettingError("a driver is tried on an arm of a scene: --scene my_cell.yaml")
    return arm_of(load_scene(scene), arm)


def not_rigid(T: Array) -> str:
    """What is wrong with a pose (4, 4); empty for nothing."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return f"has the shape {T.shape} or is not finite, must be a pose (4, 4)"
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0 or (T[3] != [0, 0, 0, 1]).any():
        return "is no rigid motion: a rotation is orthonormal and right-handed, the last row 0 0 0 1"
    return ""


def numbers(values: Array) -> str:
    """Numbers for people."""
    return f"({', '.join(f'{value:.4g}' for value in np.asarray(values).ravel())})"
