"""Object tracking on a small plant whose surface moves: the lag that gains leave, and what takes it away."""

import numpy as np
import pytest
from kinematic_plant import MS, Plane, Plant, freeze_after, pointing_down, rest_after, run

from tactile_base.settings import SettingError
from tactile_control.contact_phases import APPROACH, SETTLE
from tactile_control.phases import DONE, FAILED, RETREAT, STOPPING
from tactile_control.task_file import load_controller
from tactile_control.tasks.object_tracking import (
    TRACK,
    ObjectTracking,
    ObjectTrackingSettings,
    TrackingGoal,
)

CONTROLLER = "config/controllers/object_tracking.yaml"
MM = 1e-3
SPEED = 0.005  # m/s
DEPTH = 0.006  # m, the reference of the paper's table
WHEN = 5_000_000_000  # ns; by then it tracks


class MovingPlane(Plane):
    """z = height, which rises at `speed` from `WHEN` on."""

    def __init__(self, speed=0.0):
        self.speed, self.height = speed, 0.0

    def query(self, p):
        distance, normal = super().query(p)
        return distance - self.height, normal


class MovingPlant(Plant):
    """The surface moves with the plant's own clock; a late input shows the surface as it was."""

    def __init__(self, surface, T, **kwargs):
        super().__init__(surface, T, **kwargs)
        self.heights = {self.now_ns: 0.0}

    def step(self, twist):
        super().step(twist)
        self.surface.height = self.surface.speed * max(0.0, (self.now_ns - WHEN) * 1e-9)
        self.heights[self.now_ns] = self.surface.height

    def inputs(self):
        stamp_ns = self.history[max(0, len(self.history) - 1 - self.delay_steps)][0]
        now, self.surface.height = self.surface.height, self.heights[stamp_ns]
        try:
            return super().inputs()
        finally:
            self.surface.height = now


@pytest.fixture
def settings(request):
    return load_controller(request.config.rootpath / CONTROLLER, ObjectTrackingSettings())


def proportional(settings, **changes):
    """The paper's gains without integral and derivative."""
    return settings.replaced(pid__ki=[0.0] * 6, pid__kd=[0.0] * 6, **changes)


def tracked(settings, speed=SPEED, seconds=10.0, delay_steps=1, goal=None, **more):
    """Plant, task and commands of a run that is asked to finish after so long."""
    plant = MovingPlant(MovingPlane(speed), pointing_down((0.0, 0.0, 0.024)), delay_steps=delay_steps)
    task = ObjectTracking(settings, goal or TrackingGoal())
    commands = run(
        task, plant, each=lambda k, c: task.finish() if plant.now_ns > WHEN + seconds * 1e9 else None, **more
    )
    return plant, task, commands


def lag(commands):
    """Mean of true depth over the reference (m) in the last second of tracking."""
    depths = [(now, depth - DEPTH) for now, c, depth, _ in commands if c.phase == TRACK]
    return float(np.mean([depth for now, depth in depths if now > depths[-1][0] - 1000 * MS]))


def phases_of(commands):
    order = [command.phase for _, command, _, _ in commands]
    return [phase for k, phase in enumerate(order) if k == 0 or order[k - 1] != phase]


def test_a_surface_at_rest_is_held_at_the_reference(settings):
    _, _, commands = tracked(settings, speed=0.0)
    assert abs(lag(commands)) < 0.02 * MM


@pytest.mark.parametrize("speed", [SPEED, -SPEED])
def test_proportional_gains_leave_a_lag_of_speed_over_gain(settings, speed):
    """A surface that rises by itself goes deeper by v / Kp, one that falls less deep by as much."""
    _, _, commands = tracked(proportional(settings), speed=speed)
    assert lag(commands) == pytest.approx(speed / 5.0, rel=0.05)


def test_the_papers_integral_takes_the_lag_away_slowly(settings):
    """Ki = 0.5 over Kp = 5: a time constant of some 10 s, less what the derivative gain does."""
    plain = lag(tracked(proportional(settings), seconds=6.0)[2])
    after = lag(tracked(settings, seconds=6.0)[2])
    assert 0.3 * plain < after < 0.8 * plain


@pytest.mark.parametrize("speed", [SPEED, -SPEED])
def test_the_surfaces_own_velocity_fed_forward_takes_nearly_all_of_the_lag(settings, speed):
    plain = lag(tracked(proportional(settings), speed=speed)[2])
    fed = lag(tracked(proportional(settings, task__feedforward=1.0), speed=speed)[2])
    assert abs(fed) < 0.15 * abs(plain)


def test_half_of_the_velocity_fed_forward_takes_half_of_the_lag(settings):
    plain = lag(tracked(proportional(settings))[2])
    fed = lag(tracked(proportional(settings, task__feedforward=0.5))[2])
    assert fed == pytest.approx(0.5 * plain, rel=0.15)


def test_what_is_fed_forward_is_the_surfaces_velocity_and_shown_as_such(settings):
    _, _, commands = tracked(proportional(settings, task__feedforward=1.0))
    last = [c for _, c, _, _ in commands if c.phase == TRACK][-1]
    # the sensor's z points down: the surface comes up against it
    np.testing.assert_allclose(last.feedforward[:3], [0.0, 0.0, -SPEED], atol=0.1 * SPEED)
    still = [c for _, c, _, _ in tracked(settings, seconds=2.0)[2] if c.phase == TRACK]
    assert not np.any([c.feedforward for c in still])


