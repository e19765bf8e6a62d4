"""Tasks of another package, with phases and paths of their own, on the simulated cell."""

import sys

import numpy as np
import pytest
from other_package import installed

from tactile_base.config_paths import config_folder
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING
from tactile_control.task_file import NamedGoal, Role, Task, load_controller
from tactile_control.tasks import TASKS
from tactile_scene.scene_file import load_scene

ENTRY_POINTS = """\
[tactile_servoing.tasks]
tapping = tapping:Tapping
circle = circle:Circle
[tactile_servoing.shapes]
torus = circle:Torus
[tactile_servoing.motions]
turning = circle:Turning
"""
SCENE = """\
arms:
  arm:
    base: {position: [-0.45, 0.0, 0.0]}
    start: {position: [0.08, 0.0, 0.082], rotation_deg: [0, 180, 0]}
    sensor: {in_tool: {position: [0.0, 0.0, 0.065]}}
bodies:
"""
RINGS = {"torus": "  ring: {shape: torus}\n", "turning torus": "  ring: {shape: torus, motion: turning}\n"}
TURNS = {"surface__speed": 0.01, "surface__turn_rate": 0.1, "surface__rests_at_first": False}


@pytest.fixture
def run(monkeypatch, tmp_path):
    """A run of a goal, its record and all commands; `each(task, command)` looks on."""
    (tmp_path / "site").mkdir()
    for folder in installed(tmp_path / "site", ENTRY_POINTS):
        monkeypatch.syspath_prepend(folder)

    def do(name, scene, each=lambda task, command: None, settings=None, **goal):
        kind = TASKS.load(name)
        path = config_folder() / "controllers" / "surface_following_tuned.yaml"
        values = load_controller(path, kind.settings_class()).replaced(**(settings or {}))
        if scene in RINGS:
            (tmp_path / f"{scene}.yaml").write_text(SCENE + RINGS[scene])
        scene = load_scene(tmp_path / f"{scene}.yaml" if scene in RINGS else scene)
        role = Role("one", name, values, (NamedGoal("goal", kind.goal_class(**goal)),))
        commands, tasks = [], []
        monkeypatch.setattr(
            kind, "before_phase", lambda self: (tasks.append(self), super(kind, self).before_phase())
        )

        def look(arm, goal_name, command):
            commands.append(command)
            each(tasks[-1], command)

        options = OfflineOptions(fidelity="ideal", seed=0)
        return run_arms_offline(scene, Task(name, scene.name, (role,)), options, look)["arm"], commands

    yield do
    for module in ("tapping", "circle"):
        sys.modules.pop(module, None)


def phases_of(commands):
    seen = [command.phase for command in commands]
    return [phase for k, phase in enumerate(seen) if k == 0 or seen[k - 1] != phase]


def stretches(record, phase):
    """First and last index of the poses of each time in a phase."""
    inside = np.concatenate([[False], record.phase_at(record.pose.stamp_ns) == phase, [False]])
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    return list(zip(edges[::2], edges[1::2] - 1, strict=True))


def test_tapping_touches_holds_leaves_and_steps_aside_again_and_again(run):
    record, commands = run("tapping", "plane", depth=0.002, taps=3, aside=0.006)
    assert record.result["succeeded"], record.result["reason"]
    tap = ["approach", "settle", "hold"]
    between = ["off", "aside"]
    assert phases_of(commands)[1:] == [*tap, *between, *tap, *between, *tap, RETREAT, DONE]
    held = stretches(record, "hold")
    places = np.array([record.pose.T_base_sensor[last, :3, 3] for _, last in held])
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 0.006, atol=3e-4)
    for first, last in held:
        inside = (record.truth.stamp_ns >= record.pose.stamp_ns[first]) & (
            record.truth.stamp_ns <= record.pose.stamp_ns[last]
        )
        assert record.truth.T_fs[inside, 2, 3] == pytest.approx(0.002, abs=3e-4)
        assert (record.pose.stamp_ns[last] - record.pose.stamp_ns[first]) * 1e-9 == pytest.approx(
            0.5, abs=0.05
        )
    assert not record.truth.in_contact[-1]
    progress = [command.progress for command in commands]
    assert progress == sorted(progress) and progress[-1] == 1.0


@pytest.mark.parametrize("phase", ["hold", "off", "aside"])
def test_a_stop_in_a_phase_of_its_own_comes_to_rest_and_leaves(run, phase):
    record, commands = run(
        "tapping", "plane", lambda task, command: task.stop("enough") if command.phase == phase else None
    )
    assert phases_of(commands)[-4:] == [phase, STOPPING, RETREAT, FAILED]
    assert record.result["reason"].endswith("enough") and not record.truth.in_contact[-1]


def test_a_way_aside_that_goes_along_the_surface_ends_the_task(run):
    """Which is what comes of leaving it by nothing."""
    settings = {"contact__retreat_distance": 0.0, "travel__speed": 0.004}
    record, commands = run("tapping", "plane", settings=settings)
    assert phases_of(commands)[-4:] == ["aside", STOPPING, RETREAT, FAILED]
    assert record.result["reason"].endswith("touched something on the way to the place of the next tap")


def test_the_depth_of_a_goal_holds_whatever_the_settings_become(run):
    """It is the one that is servoed to, and the one that a depth is held against."""

    def replace(task, command):
        if command.phase == "settle":
            task.configure(task.settings.replaced(servoing__reference=(0.0, 0.0, 0.006, 0.0, 0.0, 0.0)))

    _, commands = run("tapping", "plane", replace, depth=0.0015, taps=1)
    assert commands[-1].succeeded
    held = [command for command in commands if command.phase == "hold"]
    assert {command.reference[2] for command in held} == {0.0015}


@pytest.mark.parametrize("scene", ["plane", "dome", "torus", "turning torus"])
def test_a_circle_ends_where_it_began_on_any_surface(run, scene):
    record, _ = run("circle", scene, settings=TURNS if "turning" in scene else None, radius=0.025)
    assert record.result["succeeded"], record.result["reason"]
    places = record.pose.T_base_sensor[record.working(record.pose.stamp_ns)][:, :3, 3]
    assert np.linalg.norm(places[-1] - places[0]) < 0.5e-3
    np.testing.assert_allclose(np.ptp(places[:, :2], axis=0), 0.050, atol=0.3e-3)
