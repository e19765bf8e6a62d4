"""Tries a plug-in on what its contract says, and names what it does not keep; `tactile check`, and in tests::

    from tactile_bringup.plugin_check import check_plugin

    def test_my_shape_keeps_its_contract():
        assert check_plugin("shape", "my_bodies.dent:Dent", {"radius": 0.02}) == []

What is tried of each kind stands in the functions below. Arms and cameras are opened: they are those of a
scene. An arm is not moved unless that is asked for.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.raised import in_short, raised_at
from tactile_base.registry import Registry
from tactile_base.settings import SettingError, unknown_name
from tactile_base.stamps import SECOND_NS
from tactile_bringup.driver_check import check_arm, check_camera, not_rigid, numbers
from tactile_control.phases import Command, StampedPose, StampedPresence, TaskInputs
from tactile_control.tasks import TASKS
from tactile_doubles.rehearsal import DOUBLES
from tactile_perception.estimating.contact_model import CONTACT_MODELS
from tactile_records.runs.report import REPORTS
from tactile_scene.arm import ARMS
from tactile_scene.camera import CAMERAS
from tactile_scene.motions import MOTIONS
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes import SHAPES

Array = NDArray[np.float64]
Problems = Iterator[str]

#: All of them.
REGISTRIES: tuple[Registry[Any], ...] = (
    TASKS,
    REPORTS,
    ARMS,
    DOUBLES,
    CAMERAS,
    SHAPES,
    MOTIONS,
    CONTACT_MODELS,
)
POINTS, STEP = 400, 1e-6  # m: for derivatives
SMOOTH = 0.97  # part of the points at which a normal has to be the gradient: edges and medial axes have none
SPEED, TURN_RATE = 5.0, 50.0  # m/s, rad/s: a body that goes faster jumps
CALL = 0.01  # s, that a step may take
NAMESAKES = ("report", "double")  # called as the task, or the driver, that they are of
PAUSES = 3  # of so few the machine may be the reason


class Unusable(str):
    """A problem that keeps a plug-in from being used at all."""


def check_plugin(
    kind: str,
    plugin: str,
    settings: Mapping[str, Any] | None = None,
    scene: str = "",
    arm: str = "",
    moves: bool = False,
    goal: Mapping[str, Any] | None = None,
) -> list[str]:
    """What a plug-in does not keep of its contract; empty where nothing was found.

    Parameters
    ----------
    kind : as `tactile plugins` says it: "task", "shape", "body motion", "arm driver", "camera driver", ..
    plugin : its name, or "module:attribute" of one that is not installed yet
    settings : of its settings class, in place of the defaults. Of a driver they are the scene's.
    goal : of a task: what its goal says
    scene, arm : of a driver: the scene and the arm that it is opened for
    moves : whether an arm may be moved: 1 mm along z of its controlled frame, away from the surface, and back
    """
    by_kind = {registry.kind: registry for registry in REGISTRIES}
    if kind not in by_kind:
        raise SettingError(f"kind: {unknown_name(kind, list(by_kind))}")
    registry = by_kind[kind]
    found = registry.load_place(plugin, plugin) if ":" in plugin else registry.load(plugin)
    if problems := registry.contract.objections(found):
        return problems
    values = dict(settings or {})
    tries: dict[str, Callable[[], Problems]] = {
        "shape": lambda: check_shape(found, values),
        "body motion": lambda: check_motion(found, values),
        "task": lambda: check_task(found, values, goal or {}),
        "arm driver": lambda: check_arm(found, scene, arm, moves),
        "camera driver": lambda: check_camera(found, scene, arm),
    }
    if kind not in tries:
        return []
    problems = []
    try:
        problems.extend(tries[kind]())
    except SettingError:
        raise  # what was asked for is wrong, not the plug-in
    except Exception as error:  # somebody else's code may raise anything
        problems.append(f"raises {in_short(error)} ({raised_at(error)})")
    return problems


def kind_of(plugin: str) -> str:
    """The kind of a plug-in by its name; `SettingError` where several have it, or none.

    A report has the name of its task, and a double that of its driver: the name means these.
    """
    named = [registry.kind for registry in REGISTRIES if plugin in registry.names()]
    kinds = [kind for kind in named if kind not in NAMESAKES] or named
    if len(kinds) != 1:
        known = ", ".join(registry.kind for registry in REGISTRIES)
        what = f"several have that name ({', '.join(kinds)})" if kinds else "no plug-in has that name"
        raise SettingError(f"{plugin}: {what}: say --kind, one of {known}")
    return kinds[0]


# ---- shapes ----


def check_shape(kind: Any, values: Mapping[str, Any]) -> Problems:
    """Distances and normals at points about its surface, its grid and its mesh."""
    yield from try_shape(kind(kind.settings_class.from_mapping(values, "settings")))


def try_shape(shape: Any) -> Problems:
    """Check an instance's distances, normals, grid and mesh; `Unusable` is what no run can be made with."""
    grid = np.asarray(shape.grid(20), dtype=np.float64)
    if grid.ndim != 3 or grid.shape[2] != 3 or not np.isfinite(grid).all():
        yield Unusable(f"grid(20) has the shape {grid.shape}, must be finite points (rows, columns, 3)")
        return
    surface, rng = grid.reshape(-1, 3), np.random.default_rng(0)
    points = surface[rng.integers(0, len(surface), POINTS)] + rng.uniform(-0.005, 0.005, (POINTS, 3))
    given = points.copy()
    distance, normal = (np.asarray(item) for item in shape.query(points))
    if (distance.shape, normal.shape) != ((POINTS,), (POINTS, 3)):
        shapes = f"{distance.shape} and {normal.shape}"
        yield Unusable(f"query of (N, 3) points gives {shapes}, must be (N,) and (N, 3)")
        return
    if not (np.isfinite(distance).all() and np.isfinite(normal).all()):
        yield Unusable("query gives numbers that are not finite")
        return
    if not np.array_equal(points, given):
        yield "query changes the points that it is given"
    yield from _distances(shape, surface, points, distance)
    yield from _normals(shape, points, normal)
    yield from _faces(shape)


