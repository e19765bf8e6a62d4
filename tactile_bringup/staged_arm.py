"""An arm of a scene behind the safe command stage, without ROS, and all that it says of itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError, unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_drivers.safety import SafeArm
from tactile_scene.arm import ArmState, is_at_rest, open_arm
from tactile_scene.scene import ArmScene, Scene

Array = NDArray[np.float64]

PERIOD = 0.008  # s, between commands
SETTLES = 0.1  # s of zeros, as from every new commander
WATCHED = 0.6  # s, after which an arm that was stopped has come to rest


def arm_of(
    scene: Scene,
    name: str | None = None,
    able: Callable[[ArmScene], bool] = lambda arm: True,
    what: str = "an arm",
) -> ArmScene:
    """The arm of that name in a scene, or the only `able` one; `SettingError` says `what` it has to be."""
    there = {arm.name: arm for arm in scene.arms.values() if able(arm)}
    if not name and len(there) == 1:
        return next(iter(there.values()))
    if name not in there:
        near = f" {unknown_name(name, [*there])}" if name and there else ""
        listed = near or f" there are: {', '.join(there) or 'none'}"
        raise SettingError(f"{scene.path}: --arm must name {what};{listed}")
    return there[name]


@dataclass(frozen=True)
class Stopped:
    """How an arm came to rest.

    Attributes
    ----------
    seconds : until it was at rest, by the stamps of its states; inf: it was not
    way : that it still went, m
    gap : the longest between two of its states meanwhile, as they came here, s
    """

    seconds: float
    way: float
    gap: float


class StagedArm:
    """Open while it is a context.

    Parameters
    ----------
    open_driver : opens a driver that reports to what it is given
    """

    def __init__(
        self, arm: ArmScene, open_driver: Callable[[Callable[[ArmState], None]], Any] | None = None
    ) -> None:
        self.arm, self._came = arm, list[tuple[int, ArmState]]()
        self.stage = SafeArm(arm, time.time_ns, feels=False)
        begun = time.monotonic()
        self.driver: Any = open_driver(self._take) if open_driver is not None else open_arm(arm, self._take)
        self.opened_in = time.monotonic() - begun

    def __enter__(self) -> StagedArm:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stage.halt("its user lets go of it")
        self.driver.close()

    def _take(self, state: ArmState) -> None:
        self._came.append((time.time_ns(), state))
        if self.stage.driver is not None:
            self.stage.take_state(state)

    @property
    def states(self) -> list[tuple[int, ArmState]]:
        """Those that have come until now, each with when (ns); the driver's thread brings more."""
        return self._came.copy()

    @property
    def pose(self) -> Array:
        """Where its controlled frame is, (4, 4) in its base, by the newest state."""
        return self._came[-1][1].T_base_controlled

    def drive(self) -> None:
        """Have the stage move it from now on; `RuntimeError` if no state of it is believed."""
        self.stage.attach_driver(self.driver)
        self._wait()

    def reset(self) -> None:
        """Leave what has stopped it; `RuntimeError` says why it does not."""
        self.stage.reset()
        self._wait()

    def _wait(self) -> None:
        end = time.monotonic() + WATCHED
        while self.stage.state is None:
            if time.monotonic() > end:
                raise RuntimeError(f"no state of the arm is believed: {self.stage.bad_state or 'none came'}")
            time.sleep(PERIOD)

    def go(self, twist: Array, seconds: float) -> int:
        """Command a twist (6,) for so long, after zeros; when it began, ns.

        Raises `RuntimeError` if it is refused, with the reason.
        """
        begun, started = 0, time.monotonic()
        while (elapsed := time.monotonic() - started) < SETTLES + seconds:
            moves = elapsed >= SETTLES
            begun = begun or (time.time_ns() if moves else 0)
            wanted = twist if moves else np.zeros(6)
            if refused := self.stage.command(time.time_ns(), wanted, "tactile"):
                raise RuntimeError(f"a command was refused: {refused}")
            time.sleep(PERIOD)
        return begun

    def stopped(self, how: Callable[[], None]) -> Stopped:
        """Have something stop it, and see how it comes to rest."""
        asked_ns = time.time_ns()
        how()
        time.sleep(WATCHED)
        return self.rest_since(asked_ns)

    def rest_since(self, since_ns: int) -> Stopped:
        """How it came to rest since then (ns): the stamp from which on its twist is zero, and the way."""
        came = self.states
        states = [state for _, state in came]
        gaps = np.diff([at for at, _ in came if at >= since_ns], prepend=since_ns) / SECOND_NS
        later = [state for state in states if state.stamp_ns >= since_ns]
        moving = [state.stamp_ns for state in later if not is_at_rest(state.twist)]
        rests = bool(later) and is_at_rest(later[-1].twist)
        seconds = (max(moving, default=since_ns) - since_ns) / SECOND_NS if rests else np.inf
        return Stopped(seconds, _way(states, since_ns), float(gaps.max(initial=0.0)))


def _way(states: list[ArmState], since_ns: int) -> float:
    """From where it was then (ns) to where it is, m."""
    stamps = [state.stamp_ns / SECOND_NS for state in states]
    places = np.array([state.T_base_controlled[:3, 3] for state in states])
    then = np.array([np.interp(since_ns / SECOND_NS, stamps, column) for column in places.T])
    return float(np.linalg.norm(places[-1] - then))
