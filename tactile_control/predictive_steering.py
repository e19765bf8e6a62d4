"""Model-predictive steering of a pushed object: the baseline of the literature, with the same sensing.

Hogan and Rodriguez (2020, "Reactive planar non-prehensile manipulation with hybrid model predictive control")
plan a push over a horizon in which the pusher sticks, inside the motion cone (Mason 1986), or slides. A
rubber tip sticks at all slopes that are of use here, so that the sticking family of modes remains, and the
cone is a bound. With the target at (y, z) in {s'} (`steering`), the way ahead s in place of time, and the
slope w = u / v,

    dy/ds = (a z - 1) w + b z        dz/ds = -1 - (a w + b) y        |w| <= cone

The plan is the w on `STEPS` equal pieces of the way that is left that makes least of

    integral of w^2 + (y / reach)^2 ds + end_way (y / reach)^2 at the end

found by linearization about the last plan, as theirs, with the bound met as in Tassa, Mansard and Todorov
(2014, "Control-limited differential dynamic programming"), once at each belief; a and b are learnt as before.
"""

from __future__ import annotations

from typing import Any, Protocol

STEPS = 12
LEAST_WAY = 0.002  # m: a plan is no shorter


class PlanSettings(Protocol):
    """What a plan takes of `SteeringSettings`."""

    @property
    def cone(self) -> float: ...
    @property
    def reach(self) -> float: ...
    @property
    def end_way(self) -> float: ...


class Plan:
    """The `slopes` ahead, of one push in numbers or of many in arrays."""

    def __init__(self, math: Any, like: Any) -> None:
        self._math = math
        self.slopes = [0.0 * like for _ in range(STEPS)]

    def step(self, settings: PlanSettings, model: tuple[Any, Any], y: Any, z: Any, radius: float) -> Any:
        """Improve the plan for a target at (y, z), of which the tip stops `radius` short; its first slope."""
        math, cone = self._math, settings.cone
        piece = math.clip(math.sqrt(y * y + z * z) - radius, LEAST_WAY, 10.0) / STEPS
        states = self._states(model, y, z, piece)
        laws = self._laws(settings, model, states, piece)
        planned = []
        for slope, (offset, by_y, by_z), (y_then, z_then) in zip(self.slopes, laws, states, strict=False):
            slope = math.clip(slope + offset + by_y * (y - y_then) + by_z * (z - z_then), -cone, cone)
            planned.append(slope)
            y, z = _onward(model, y, z, slope, piece)
        self.slopes = planned
        return planned[0]

    def _states(self, model: tuple[Any, Any], y: Any, z: Any, piece: Any) -> list[tuple[Any, Any]]:
        """Where the target is before each piece of the last plan, and after all."""
        states = [(y, z)]
        for slope in self.slopes:
            states.append(_onward(model, *states[-1], slope, piece))
        return states

    def _laws(
        self, settings: PlanSettings, model: tuple[Any, Any], states: list[tuple[Any, Any]], piece: Any
    ) -> list[tuple[Any, Any, Any]]:
        """Change of each slope, and its change with y and z then: Riccati's recursion from the end."""
        math, (a, b), cone = self._math, model, settings.cone
        y, _ = states[-1]
        each = piece / settings.reach**2
        last = settings.end_way / settings.reach**2 + each
        by_y, by_z = last * y, 0.0 * y  # gradient of half the cost
        yy, yz, zz = last + 0.0 * y, 0.0 * y, 0.0 * y
        laws = []
        for slope, (y, z) in zip(reversed(self.slopes), reversed(states[:-1]), strict=True):
            turn = piece * (a * slope + b)  # the state's matrix is [[1, turn], [-turn, 1]]
            to_y, to_z = piece * (a * z - 1.0), -piece * a * y
            hy, hz = yy * to_y + yz * to_z, yz * to_y + zz * to_z
            curved = piece + hy * to_y + hz * to_z
            slanted = piece * slope + by_y * to_y + by_z * to_z
            wanted = slope - slanted / curved
            free = math.where(abs(wanted) < cone, 1.0 + 0.0 * wanted, 0.0)
            offset = math.clip(wanted, -cone, cone) - slope
            cross_y, cross_z = hy - turn * hz, turn * hy + hz
            gain_y, gain_z = -free * cross_y / curved, -free * cross_z / curved
            laws.append((offset, gain_y, gain_z))
            ahead_y, ahead_z = by_y + hy * offset, by_z + hz * offset
            by_y, by_z = ahead_y - turn * ahead_z, turn * ahead_y + ahead_z
            rest = slanted + curved * offset
            by_y, by_z = by_y + gain_y * rest + each * y, by_z + gain_z * rest
            first, both, last = yy - turn * yz, yz - turn * zz, turn * yz + zz
            yy, yz, zz = (
                first - turn * both + gain_y * cross_y + each,
                turn * first + both + gain_y * cross_z,
                turn * (turn * yy + yz) + last + gain_z * cross_z,
            )
        return laws[::-1]


def _onward(model: tuple[Any, Any], y: Any, z: Any, slope: Any, piece: Any) -> tuple[Any, Any]:
    """Where the target is after a piece of the way."""
    a, b = model
    turn = a * slope + b
    return y + piece * (turn * z - slope), z - piece * (1.0 + turn * y)