def _distances(shape: Any, surface: Array, points: Array, distance: Array) -> Problems:
    off = np.abs(shape.query(surface)[0]).max()
    if off > 1e-4:
        yield f"points of its grid lie up to {off * 1e3:.3g} mm off the surface, must be on it"
    one = np.array([shape.query(point[None])[0][0] for point in points[:20]])
    if not np.allclose(one, distance[:20], atol=1e-12):
        yield "a point alone has another distance than among others"
    change = np.abs(np.diff(distance)) - np.linalg.norm(np.diff(points, axis=0), axis=1)
    if change.max() > 1e-9:
        yield f"the distance changes by {change.max() * 1e3:.3g} mm more than the way: it is no distance"


def _normals(shape: Any, points: Array, normal: Array) -> Problems:
    length = np.linalg.norm(normal, axis=1)
    if np.abs(length - 1.0).max() > 1e-6:
        yield f"normals have lengths from {length.min():.3g} to {length.max():.3g}, must be 1"
    steps = STEP * np.eye(3)
    gradient = np.stack(
        [(shape.query(points + h)[0] - shape.query(points - h)[0]) / (2.0 * STEP) for h in steps], axis=1
    )
    wrong = np.linalg.norm(gradient - normal, axis=1) > 1e-3
    if wrong.mean() > 1.0 - SMOOTH:
        worst = int(np.argmax(wrong))
        yield (
            f"at {wrong.mean():.0%} of the points the normal is not the gradient of the distance: at "
            f"{numbers(points[worst])} m it is {numbers(normal[worst])}, "
            f"the gradient {numbers(gradient[worst])}"
        )


def _faces(shape: Any) -> Problems:
    vertices, faces = shape.mesh(20)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    whole = np.linalg.norm(across, axis=1) > 1e-12
    outward = (across * shape.query((a + b + c) / 3.0)[1]).sum(axis=1)
    inside_out = float((outward[whole] < 0.0).mean()) if whole.any() else 0.0
    if inside_out > 0.05:
        yield f"{inside_out:.0%} of its mesh shows its inside: a row cross the next points outward"


# ---- motions ----

_SCENE = """\
arms:
  arm: {driver: sim, start: {position: [0.0, 0.0, 0.2], rotation_deg: [0, 180, 0]}, sensor: {}}
bodies:
  body: {shape: box, parameters: {size: [0.1, 0.1, 0.1]}, pose: {position: [0.0, 0.0, 0.05]}}
"""


