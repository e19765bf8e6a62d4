"""Mistakes in each kind of plug-in, as they are made; by words with which `tactile check` names each.

`SHAPES`, `MOTIONS`, `TASKS`, `ARMS` and `CAMERAS` hold what makes the class of each; `made` makes it.
`PLUGINS` has all of them as attributes, SHAPE_3 say, for entry points.
"""

import itertools
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import bench_cell as bench
import numpy as np

from tactile_control.contact_task import ContactTask
from tactile_control.phases import DONE
from tactile_control.tasks.surface_following import SurfaceFollowing
from tactile_scene.shapes.sphere import Sphere

REST = np.eye(4)


def like(base, **changes):
    return type("Mine", (base,), {"__module__": __name__, **changes})


# ---- shapes ----


def query(change):
    def wrong(self, points):
        return change(points, *Sphere.query(self, points))

    return like(Sphere, query=wrong)


def forgets_points(self):
    return np.zeros(1), np.zeros((1, 3))


def spoils(points, distance, normal):
    points += 1.0
    return distance, normal


def fails(*given):
    raise ValueError("could not convert string to float: 'fast'")


SHAPES = {
    "query() is called as query(points)": like(Sphere, query=forgets_points),
    "has no settings_class": like(Sphere, settings_class=dict),
    "must be a subclass of Surface": type(
        "Mine", (), {"__module__": __name__, "settings_class": Sphere.settings_class}
    ),
    "the normal is not the gradient": query(lambda points, distance, normal: (distance, -normal)),
    "normals have lengths from 2 to 2": query(lambda points, distance, normal: (distance, 2.0 * normal)),
    "it is no distance": query(lambda points, distance, normal: (3.0 * distance, normal)),
    "must be (N,) and (N, 3)": query(lambda points, distance, normal: (distance[:, None], normal)),
    "not finite": query(lambda points, distance, normal: (distance * np.nan, normal)),
    "changes the points": query(spoils),
    "another distance than among others": query(lambda points, d, normal: (d - d.mean(), normal)),
    "off the surface": like(Sphere, grid=lambda self, n=60: 1.1 * Sphere.grid(self, n)),
    "shows its inside": like(Sphere, grid=lambda self, n=60: Sphere.grid(self, n)[::-1]),
    "has the shape (400, 3)": like(Sphere, grid=lambda self, n=60: np.zeros((400, 3))),
    "raises ValueError: could not convert string to float: 'fast' (": query(fails),
}


# ---- motions ----


def motion(change):
    """A drift whose poses are changed, given how often it was asked before."""

    def make():
        def step(self, dt, tools, contacts):
            self.asked = getattr(self, "asked", -1) + 1
            return change(bench.Drift.step(self, dt, tools, contacts).copy(), self.asked)

        return like(bench.Drift, step=step)

    return make


def scaled(T, number):
    T[:3, :3] *= 1.001
    return T


def mirrored(T, number):
    T[:3, 0] *= -1.0
    return T


def jumps(T, number):
    T[0, 3] += 0.3 * (number > 100)
    return T


def starts_elsewhere(T, number):
    T[2, 3] += 0.5
    return T


RANDOM = np.random.default_rng(0)


def shaken(T):
    T = T.copy()
    T[0, 3] += 1e-6 * RANDOM.random()
    return T


MOTIONS = {
    "step(dt) is called as step(dt, tools, contacts)": lambda: like(bench.Drift, step=lambda self, dt: REST),
    "has no settings_class": lambda: like(bench.Drift, settings_class=None),
    "is called as Mine(scene, body, settings)": lambda: like(bench.Drift, __init__=lambda self, scene: None),
    "carriers is 'arm'": lambda: like(bench.Drift, carriers="arm"),
    "has the shape (3, 4)": motion(lambda T, number: T[:3]),
    "or is not finite": motion(lambda T, number: T * np.nan),
    "step 0: is no rigid motion": motion(scaled),
    "is no rigid motion: a rotation is orthonormal and right-handed": motion(mirrored),
    "step 101: the body jumps by 300 mm": motion(jumps),
    "step 0: the body jumps by 500 mm and 0 deg from where the scene has it": motion(starts_elsewhere),
    "two of them in the same scene go different ways": lambda: like(
        bench.Drift, step=lambda self, dt, tools, contacts: shaken(self._T)
    ),
    "raises ValueError": motion(fails),
}


# ---- tasks ----


def stepping(change):
    def step(self, now_ns, inputs):
        return change(self, SurfaceFollowing.step(self, now_ns, inputs))

    return like(SurfaceFollowing, step=step)


def sleeps(self, command):
    self.slept = getattr(self, "slept", 0) + 1
    time.sleep(0.02 * (self.slept < 6))
    return command


def working(seconds):
    """A task that computes for so long in each of its first steps, and the list of how long these took."""
    took = []

    def works(self, command):
        begun, end = time.perf_counter(), time.thread_time() + seconds * (len(took) < 40)
        while time.thread_time() < end:
            pass
        took.append(time.perf_counter() - begun)
        return command

    return stepping(works), took


def leaves_first(self, command):
    self.phase = "dancing"
    return replace(command, phase="dancing")


