"""Tasks, a motion and a shape, as a package outside this repository brings them along, that raise errors."""

import numpy as np

from tactile_control.tasks.surface_following import SurfaceFollowing
from tactile_scene.shapes.sphere import Sphere
from tactile_sim.motions import Fixed


class Rubbing(SurfaceFollowing):
    """Gives a library something wrong, in contact."""

    def reference_velocity(self, elapsed):
        return np.linalg.inv(np.zeros((2, 2)))


class Refusing(SurfaceFollowing):
    """Cannot be made."""

    def __init__(self, settings, goal, start):
        raise KeyError("speed")


class Silent(SurfaceFollowing):
    """Says nothing."""

    def step(self, now_ns, inputs):
        return None


class Swing(Fixed):
    """Raises as soon as it is touched."""

    def step(self, dt, tools, contacts):
        if contacts:
            return {}["height"]
        return Fixed.step(self, dt, tools, contacts)


class Bowl(Sphere):
    """Raises at the first question."""

    def query(self, points):
        raise ValueError("could not convert string to float: 'fast'")