def check_motion(kind: Any, values: Mapping[str, Any]) -> Problems:
    """Two seconds of a box in a scene with one arm, which stands still and does not touch it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(_SCENE)
        scene = load_scene(path)
    body = scene.bodies["body"]
    settings = kind.settings_class.from_mapping(values, "settings")
    yield from try_motion(lambda: kind(scene, body, settings), scene, "body")


def try_motion(make: Callable[[], Any], scene: Any, body: str) -> Problems:
    """Two seconds of the motion of a body of a scene, whose arms stand still and do not touch it."""
    tools = {name: arm.T_world_start for name, arm in scene.arms.items()}
    first, second = make(), make()
    carriers = first.carriers
    if not isinstance(carriers, tuple) or not set(carriers) <= set(scene.arms):
        yield Unusable(f"carriers is {carriers!r}, must be a tuple of names of arms")
    before, dt = scene.T_world_body(body), 1.0 / 120.0
    for number in range(240):
        T, again = (np.asarray(motion.step(dt, tools, [])) for motion in (first, second))
        if problem := not_rigid(T):
            yield Unusable(f"step {number}: {problem}")
            return
        if not np.array_equal(T, again):
            yield f"step {number}: two of them in the same scene go different ways"
            return
        way, angle = _apart(before, T)
        if way > SPEED * dt or angle > TURN_RATE * dt:
            start = " from where the scene has it" if number == 0 else ""
            jump = f"{way * 1e3:.3g} mm and {np.degrees(angle):.3g} deg"
            yield f"step {number}: the body jumps by {jump}{start}"
            return
        before = T


def _apart(a: Array, b: Array) -> tuple[float, float]:
    """Way (m) and angle (rad) between two poses."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0) / 2.0
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), float(np.arccos(np.clip(cosine, -1.0, 1.0)))


# ---- tasks ----


def check_task(kind: Any, values: Mapping[str, Any], wanted: Mapping[str, Any]) -> Problems:
    """Its steps: without inputs, with an arm that stands still, and after a stop."""
    settings = kind.settings_class().merged(values, "settings")
    goal = kind.goal_class.from_mapping(wanted, "goal")
    if kind.needs_images:  # which it would have to be given, and a folder to keep them in
        return
    for name, inputs in (("without inputs", False), ("with an arm that stands still", True)):
        task = kind(settings, goal, None)
        yield from (f"{name}: {problem}" for problem in _steps(task, inputs))


def _steps(task: Any, inputs: bool) -> Problems:
    """Three seconds, then a stop, after which it has to end within a minute of its own time."""
    now_ns, period_ns, took = SECOND_NS, SECOND_NS // 120, list[float]()
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    for number in range(360 + 60 * 120):
        if number == 360:
            task.stop("it is tried out")
        now_ns += period_ns
        given = TaskInputs(
            None,
            StampedPresence(now_ns, False) if inputs else None,
            StampedPose(now_ns, pose) if inputs else None,
        )
        watch = _Stopwatch()
        command = task.step(now_ns, given)
        took.append(watch.seconds())
        if not isinstance(command, Command):
            yield f"step gives a {type(command).__name__}, must be a Command"
            return
        twist = np.asarray(command.twist)
        if twist.shape != (6,) or not np.isfinite(twist).all():
            yield f"in phase {command.phase} the twist is {twist!r}, must be six finite numbers"
            return
        if task.traceback:
            yield f"in phase {command.phase}: {command.reason}"
            return
        if command.phase not in type(task).phases:
            yield f"phase '{command.phase}' is not among its phases"
            return
        if not inputs and np.any(twist):
            yield f"it moves without knowing where the arm is: {numbers(twist)}"
            return
        if command.done:
            break
    else:
        yield "it does not end within 60 s after it was asked to stop"
    slow = [seconds for seconds in took if seconds > CALL]
    if len(slow) >= PAUSES:
        yield f"{len(slow)} steps took {min(slow) * 1e3:.0f} ms and more; images come every 8 to 17 ms"


class _Stopwatch:
    """How long a call takes of its own accord: time in which another process has its core does not count."""

    def __init__(self) -> None:
        self._begun, self._worked, self._waits = self._now()

    def seconds(self) -> float:
        """Since it was made; a thread that gave up its core by itself (sleep, lock) waited all of it."""
        now, worked, waits = self._now()
        return now - self._begun if waits > self._waits else worked - self._worked

    @staticmethod
    def _now() -> tuple[float, float, int]:
        waits = resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw
        return time.perf_counter(), time.thread_time(), waits
