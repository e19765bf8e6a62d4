"""The controller node: goals, commands, watchdog, parameters, and zero as its last word."""

import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from controlled_arm import CONTROLLER, PATIENT, PERIOD, SECOND, SENSOR, ControlledArm
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Pose, PoseArray, Quaternion
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import ListParameters
from tf2_msgs.msg import TFMessage

from tactile_drivers.ownership import REST_FIRST
from tactile_geometry import se3
from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmStatus, ContactForce, ContactState, ControllerStatus
from tactile_ros import qos
from tactile_ros.conversions import (
    header,
    ns_from_time,
    time_from_ns,
    transform_stamped,
)

FAST = {
    "contact.settle_time": 0.05,
    "contact.retreat_distance": 0.001,
    "task.ramp_time": 0.1,
    "watchdog.start_timeout": PATIENT,
    "contact.settle_timeout": PATIENT,
    "watchdog.patience": PATIENT,
}


class World(ControlledArm):
    """Stands for arm, camera, estimator and filter: what the controller sees."""

    def __init__(self, graph) -> None:
        super().__init__(graph)
        self.state_out = graph.publisher(ContactState, "contact/state")
        self.arm_out = graph.publisher(ArmStatus, "arm/status")
        self.force_out = graph.publisher(ContactForce, "contact/wrench_belief")
        self.reset()

    def reset(self) -> None:
        self.T = np.eye(4)
        self.depth = 0.003
        self.in_contact = True
        self.images = True
        self.force: float | None = None  # N, that the skin gives back; None: nobody tells it
        self.arm_status = ArmStatus()
        self.lie = lambda message: None
        self.hear_anew()

    def restart(self) -> None:
        """A new start of the controller."""
        self.graph.restart("controller")
        self.patience(PATIENT)
        self.reset()
        assert self.is_heard(), "no twist arrives"

    def patience(self, seconds: float) -> None:
        self.set("watchdog.patience", seconds)

    def step(self, stamp_ns: int | None = None) -> None:
        """One period: the arm follows the last twist, and an image is taken unless the camera is silent."""
        stamp_ns = self.graph.now_ns() if stamp_ns is None else stamp_ns
        self.follow_twist(stamp_ns)
        self.arm.at(stamp_ns, self.T)
        self.arm_out.publish(self.arm_status)
        if self.images:
            self.last_stamp = stamp_ns
            if self.force is not None:
                told = {"force": [0.0, 0.0, -self.force], "covariance": (0.01 * np.eye(3)).ravel()}
                self.force_out.publish(ContactForce(header=header(stamp_ns, SENSOR), **told))
            self.state_out.publish(self.state(stamp_ns))

    def state(self, stamp_ns: int) -> ContactState:
        """What the filter says; `lie` changes it."""
        message = self.true_state(stamp_ns)
        self.lie(message)
        return message

    def true_state(self, stamp_ns: int) -> ContactState:
        xi = np.array([0.0, 0.0, -self.depth, 0.0, 0.0, 0.0])
        there = not self.statuses or self.phase() not in ("idle", "done", "failed", "leave")
        flags = (
            ContactState.MEASUREMENT_FUSED
            if self.in_contact and there
            else ContactState.NO_CONTACT | ContactState.INVALID
        )
        return ContactState(header=header(stamp_ns, SENSOR), xi=xi, flags=flags)

    def rests(self) -> bool:
        return bool(np.all(self.twist() == 0.0))

    def send(self, **changes):
        goal = {"task": "surface_following", "name": "line", "goal": "{direction_deg: 90.0, length: 0.5}"}
        return super().send(**{**goal, **changes})

    def following(self):
        """Send a goal and run until the surface is followed at speed; returns the goal's handle."""
        handle = self.send()
        assert self.run_until(lambda: self.phase() == "follow" and self.twist()[1] > 0.005), self.statuses[-1]
        return handle

    def recovers(self) -> bool:
        """Whether a goal that is asked for again runs once the arm's trouble is over."""
        self.arm_status = ArmStatus()

        def runs() -> bool:
            ended = self.send().get_result_async()
            return self.run_until(lambda: ended.done() or self.phase() == "follow") and not ended.done()

        return self.run_until(runs)


@pytest.fixture(scope="module")
def running(shared_graph):
    shared_graph.start(CONTROLLER, FAST)
    return World(shared_graph)


@pytest.fixture
def world(running):
    running.restart()
    return running