def test_finishing_ends_well_with_a_retreat(settings):
    plant, _, commands = tracked(settings, seconds=2.0)
    last = commands[-1][1]
    assert phases_of(commands) == [APPROACH, SETTLE, TRACK, STOPPING, RETREAT, DONE]
    assert last.succeeded and last.reason == "" and last.progress == 1.0
    assert plant.depth < DEPTH - 0.010


def test_a_stop_retreats_too_but_fails_with_its_reason(settings):
    plant = MovingPlant(MovingPlane(SPEED), pointing_down((0.0, 0.0, 0.024)))
    task = ObjectTracking(settings, TrackingGoal())
    commands = run(task, plant, each=lambda k, c: task.stop("Ctrl-C") if k == 400 else None)
    assert phases_of(commands)[-3:] == [STOPPING, RETREAT, FAILED]
    assert commands[-1][1].reason == "Ctrl-C" and plant.depth < 0.0


def test_without_a_duration_it_goes_on_until_it_is_asked_to_end(settings):
    plant = MovingPlant(MovingPlane(), pointing_down((0.0, 0.0, 0.024)))
    commands = run(ObjectTracking(settings, TrackingGoal()), plant, limit_s=60.0)
    assert ObjectTracking.endless and commands[-1][1].phase == TRACK
    progress = [c.progress for _, c, _, _ in commands]
    assert progress == sorted(progress) and progress[-1] < 0.5, "nothing is known of it"


def test_with_a_duration_it_ends_well_after_it(settings):
    plant = MovingPlant(MovingPlane(), pointing_down((0.0, 0.0, 0.024)))
    commands = run(ObjectTracking(settings, TrackingGoal(duration=3.0)), plant)
    stamps = [now for now, c, _, _ in commands if c.phase == TRACK]
    assert (stamps[-1] - stamps[0]) / MS == pytest.approx(3000.0, abs=50.0)
    assert commands[-1][1].succeeded and phases_of(commands)[-2:] == [RETREAT, DONE]
    progress = [c.progress for _, c, _, _ in commands]
    assert progress == sorted(progress)
    assert any(0.4 < c.progress < 0.6 for _, c, _, _ in commands)


def test_a_surface_that_goes_away_faster_than_the_arm_may_is_lost_and_said_so(settings):
    settings = settings.replaced(limiter__linear_speed=0.004, contact__lost_contact="fail")
    _, _, commands = tracked(settings, speed=-0.02)
    assert commands[-1][1].phase == FAILED
    assert commands[-1][1].reason == "contact was lost in phase track"


@pytest.mark.parametrize(
    "names, expected",
    [(("presence",), "presence is"), (("sensor_pose",), "pose is")],
)
def test_a_silent_input_stops_the_arm_within_200_ms_and_is_named(settings, names, expected):
    at_ns = WHEN + 3_000_000_000
    settings = settings.replaced(surface__depth_margin=0.1)  # the surface goes on into the arm at rest
    _, _, commands = tracked(settings, change=freeze_after(names, at_ns), delay_steps=0)
    assert max(np.abs(c.twist).max() for now, c, _, _ in commands if WHEN < now < at_ns) > 0.004
    assert rest_after(commands, at_ns) <= 200.0
    last = commands[-1][1]
    assert last.phase == FAILED and expected in last.reason and "limit 100 ms" in last.reason


def test_a_surface_that_jumps_away_is_approached_again(settings):
    """Without contact there are no beliefs either: that is no silence of an input."""
    plant = MovingPlant(MovingPlane(), pointing_down((0.0, 0.0, 0.024)))
    task, dropped = ObjectTracking(settings, TrackingGoal(duration=4.0)), []

    def drop(k, command):
        if command.phase == TRACK and plant.now_ns > WHEN and not dropped:
            plant.T[2, 3] += 0.010
            dropped.append(k)

    commands = run(task, plant, each=drop)
    assert phases_of(commands) == [APPROACH, SETTLE, TRACK, APPROACH, SETTLE, TRACK, RETREAT, DONE]
    assert commands[-1][1].succeeded


def test_feedforward_set_in_mid_run_comes_without_a_jump(settings):
    plant = MovingPlant(MovingPlane(SPEED), pointing_down((0.0, 0.0, 0.024)))
    settings = proportional(settings, prediction__enabled=False)
    task = ObjectTracking(settings, TrackingGoal(duration=10.0))
    at = []

    def feed(k, command):
        if plant.now_ns > WHEN + 2 * 10**9 and not at:
            at.append(k)
            task.configure(settings.replaced(task__feedforward=1.0))

    commands = run(task, plant, each=feed)
    twists = np.array([c.twist for _, c, _, _ in commands])
    jumps = np.abs(np.diff(twists[at[0] : at[0] + 60, 2]))
    assert commands[-1][1].succeeded and jumps.max() < 0.2 * SPEED


@pytest.mark.parametrize("bad", [{"duration": -1.0}, {"duration": float("nan")}])
def test_a_duration_that_makes_no_sense_is_refused(bad):
    with pytest.raises(SettingError, match="duration"):
        TrackingGoal(**bad)
