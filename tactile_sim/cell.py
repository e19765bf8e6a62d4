"""Cell: the simulated arms, sensors and bodies of a scene on one fixed time base, deterministic by seed.

Nothing in it waits: whoever owns the time calls `step`, a loop as fast as it can, a node as the clock says::

    cell = Cell(load_scene("ramp"), seed=1)
    while True:
        cell.step()                                    # 1 / scene.simulation.rate seconds
        if cell.exposure_due("arm"):
            frame = cell.expose("arm")                 # image, true contact, pose, all at one stamp
        cell.command("arm", cell.stamp_ns, twist)      # [v, omega] of the sensor, in the sensor frame
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_base.settings import unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_scene.arm import ArmState
from tactile_scene.scene import SIM, Scene
from tactile_sim.arm import SimArm
from tactile_sim.body import Body
from tactile_sim.cell_arm import CellArm, sim_arm
from tactile_sim.frame import Frame
from tactile_sim.motions import Motion

if TYPE_CHECKING:
    from tactile_sim.network_view import ViewSettings

Array = NDArray[np.float64]


class Cell:
    """The simulated part of a scene.

    Parameters
    ----------
    scene : Scene
    seed : int
        Of all noise; the same seed and commands give the same bits.
    stamp_ns : int
        Time of the first state, ns.
    views : mapping, optional
        Arm -> the network whose input its sensor gives, for sensors of fidelity "input".
    followed : mapping
        Arm -> what stands for it, for arms that something else moves.

    Raises
    ------
    ValueError
        If the scene has no simulated arm, what it says of a body's motion is wrong, or an arm with known
        kinematics cannot reach its start.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int = 0,
        stamp_ns: int = 0,
        views: Mapping[str, ViewSettings] | None = None,
        followed: Mapping[str, SimArm] | None = None,
    ) -> None:
        self.scene = scene
        followed = followed or {}
        self._rate = scene.simulation.rate
        self._start_ns, self._ticks = int(stamp_ns), 0
        simulated = [arm for name, arm in scene.arms.items() if arm.driver == SIM or name in followed]
        if not simulated:
            raise ValueError(f"scene {scene.name}: none of its arms has the driver '{SIM}'")
        self._bodies = {name: Body(scene, body) for name, body in scene.bodies.items()}
        self._moving = [body for body in self._bodies.values() if not body.fixed]
        seeds = np.random.SeedSequence(seed).generate_state(len(simulated))
        self._arms = {
            arm.name: CellArm(
                scene,
                arm,
                self._bodies,
                int(arm_seed),
                followed.get(arm.name) or sim_arm(scene, arm, self._start_ns),
                (views or {}).get(arm.name),
            )
            for arm, arm_seed in zip(simulated, seeds, strict=True)
        }
        self._tools = {  # of arms that are not simulated: where they start
            name: arm.T_world_start @ se3.inverse(arm.T_tool_controlled) for name, arm in scene.arms.items()
        }

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of the simulated arms."""
        return tuple(self._arms)

    @property
    def stamp_ns(self) -> int:
        """Time of the cell, ns: the start plus a whole number of steps, without drift."""
        return self._start_ns + (self._ticks * SECOND_NS) // self._rate

    def step(self, steps: int = 1) -> int:
        """Move arms and bodies on by that many steps of the simulation and return the stamp."""
        for _ in range(steps):
            self._ticks += 1
            for arm in self._arms.values():
                arm.step(self.stamp_ns)
            if self._moving:
                self._move_bodies()
            for arm in self._arms.values():
                arm.protect(self._arms)
                arm.expose_late(self._ticks)
        return self.stamp_ns

    def arm(self, arm: str) -> SimArm:
        """The simulated arm: an `Arm` whose states the cell's steps make."""
        return self._arm(arm).arm

    def command(self, arm: str, stamp_ns: int, twist: ArrayLike) -> None:
        """Command a twist (6,), emitted at `stamp_ns`, past the safe command stage."""
        self._arm(arm).arm.command(stamp_ns, twist)

    def status(self, arm: str) -> ArmState:
        """Where the arm is, what it does, and why."""
        return self._arm(arm).arm.state

    def T_base_sensor(self, arm: str) -> Array:
        """Pose (4, 4) of the arm's sensor (of the tool, for an arm without one) in its base, now."""
        return self._arm(arm).arm.T_base_controlled

    def T_world_body(self, body: str) -> Array:
        """Pose (4, 4) of a body in the world, now."""
        if body not in self._bodies:
            raise KeyError(unknown_name(body, list(self._bodies)))
        return self._bodies[body].T_world_body.copy()

    def motion(self, body: str) -> Motion:
        """The motion of a body, with the state that its model has."""
        if body not in self._bodies:
            raise KeyError(unknown_name(body, list(self._bodies)))
        return self._bodies[body].motion

    def depth(self, arm: str) -> float:
        """Depth (m) of the undeformed tip in the surface that it is deepest in, now; -inf without any."""
        return self._arm(arm).depth()

    def exposure_due(self, arm: str) -> bool:
        """Whether the camera of the arm's sensor exposes at the present step."""
        return self._arm(arm).exposure_due(self._ticks)

    def expose(self, arm: str) -> Frame:
        """Expose the arm's sensor now.

        The skin moves on from where it was at the last exposure; image and noise differ each time.

        Raises
        ------
        ValueError
            If the arm has no simulated sensor.
        """
        return self._arm(arm).expose(self._ticks)

    def _arm(self, name: str) -> CellArm:
        if name not in self._arms:
            raise KeyError(unknown_name(name, list(self._arms)))
        return self._arms[name]

    def _move_bodies(self) -> None:
        """Take each body that moves to where it is now that the arms are where they are."""
        for name, arm in self._arms.items():
            self._tools[name] = arm.T_world_tool
        for body in self._moving:
            contacts = [arm.contact for arm in self._arms.values() if arm.contact and arm.touched is body]
            body.move(1.0 / self._rate, self._tools, contacts)