TASKS = {
    "must be a subclass of PhaseMachine": type(
        "Mine",
        (),
        {
            "__module__": __name__,
        },
    ),
    "Mine(settings) is called as Mine(settings, goal, start)": like(
        SurfaceFollowing, __init__=lambda self, settings: None
    ),
    "configure() is called as configure(settings)": like(SurfaceFollowing, configure=lambda self: None),
    "has no settings_class": like(SurfaceFollowing, settings_class=None),
    "lack 'dance'": like(SurfaceFollowing, work="dance"),
    "nothing ends it": like(SurfaceFollowing, finished=ContactTask.finished),
    "lack 'done'": like(SurfaceFollowing, phases=tuple(p for p in SurfaceFollowing.phases if p != DONE)),
    "gives a NoneType, must be a Command": stepping(lambda self, command: None),
    "must be six finite numbers": stepping(lambda self, c: replace(c, twist=np.full(6, np.nan))),
    "moves without knowing where the arm is": stepping(lambda self, c: replace(c, twist=np.full(6, 0.01))),
    "phase 'dancing' is not among its phases": stepping(leaves_first),
    "does not end within 60 s": stepping(lambda self, c: replace(c, done=False)),
    " ms and more; images come every 8 to 17 ms": stepping(sleeps),
    "could not convert string to float: 'fast'": like(SurfaceFollowing, before_phase=fails),
}


# ---- arms ----


def reporting(change):
    """An arm whose states are changed before they are reported."""

    def make():
        def __init__(self, arm, settings, report):
            bench.BenchArm.__init__(self, arm, settings, lambda state: report(change(state)))

        return like(bench.BenchArm, __init__=__init__)

    return make


def arm(**changes):
    return lambda: like(bench.BenchArm, **changes)


def goes_on():
    def stop(self, reason):
        return None

    return like(bench.BenchArm, stop=stop, keeps_limits=True)


ARMS = {
    "command(twist) is called as command(stamp_ns, twist)": arm(command=lambda self, twist: None),
    "has no method stop(reason)": arm(stop=None),
    "has no settings_class": arm(settings_class=None),
    "has no keeps_limits": arm(keeps_limits=None),
    "command took": arm(command=lambda self, stamp_ns, twist: time.sleep(0.03)),
    "stop took": arm(stop=lambda self, reason: time.sleep(0.03)),
    "reports a dict, must be an ArmState": reporting(lambda state: {"stamp_ns": state.stamp_ns}),
    "a pose has the shape (4, 4) or is not finite": reporting(
        lambda state: replace(state, T_base_controlled=np.full((4, 4), np.nan))
    ),
    "stamps do not rise": reporting(lambda state: replace(state, stamp_ns=10**18)),
    "s old when they come, must be below 0.2": reporting(
        lambda state: replace(state, stamp_ns=state.stamp_ns - 10**9)
    ),
    "though nobody commands it": reporting(lambda state: replace(state, twist=np.full(6, 0.1))),
    "twists are not six finite numbers": reporting(lambda state: replace(state, twist=np.zeros(3))),
}


# ---- cameras ----


def frames(change):
    def make():
        def __init__(self, arm, settings, report):
            bench.BenchCamera.__init__(self, arm, settings, lambda frame: report(change(frame)))

        return like(bench.BenchCamera, __init__=__init__)

    return make


def one_buffer():
    buffer, values = np.zeros((48, 64), np.uint8), itertools.count()

    def change(frame):
        buffer[:] = next(values)
        return replace(frame, image=buffer)

    return change


def growing():
    sizes = itertools.count(8)
    return lambda frame: replace(frame, image=np.zeros((next(sizes), 8), np.uint8))


def claimed(self):
    return 500.0 if threading.current_thread() is threading.main_thread() else 60.0


def ignored(self, rate):
    return None


CAMERAS = {
    "close(when) is called as close()": lambda: like(bench.BenchCamera, close=lambda self, when: None),
    "has no settings_class": lambda: like(bench.BenchCamera, settings_class=3),
    "is called as Mine(arm, settings, report)": lambda: like(bench.BenchCamera, __init__=lambda self: None),
    "must be a class": lambda: 3,
    "reports a dict, must be a CameraFrame": frames(lambda frame: {"image": frame.image}),
    "images are float64": frames(lambda frame: replace(frame, image=frame.image * 1.0)),
    "must be uint8 (height, width)": frames(
        lambda frame: replace(frame, image=np.zeros((4, 4, 4), np.uint8))
    ),
    "images change their size": frames(growing()),
    "changes after it was reported": frames(one_buffer()),
    "stamps do not rise": frames(lambda frame: replace(frame, stamp_ns=10**18)),
    "must be below 1 s": frames(lambda frame: replace(frame, stamp_ns=frame.stamp_ns + 3 * 10**9)),
    "the number of lost exposures falls": frames(lambda frame: replace(frame, lost=frame.stamp_ns % 7)),
    "rate says 500 Hz": lambda: like(bench.BenchCamera, rate=property(claimed, ignored)),
}


KINDS = {
    "shape": SHAPES,
    "body motion": MOTIONS,
    "task": TASKS,
    "arm driver": ARMS,
    "camera driver": CAMERAS,
}


def made(make):
    """The class of a mistake, which stands there or is made."""
    return make() if getattr(make, "__name__", "") in ("make", "<lambda>") else make


PLUGINS = SimpleNamespace(
    **{
        f"{kind.split()[0].upper()}_{number}": made(make)
        for kind, mistakes in KINDS.items()
        for number, make in enumerate(mistakes.values())
    }
)