def test_no_parameter_has_the_name_of_a_group_of_others(world):
    """`ros2 param dump` nests names at their dots, and ends with an error where one is both."""
    names = world.graph.call(
        ListParameters, "controller/list_parameters", ListParameters.Request()
    ).result.names
    assert len(names) > 100 and not [name for name in names if any(n.startswith(f"{name}.") for n in names)]


def test_without_a_goal_the_twist_is_zero(world):
    assert world.run_until(lambda: len(world.twists) > 5)
    assert all(np.all(m.twist == 0.0) for m in world.twists)
    assert world.phase() == "idle"


def test_a_task_at_a_force_presses_until_it_is_there_and_rests_when_nobody_tells_it_any_more(world):
    world.force = 0.5
    world.set("force.normal", 1.0)
    try:
        world.following()
        deeper = world.statuses[-1].reference[2]
        assert world.run_until(lambda: world.statuses[-1].reference[2] > max(deeper, 0.003) + 0.0002)
        world.force = 1.0
        assert world.run_until(lambda: len(world.statuses) > 3 and world.phase() == "follow")
        held = world.statuses[-1].reference[2]
        count = len(world.statuses)
        assert world.run_until(lambda: len(world.statuses) > count + 40)
        assert world.statuses[-1].reference[2] == pytest.approx(held, abs=2e-4)
        assert not world.rests()
        world.force = None
        assert world.run_until(world.rests)
        assert world.run_until(lambda: "force is" in world.statuses[-1].reason)
        world.force = 1.0
        assert world.run_until(lambda: not world.rests())
    finally:
        world.set("force.normal", 0.0)


TROUBLES = {
    "in fault: protective stop": ArmStatus(mode=ArmStatus.FAULT, reason="protective stop: 9 mm deep"),
    "in emergency stop: button": ArmStatus(mode=ArmStatus.ESTOP, reason="button"),
    "commanded by /joystick": ArmStatus(owner="/joystick"),
}


@pytest.mark.parametrize("reason", TROUBLES)
def test_an_arm_that_does_not_follow_ends_the_task_at_once_with_its_reason(world, reason):
    handle = world.following()
    world.arm_status = TROUBLES[reason]
    result = world.result(handle)
    assert not result.success and reason in result.reason
    assert not any(world.twist())
    assert reason in world.result(world.send()).reason
    assert world.recovers()


REFUSALS = {
    # what an arm's node on another clock says of each command, and how old the last one is for it (s)
    "its stamp is 1.7e+09 s ahead of the clock": -1.0,
    "": 2.0,  # commands are lost on their way
}


@pytest.mark.parametrize("refused", REFUSALS)
def test_a_task_whose_commands_are_refused_or_not_heard_fails_with_the_arms_words(world, refused):
    handle = world.following()
    me = world.twists[-1].source
    world.arm_status = ArmStatus(
        owner=me, refused=refused, refused_source=me if refused else "", command_age=REFUSALS[refused]
    )
    result = world.result(handle)
    assert not result.success
    told = f"the arm refuses its commands: {refused}" if refused else "the arm has heard no command for 1 s"
    assert told in result.reason
    assert world.recovers()


def test_a_task_whose_arm_waits_for_rest_gives_it_and_goes_on(world):
    """As after half a second in which the controller, or the arm's node, was held up."""
    handle = world.following()
    me = world.twists[-1].source
    world.arm_status = ArmStatus(refused=REST_FIRST, refused_source=me)
    assert world.run_until(world.rests)
    world.arm_status = ArmStatus(owner=me)
    assert world.run_until(lambda: world.twist()[1] > 0.005) and world.phase() == "follow"
    handle.cancel_goal_async()
    assert world.result(handle).reason == "cancelled"


def test_a_goal_runs_through_all_phases_to_success_with_feedback(world):
    feedback = []
    goal = RunTask.Goal(task="surface_following", name="line", goal="{direction_deg: 90.0, length: 0.004}")
    future = world.client.send_goal_async(goal, feedback_callback=lambda m: feedback.append(m.feedback))
    assert world.run_until(future.done)
    result = world.result(future.result())
    assert result.success, result.reason
    assert result.path_length == pytest.approx(0.004, abs=0.001)
    phases = list(dict.fromkeys(status.phase for status in world.statuses))
    assert phases == ["idle", "approach", "settle", "follow", "retreat", "done"]
    assert {status.goal_name for status in world.statuses[5:] if status.phase == "follow"} == {"line"}
    assert [f.progress for f in feedback] == sorted(f.progress for f in feedback)
    assert any(f.depth == pytest.approx(0.003, abs=1e-6) for f in feedback)
    assert world.run_until(world.rests)


