"""`tactile check`: what keeps its contract passes, and each mistake is named in words of the contract."""

import itertools
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from other_package import installed

from tactile_base.settings import SettingError
from tactile_bringup import cli, driver_check
from tactile_bringup.commands.plugins import registries
from tactile_bringup.plugin_check import check_plugin
from tactile_control.phases import DONE
from tactile_control.tasks.surface_following import SurfaceFollowing
from tactile_drivers.shapes.sphere import Sphere

REST = np.eye(4)


@pytest.fixture(autouse=True)
def bench(tmp_path, monkeypatch):
    """The other package, installed, and a scene with its drivers."""
    (tmp_path / "site").mkdir()
    for folder in installed(tmp_path / "site"):
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(driver_check, "LISTEN", 0.4)
    path = tmp_path / "cell.yaml"
    path.write_text(
        "arms:\n  arm: {driver: bench_arm, start: {position: [0, 0, 0.3], rotation_deg: [0, 180, 0]}, "
        "sensor: {camera: bench_camera, camera_rate: 60}}\n"
    )
    yield SimpleNamespace(scene=str(path), module=__import__("bench_cell"))
    sys.modules.pop("bench_cell", None)


@pytest.fixture
def problems(monkeypatch, bench):
    """What is found of a class that is not installed."""

    def find(kind, plugin, **options) -> str:
        monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(Mine=plugin))
        drives = kind.endswith("driver")
        return "; ".join(check_plugin(kind, "mine:Mine", scene=bench.scene if drives else "", **options))

    return find


def test_all_that_this_package_brings_keeps_its_contract():
    for registry in registries():
        for entry in registry.entries():
            if entry.package == "tactile_servoing":
                assert registry.contract.objections(registry.load(entry.name)) == [], entry
    for shape in ("plane", "ramp", "dome", "box", "cylinder", "sphere", "prism"):
        assert check_plugin("shape", shape) == []
    for task in ("surface_following", "object_tracking"):
        assert check_plugin("task", task) == []


def like(base, **changes):
    return type("Mine", (base,), changes)


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
    "must be a subclass of Surface": type("Mine", (), {"settings_class": Sphere.settings_class}),
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


@pytest.mark.parametrize("words", SHAPES)
def test_a_mistake_in_a_shape_is_named(problems, words):
    assert words in problems("shape", SHAPES[words])


# ---- motions ----


def motion(change):
    """A drift whose poses are changed, given how often it was asked."""

    def make(bench):
        count = itertools.count()

        def step(self, dt, tools, contacts):
            T = bench.module.Drift.step(self, dt, tools, contacts)
            return change(T.copy(), next(count) // 2)

        return like(bench.module.Drift, step=step)

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
    "step(dt) is called as step(dt, tools, contacts)": lambda bench: like(
        bench.module.Drift, step=lambda self, dt: REST
    ),
    "has no settings_class": lambda bench: like(bench.module.Drift, settings_class=None),
    "is called as Mine(scene, body, settings)": lambda bench: like(
        bench.module.Drift, __init__=lambda self, scene: None
    ),
    "carriers is 'arm'": lambda bench: like(bench.module.Drift, carriers="arm"),
    "has the shape (3, 4)": motion(lambda T, number: T[:3]),
    "or is not finite": motion(lambda T, number: T * np.nan),
    "step 0: is no rigid motion": motion(scaled),
    "is no rigid motion: a rotation is orthonormal and right-handed": motion(mirrored),
    "step 101: the body jumps by 300 mm": motion(jumps),
    "step 0: the body jumps by 500 mm and 0 deg from where the scene has it": motion(starts_elsewhere),
    "two of them in the same scene go different ways": lambda bench: like(
        bench.module.Drift, step=lambda self, dt, tools, contacts: shaken(self._T)
    ),
    "raises ValueError": motion(fails),
}


@pytest.mark.parametrize("words", MOTIONS)
def test_a_mistake_in_a_motion_is_named(problems, bench, words):
    assert words in problems("body motion", MOTIONS[words](bench))


def test_a_motion_that_keeps_its_contract_passes(problems, bench):
    assert problems("body motion", bench.module.Drift) == ""


# ---- tasks ----


def stepping(change):
    def step(self, now_ns, inputs):
        return change(self, SurfaceFollowing.step(self, now_ns, inputs))

    return like(SurfaceFollowing, step=step)


def sleeps(self, command):
    self.slept = getattr(self, "slept", 0) + 1
    time.sleep(0.02 * (self.slept < 6))
    return command


def leaves_first(self, command):
    self.phase = "dancing"
    return replace(command, phase="dancing")