def test_it_tells_twice_a_second_where_the_goal_leads_until_that_has_ended(world):
    paths = world.graph.collect(PoseArray, "controller/path")
    handle = world.following()
    paths.clear()
    assert world.run_until(lambda: len(paths) >= 4)
    assert all(path.header.frame_id == "arm/base" and len(path.poses) == 1 for path in paths)
    assert paths[-1].poses[0].position.y == pytest.approx(0.5, abs=0.01), "of 0.5 m along y"
    stamps = [ns_from_time(path.header.stamp) for path in paths]
    assert min(np.diff(stamps)) >= 0.5 * SECOND
    handle.cancel_goal_async()
    assert world.result(handle).reason == "cancelled"
    assert world.run_until(lambda: not paths[-1].poses)


def test_a_command_answers_its_belief_and_is_stamped_at_emission(world):
    world.following()
    told = [s for s in world.statuses if ns_from_time(s.belief_stamp)]
    ages = [ns_from_time(s.header.stamp) - ns_from_time(s.belief_stamp) for s in told]
    assert 0 < min(ages) < 0.1 * SECOND
    np.testing.assert_allclose([s.belief_age for s in told], np.array(ages) / SECOND, atol=1e-6)


def test_an_image_stream_that_stops_brings_the_twist_to_zero_within_200_ms_and_says_why(world):
    handle = world.following()
    world.patience(1.0)
    world.images = False
    stopped_at = world.last_stamp
    result = world.result(handle)
    moving = [ns_from_time(m.header.stamp) for m in world.twists if np.any(m.twist != 0.0)]
    assert moving[-1] - stopped_at < 0.2 * SECOND
    assert world.rests() and not result.success
    assert "belief" in result.reason and "limit 100 ms" in result.reason


def test_a_task_that_fails_for_want_of_an_input_says_first_why_that_does_not_come(world):
    reports = world.graph.publisher(DiagnosticArray, "/diagnostics", qos.DIAGNOSTICS)
    handle = world.following()
    world.patience(1.0)
    text = "tactile/image refused: repeated: it equals the one before it bit for bit"
    others = DiagnosticStatus(level=b"\2", name="/arm/filter", message="which then is silent, too")
    own = DiagnosticStatus(level=b"\1", name="/arm/estimator", message=text)
    reports.publish(DiagnosticArray(status=[others, own]))
    world.images = False
    result = world.result(handle)
    assert result.reason.startswith(f"/arm/estimator: {text}, so ") and "belief is" in result.reason


class Beside:
    """A controller that works beside another arm's, of which this test says what it says."""

    def __init__(self, graph, role: str, **parameters: float) -> None:
        graph.start(CONTROLLER, {**FAST, role: ["other"], **parameters})
        self.world = World(graph)
        self.partner = graph.publisher(ControllerStatus, "/other/controller/status")
        assert graph.wait(lambda: bool(self.world.twists) and bool(self.world.statuses))
        self.goal = self.world.client.send_goal_async(
            RunTask.Goal(task="surface_following", name="line", goal="{direction_deg: 90.0, length: 0.5}")
        )

    def until(self, condition, status: ControllerStatus | None) -> bool:
        """Run while the other one says this at every step; None: nothing."""

        def turn() -> bool:
            if status is not None:
                self.partner.publish(status)
            return condition()

        return self.world.run_until(turn)

    def moving(self) -> bool:
        return self.goal.done() and self.world.phase() == "follow" and self.world.twist()[1] > 0.005

    def says(self, text: str) -> bool:
        return text in self.world.statuses[-1].reason


WELL = ControllerStatus(phase="track", at_work=True)
BLIND = ControllerStatus(phase="track", at_work=True, trouble="presence is 120 ms old, limit 100 ms")


def test_the_task_rests_when_the_arm_that_it_waited_for_waits_or_falls_silent_and_names_it(graph):
    beside = Beside(graph, "awaited")
    world, until, moving = beside.world, beside.until, beside.moving
    assert until(moving, WELL), world.statuses[-1]
    assert until(world.rests, BLIND)
    assert until(lambda: beside.says("other: presence is 120 ms old"), BLIND)
    assert not world.statuses[-1].trouble, "it lacks nothing itself"
    assert until(moving, WELL), "and goes on with it"
    assert until(world.rests, None)
    assert beside.says("other: nothing is heard of its controller")
    assert until(moving, WELL)
    assert until(world.rests, ControllerStatus(phase="done"))
    assert beside.says("other: its task is over")