TASKS = {
    "must be a subclass of PhaseMachine": type("Mine", (), {}),
    "Mine(settings) is called as Mine(settings, goal, start)": like(
        SurfaceFollowing, __init__=lambda self, settings: None
    ),
    "configure() is called as configure(settings)": like(SurfaceFollowing, configure=lambda self: None),
    "has no settings_class": like(SurfaceFollowing, settings_class=None),
    "lack 'dance'": like(SurfaceFollowing, work="dance"),
    "lack 'done'": like(SurfaceFollowing, phases=tuple(p for p in SurfaceFollowing.phases if p != DONE)),
    "gives a NoneType, must be a Command": stepping(lambda self, command: None),
    "must be six finite numbers": stepping(lambda self, c: replace(c, twist=np.full(6, np.nan))),
    "moves without knowing where the arm is": stepping(lambda self, c: replace(c, twist=np.full(6, 0.01))),
    "phase 'dancing' is not among its phases": stepping(leaves_first),
    "does not end within 60 s": stepping(lambda self, c: replace(c, done=False)),
    " ms and more; images come every 8 to 17 ms": stepping(sleeps),
    "could not convert string to float: 'fast'": like(SurfaceFollowing, _stamps=fails),
}


@pytest.mark.parametrize("words", TASKS)
def test_a_mistake_in_a_task_is_named(problems, words):
    assert words in problems("task", TASKS[words])


# ---- arms ----


def reporting(change):
    """An arm whose states are changed before they are reported."""

    def make(bench):
        def __init__(self, arm, settings, report):
            bench.module.BenchArm.__init__(self, arm, settings, lambda state: report(change(state)))

        return like(bench.module.BenchArm, __init__=__init__)

    return make


def arm(**changes):
    return lambda bench: like(bench.module.BenchArm, **changes)


def goes_on(bench):
    def stop(self, reason):
        return None

    return like(bench.module.BenchArm, stop=stop, keeps_limits=True)


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


@pytest.mark.parametrize("words", ARMS)
def test_a_mistake_in_an_arm_is_named(problems, bench, words):
    found = problems("arm driver", ARMS[words](bench))
    assert words in found


def test_an_arm_that_reports_after_its_end_is_named(problems, bench):
    kept = []

    def __init__(self, *given):
        kept.append(self)
        bench.module.BenchArm.__init__(self, *given)

    plugin = like(bench.module.BenchArm, __init__=__init__, close=lambda self: None)
    try:
        assert "a state is reported after close" in problems("arm driver", plugin)
    finally:
        bench.module.BenchArm.close(kept[0])


@pytest.mark.live
def test_an_arm_that_does_not_stop_is_named(problems, bench):
    assert problems("arm driver", bench.module.BenchArm, moves=True) == ""
    found = problems("arm driver", goes_on(bench), moves=True)
    assert "after it was stopped" in found


# ---- cameras ----


def frames(change):
    def make(bench):
        def __init__(self, arm, settings, report):
            bench.module.BenchCamera.__init__(self, arm, settings, lambda frame: report(change(frame)))

        return like(bench.module.BenchCamera, __init__=__init__)

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
    "close(when) is called as close()": lambda bench: like(
        bench.module.BenchCamera, close=lambda self, when: None
    ),
    "has no settings_class": lambda bench: like(bench.module.BenchCamera, settings_class=3),
    "is called as Mine(arm, settings, report)": lambda bench: like(
        bench.module.BenchCamera, __init__=lambda self: None
    ),
    "must be a class": lambda bench: 3,
    "reports a dict, must be a CameraFrame": frames(lambda frame: {"image": frame.image}),
    "images are float64": frames(lambda frame: replace(frame, image=frame.image * 1.0)),
    "must be uint8 (height, width)": frames(
        lambda frame: replace(frame, image=np.zeros((4, 4, 3), np.uint8))
    ),
    "images change their size": frames(growing()),
    "changes after it was reported": frames(one_buffer()),
    "stamps do not rise": frames(lambda frame: replace(frame, stamp_ns=10**18)),
    "must be below 1 s": frames(lambda frame: replace(frame, stamp_ns=frame.stamp_ns + 3 * 10**9)),
    "the number of lost exposures falls": frames(lambda frame: replace(frame, lost=frame.stamp_ns % 7)),
    "rate says 500 Hz": lambda bench: like(bench.module.BenchCamera, rate=property(claimed, ignored)),
}


@pytest.mark.live
@pytest.mark.parametrize("words", CAMERAS)
def test_a_mistake_in_a_camera_is_named(problems, bench, words):
    assert words in problems("camera driver", CAMERAS[words](bench))


# ---- the command, and what is loaded ----


def test_the_command_says_what_was_found(bench, capsys):
    assert cli.main(["check", "drift"]) == 0
    assert "body motion drift: keeps its contract" in capsys.readouterr().out
    assert cli.main(["check", "dome", "--set", "radius=-1"]) == 2
    assert "radius" in capsys.readouterr().err
    assert cli.main(["check", "bench_arm"]) == 2
    assert "--scene my_cell.yaml" in capsys.readouterr().err
    assert cli.main(["check", "nothing"]) == 2
    assert "no plug-in has that name" in capsys.readouterr().err


def test_a_wrong_signature_is_refused_when_it_is_loaded_before_anything_moves(bench, monkeypatch):
    from tactile_drivers.arm import ARMS as REGISTRY

    monkeypatch.setattr(bench.module.BenchArm, "command", lambda self, twist: None)
    with pytest.raises(
        SettingError, match=r"command\(twist\) is called as command\(stamp_ns, twist\).*py:\d+"
    ):
        REGISTRY.load("bench_arm")