def test_the_task_minds_the_arm_that_waited_for_it_once_that_is_at_work_and_lets_it_end(graph):
    beside = Beside(graph, "waiting")
    world, until, moving = beside.world, beside.until, beside.moving
    assert until(moving, None), "an arm that has yet to begin is no trouble"
    assert world.statuses[-1].at_work and not world.statuses[-1].trouble
    assert until(world.rests, BLIND)
    assert until(lambda: beside.says("other: presence is 120 ms old"), BLIND)
    assert until(moving, WELL), "and goes on with it"
    assert until(world.rests, None)
    assert until(moving, WELL)
    ended, since = ControllerStatus(phase="done"), len(world.statuses)
    assert until(lambda: len(world.statuses) > since + 60, ended)
    assert moving() and not any(status.reason for status in world.statuses[since + 5 :])


def test_an_object_that_becomes_thinner_between_two_arms_ends_the_task(graph):
    """The other one says that it goes in by 2 mm/s, and this one, which keeps its depth, feels nothing."""
    beside = Beside(graph, "awaited", **{"surface.width_error": 0.0014})
    static = graph.publisher(TFMessage, "/tf_static", qos.TF_STATIC)
    static.publish(TFMessage(transforms=[transform_stamped(0, "world", "arm/base", np.eye(4))]))
    world, since_ns = beside.world, graph.now_ns()

    def facing(rate: float) -> ControllerStatus:
        stamp_ns = graph.now_ns()
        z = 0.12 - rate * (stamp_ns - since_ns) / SECOND
        hold = se3.log(se3.pose_from_euler([0.0, 0.0, z, np.pi, 0.0, 0.0])).tolist()
        return ControllerStatus(phase="track", at_work=True, hold_stamp=time_from_ns(stamp_ns), hold=hold)

    def turn(rate: float, condition) -> bool:
        beside.partner.publish(facing(rate))
        return condition()

    assert world.run_until(lambda: turn(0.0, beside.moving)), world.statuses[-1]
    assert se3.exp(world.statuses[-1].hold)[2, 3] == pytest.approx(world.T[2, 3] - world.depth, abs=1e-4)
    since_ns = graph.now_ns()
    assert world.run_until(lambda: turn(0.002, lambda: world.phase() in ("stopping", "failed")))
    assert beside.says("the object between both arms became 1."), world.statuses[-1]


def test_twists_decrease_smoothly_while_the_watchdog_stops(world):
    world.following()
    world.images = False
    assert world.run_until(world.rests)
    after = [m for m in world.twists if ns_from_time(m.header.stamp) > world.last_stamp + 0.1 * SECOND]
    speeds = np.array([np.linalg.norm(m.twist[:3]) for m in after])
    ages = np.array([ns_from_time(m.header.stamp) - world.last_stamp for m in after]) / SECOND
    assert np.all(np.diff(speeds) <= 0.0)
    assert np.all(speeds <= 0.012 * np.clip((0.185 - ages) / 0.08, 0.0, 1.0)), (
        "a line from full speed to rest"
    )


def test_cancelling_comes_to_rest_retreats_and_ends_as_cancelled(world):
    handle = world.following()
    cancelled = handle.cancel_goal_async()
    assert world.run_until(cancelled.done)
    ended = world.ended(handle)
    assert ended.status == GoalStatus.STATUS_CANCELED
    assert not ended.result.success and ended.result.reason == "cancelled"
    phases = list(dict.fromkeys(status.phase for status in world.statuses))
    assert phases[-3:] == ["stopping", "retreat", "failed"]


def test_a_second_goal_is_refused_while_one_runs(world):
    world.following()
    assert "'line' is running; cancel it first" in world.refusal(name="other")
    count = len(world.statuses)
    assert world.run_until(lambda: len(world.statuses) > count + 5)
    assert world.phase() == "follow"


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"task": "surface_folowing"}, "did you mean 'surface_following'"),
        ({"task": "object_tracking"}, "this controller was started for it"),
        ({"goal": "{direction_deg: 400.0}"}, "direction_deg = 400.0 deg: must lie in [-360, 360] deg"),
        ({"goal": "{length: -1.0}"}, "length = -1.0"),
        ({"goal": "{target_radius: .inf}"}, "target_radius = inf m: must lie in [1e-06, 0.05] m"),
        ({"goal": "{target_radius: .nan}"}, "target_radius: is not a number"),
        ({"goal": "{target_radius: -1}"}, "target_radius = -1.0 m: must lie in"),
        ({"goal": "{target: [.inf, 0, 0]}"}, "target[0] = inf m: must lie in [-10, 10] m"),
        ({"goal": "{target: [0, 0, .nan]}"}, "target[2]: is not a number"),
        ({"settings": "{servoing: {reference: [0, 0, 3.2, 0, 0, 0]}}"}, "reference[2] = 3.2 m: must lie in"),
        ({"goal": "{lenght: 0.1}"}, "did you mean 'length'"),
        ({"goal": "0.1"}, "must hold names and values"),
        ({"goal": "{length: ["}, "goal: not valid YAML"),
        ({"settings": "{task: {speed: 5.0}}"}, "must lie in [0, 0.2] m/s"),
        ({"settings": "{tusk: {speed: 0.01}}"}, "did you mean 'task'"),
        ({"start": [Pose(orientation=Quaternion(w=0.0))]}, "start: "),
    ],
)
def test_a_goal_that_cannot_be_run_is_refused_with_the_reason(world, changes, complaint):
    assert complaint in world.refusal(**changes)
    assert complaint in world.graph.log(CONTROLLER).read_text()


def test_a_parameter_out_of_range_is_refused_with_its_range_and_the_old_value_stays(world):
    answer = world.graph.set_parameter("controller", "task.speed", 9.0)
    assert not answer.successful
    assert "task.speed" in answer.reason and "0.2" in answer.reason
    assert world.graph.get_parameter("controller", "task.speed") == 0.01


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("pid.kp", [1.0, 2.0], "6 elements"),
        ("pid.kp", [0.0, 0.0, math.inf, 0.0, 0.0, 0.0], "kp[2] = inf 1/s: must lie in [0, 100] 1/s"),
        ("pid.kp", [0.0, 0.0, 1e308, 0.0, 0.0, 0.0], "kp[2] = 1e+308 1/s: must lie in [0, 100] 1/s"),
        (
            "servoing.reference",
            [0.0, 0.0, 3.2, 0.0, 0.0, 0.0],
            "reference[2] = 3.2 m: must lie in [0, 0.01] m",
        ),
    ],
)
def test_a_list_with_a_wrong_number_is_refused_by_its_element_and_the_old_one_stays(
    world, name, value, complaint
):
    old = world.graph.get_parameter("controller", name)
    answer = world.graph.set_parameter("controller", name, value)
    assert not answer.successful and complaint in answer.reason
    assert world.graph.get_parameter("controller", name) == old


def test_a_parameter_set_in_mid_run_takes_effect(world):
    world.following()
    assert world.graph.set_parameter("controller", "task.speed", 0.02).successful
    assert world.run_until(lambda: world.twist()[1] == pytest.approx(0.02, rel=0.05)), world.twist()
    assert world.graph.set_parameter("controller", "task.speed", 0.01).successful


def test_settings_of_a_goal_hold_for_it_and_stay_on_top_of_parameters_set_in_mid_run(world):
    handle = world.send(settings="{task: {speed: 0.02}}")
    assert world.run_until(lambda: world.twist()[1] == pytest.approx(0.02, rel=0.05)), world.twist()
    assert world.graph.get_parameter("controller", "task.speed") == 0.01
    assert world.graph.set_parameter(
        "controller", "servoing.reference", [0.0, 0.0, 0.0031, 0.0, 0.0, 0.0]
    ).successful
    assert world.run_until(lambda: world.statuses[-1].reference[2] == 0.0031)
    count = len(world.statuses)
    assert world.run_until(lambda: len(world.statuses) > count + 30)
    assert np.linalg.norm(world.statuses[-1].feedforward[:3]) == pytest.approx(0.02, rel=0.01)
    assert world.graph.set_parameter(
        "controller", "servoing.reference", [0.0, 0.0, 0.003, 0.0, 0.0, 0.0]
    ).successful
    handle.cancel_goal_async()
    world.result(handle)


def test_a_status_names_task_goal_and_reference_and_counts_the_goals(world):
    handle = world.following()
    first = world.statuses[-1].goal
    handle.cancel_goal_async()
    world.result(handle)
    world.following()
    status = world.statuses[-1]
    assert (status.task, status.goal_name, status.header.frame_id) == ("surface_following", "line", SENSOR)
    assert status.goal == first + 1
    np.testing.assert_allclose(status.reference, [0.0, 0.0, 0.003, 0.0, 0.0, 0.0])
    idle = next(s for s in world.statuses if s.phase == "idle")
    assert np.isnan(idle.reference).all() and np.isnan(idle.error).all()


def test_a_nan_belief_never_reaches_the_arm(world):
    handle = world.following()
    world.patience(1.0)
    world.depth = math.nan
    result = world.result(handle)
    assert not result.success
    assert all(np.all(np.isfinite(m.twist)) for m in world.twists)


def deep(message) -> None:
    message.xi[2] = -0.02


def elsewhere(message) -> None:
    message.xi[0] = 10.0


def of_another_sensor(message) -> None:
    message.header.frame_id = "left/tactile_sensor"


def of_the_future(message) -> None:
    message.header.stamp.sec += 100


@pytest.mark.parametrize(
    ("lie", "counter", "complaint"),
    [
        (deep, "beliefs refused", "contact/state refused: depth is 20 mm, must be in [-5, 15] mm"),
        (elsewhere, "beliefs refused", "contact/state refused: shear is 1e+04 mm"),
        (of_another_sensor, "contact/state messages refused", "frame is 'left/tactile_sensor', must be"),
        (of_the_future, "contact/state messages refused", "s ahead of the clock (limit 0.1 s)"),
    ],
)
def test_beliefs_that_cannot_be_are_not_acted_on_and_the_arm_stops(world, lie, counter, complaint):
    handle = world.following()
    world.patience(1.0)
    world.lie = lie
    report = world.graph.wait_for_count("controller", counter) if world.run_until(world.rests) else None
    assert complaint in report.message
    result = world.result(handle)
    assert not result.success and "belief" in result.reason
    speeds = [np.linalg.norm(m.twist[:3]) for m in world.twists if m.twist[2] >= 0.0]  # it leaves along -z
    assert max(speeds) < 0.013, "the speed of the task, and no more"


def of_long_ago(message) -> None:
    message.header.stamp.sec -= 100


def test_one_belief_of_another_time_or_sensor_changes_nothing(world):
    world.following()
    for lie in (of_the_future, of_long_ago, of_another_sensor, deep):
        world.lie = lie
        world.step()
        world.lie = lambda message: None
        count = len(world.statuses)
        assert world.run_until(
            lambda count=count: len(world.statuses) > count + 15 and world.twist()[1] > 0.005
        )
        assert {status.phase for status in world.statuses[count:]} == {"follow"}


def test_a_stray_transform_is_refused_and_counts_for_no_way(world):
    handle = world.following()
    begun = world.statuses[-1].progress
    for _ in range(20):
        world.arm.at(world.graph.now_ns(), se3.exp([0.14, 0.0, 0.0, 0.0, 0.0, 0.0]) @ world.T)
        world.graph.spin(PERIOD / 2)
        world.step()
        world.graph.spin(PERIOD / 2)
    report = world.graph.wait_for_count("controller", "transforms refused", 10)
    assert "'arm/base' -> 'arm/tool' jumped by 1" in report.message
    assert world.phase() == "follow" and world.statuses[-1].progress - begun < 0.05
    handle.cancel_goal_async()
    assert world.result(handle).path_length < 0.1


def test_an_arm_that_is_suddenly_elsewhere_stops_the_task(world):
    handle = world.following()
    world.T = se3.exp([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]) @ world.T
    result = world.result(handle)
    assert not result.success
    assert "'arm/base' -> 'arm/tool' jumped by 2" in result.reason and "stayed there" in result.reason
    world.graph.spin(0.3)  # it may be back by then


def test_time_that_jumps_back_stops_the_task_and_says_so(world):
    handle = world.following()
    world.arm.at(world.graph.now_ns() - 5 * SECOND, world.T)
    result = world.result(handle)
    assert not result.success and "jumped back" in result.reason


def test_a_lifecycle_manager_that_shuts_down_in_mid_run_leaves_a_zero_twist_and_the_client_its_result(graph):
    graph.start(CONTROLLER, FAST)
    world = World(graph)
    world.restart()
    handle = world.following()
    result = handle.get_result_async()
    graph.settle()
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN))
    assert graph.call(ChangeState, "controller/change_state", request).success
    assert graph.wait(result.done) and result.result().result.reason == "the controller was deactivated"
    assert graph.wait(world.rests)
    assert graph.stop(CONTROLLER) == 0


def test_a_parameter_out_of_range_at_start_ends_the_process_and_names_the_parameter(graph):
    process = graph.start(CONTROLLER, {"limiter.linear_speed": 100.0}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    assert "limiter.linear_speed" in graph.log(CONTROLLER).read_text()
