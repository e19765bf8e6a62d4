"""The filter node: joins by stamp, waits for TF, predicts, resets, and counts what it drops."""

import itertools
import math
import signal
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from messages import gaussian_from_message, gaussian_message, matrix_from_transform
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from tactile_filter.bayes_filter import ContactFilter, FilterSettings
from tactile_filter.force import ForceFilter, ForceGaussian
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_msgs.msg import ContactForce, ContactPresence, ContactState
from tactile_msgs.srv import ResetFilter
from tactile_ros import qos
from tactile_ros.conversions import header, ns_from_time, time_from_ns, transform_stamped

FILTER = "tactile_ros.nodes.filter_node"
SENSOR = "arm/tactile_sensor"
SECOND = 1_000_000_000
PERIOD_NS = 16_666_667
COV = np.diag([1e-7, 1e-7, 1e-8, 1e-4, 1e-4, 1e-4])


class Feed:
    """Stands for the estimator and the arm; keeps what the filter answers."""

    def __init__(self, graph, process) -> None:
        self.graph = graph
        self.process = process
        self.presences = graph.publisher(ContactPresence, "contact/presence")
        self.estimates = graph.publisher(PoseWithCovarianceStamped, "contact/estimate")
        self.states = graph.collect(ContactState, "contact/state")
        self.beliefs = graph.collect(PoseWithCovarianceStamped, "contact/belief")
        self.arm = graph.arm()

    def restart(self) -> None:
        """A new start of the filter, in a time later than all before.

        Steps are sent faster than their stamps go on; a pose of the last test that is later than the first of
        this one would be taken for where the arm is on its way to, and one that is hardly earlier for a jump.
        """
        self.graph.restart("filter")
        assert self.graph.wait(lambda: time.time_ns() - SECOND // 4 > self.arm.newest_ns)
        self.tf_timeout(5.0)
        self.states.clear()
        self.beliefs.clear()
        self.stamp_ns = time.time_ns() - SECOND // 10

    def tf_timeout(self, seconds: float) -> None:
        assert self.graph.set_parameter("filter", "inputs.tf_timeout", seconds).successful

    def pose(self, k: int) -> np.ndarray:
        """Where the sensor is at step k: it moves along y and turns about x."""
        return se3.exp(np.array([0.0, 0.001 * k, 0.0, 0.02 * k, 0.0, 0.0]))

    def estimate(self, k: int) -> PoseGaussian:
        return PoseGaussian(se3.exp(np.array([0.001, 0.0, -0.003, 0.05, 0.01 * k, 0.0])), COV)

    def step(
        self,
        k: int,
        tf: bool = True,
        in_contact: bool = True,
        estimate: PoseGaussian | None = None,
        still: bool = False,
    ) -> int:
        stamp_ns = self.stamp_ns + k * PERIOD_NS
        if 0 < stamp_ns - time.time_ns() < SECOND:  # answered faster than stamps go on
            self.graph.wait(lambda: time.time_ns() >= stamp_ns)
        if tf:
            self.arm.at(stamp_ns, self.pose(k))
        if in_contact:
            self.send_estimate(stamp_ns, estimate or self.estimate(k))
        self.send_presence(stamp_ns, in_contact, still=still)
        return stamp_ns

    def send_presence(
        self, stamp_ns: int, in_contact: bool = True, frame: str = SENSOR, still: bool = False
    ) -> None:
        said = ContactPresence(header=header(stamp_ns, frame), in_contact=in_contact, still=still)
        self.presences.publish(said)

    def send_estimate(self, stamp_ns: int, estimate: PoseGaussian, frame: str = SENSOR) -> None:
        self.estimates.publish(gaussian_message(stamp_ns, frame, estimate.mean, estimate.cov))

    def state(self, stamp_ns: int, **timeout: float) -> ContactState | None:
        """The state of that stamp, waiting for it; None if it does not come."""

        def found():
            return [m for m in self.states if ns_from_time(m.header.stamp) == stamp_ns]

        self.graph.wait(lambda: bool(found()), **timeout)
        return found()[0] if found() else None


@pytest.fixture(scope="module")
def running(shared_graph):
    process = shared_graph.start(FILTER)
    return Feed(shared_graph, process)


@pytest.fixture
def feed(running):
    running.restart()
    return running


def assert_as_library(feed, states) -> None:
    library = ContactFilter(FilterSettings())
    for k, state in enumerate(states):
        belief = library.step(feed.stamp_ns + k * PERIOD_NS, feed.estimate(k), feed.pose(k))
        np.testing.assert_allclose(state.xi, se3.log(belief.mean), atol=1e-12)
        np.testing.assert_allclose(state.covariance.reshape(6, 6), belief.cov, rtol=1e-6, atol=1e-15)
        np.testing.assert_allclose(state.euler, se3.euler_from_pose(se3.inverse(belief.mean)), atol=1e-12)
        assert state.flags == int(belief.flags) and state.nis_dof == belief.nis_dof
        assert state.inflation == belief.inflation == 1.0
        if belief.nis_dof:
            assert state.nis == pytest.approx(belief.nis, rel=1e-6)


def test_that_images_stand_still_is_said_with_beliefs_until_they_move_again(feed):
    """Of an exposure the estimate comes first, so that it is said with the next one, or the one after it."""
    said = [feed.state(feed.step(k, still=4 <= k < 8)).flags & ContactState.STILL for k in range(12)]
    assert not any(said[:4]) and all(said[6:8]) and not any(said[10:])


def test_beliefs_are_those_of_the_library_with_the_images_stamps(feed):
    stamps = [feed.step(k) for k in range(6)]
    states = [feed.state(stamp) for stamp in stamps]
    assert None not in states
    assert_as_library(feed, states)
    assert 0.0 < ns_from_time(states[-1].latency) / SECOND < 100.0


def test_belief_and_state_say_the_same(feed):
    stamp_ns = feed.step(0)
    state = feed.state(stamp_ns)
    assert feed.graph.wait(lambda: bool(feed.beliefs))
    belief = gaussian_from_message(feed.beliefs[-1].pose)
    np.testing.assert_allclose(belief.mean, se3.exp(state.xi), atol=1e-12)
    np.testing.assert_allclose(belief.cov, state.covariance.reshape(6, 6), rtol=1e-6, atol=1e-15)


def test_the_belief_is_a_frame_of_tf_too(feed):
    transforms = feed.graph.collect(TFMessage, "/tf", qos.TF)
    stamp_ns = feed.step(0)
    state = feed.state(stamp_ns)

    def contact():
        return [t for m in transforms for t in m.transforms if t.child_frame_id == "arm/contact"]

    assert feed.graph.wait(lambda: bool(contact()))
    assert contact()[0].header.frame_id == SENSOR and ns_from_time(contact()[0].header.stamp) == stamp_ns
    T_sensor_contact = matrix_from_transform(contact()[0].transform)
    np.testing.assert_allclose(T_sensor_contact, se3.exp(state.xi), atol=1e-12)


def test_the_order_of_arrival_does_not_matter(feed):
    stamps = [feed.stamp_ns + k * PERIOD_NS for k in range(4)]
    for k in (0, 1):
        feed.send_estimate(stamps[k], feed.estimate(k))
        feed.graph.spin(0.02)
    for k in (0, 1):
        feed.send_presence(stamps[k])
        feed.graph.spin(0.02)
        feed.arm.at(stamps[k], feed.pose(k))
    for k in (2, 3):
        feed.send_presence(stamps[k])
        feed.graph.spin(0.02)
        feed.arm.at(stamps[k], feed.pose(k))
        feed.send_estimate(stamps[k], feed.estimate(k))
    states = [feed.state(stamp) for stamp in stamps]
    assert None not in states
    assert_as_library(feed, states)
    received = [ns_from_time(m.header.stamp) for m in feed.states]
    assert received == sorted(received)


def test_frames_that_came_while_the_node_was_held_up_are_answered(feed):
    assert feed.state(feed.step(0))
    feed.process.send_signal(signal.SIGSTOP)
    sent = 0
    while sent < 40:
        sent += 1
        feed.step(sent)
        feed.graph.spin(PERIOD_NS / SECOND)
    feed.process.send_signal(signal.SIGCONT)
    last = feed.step(sent + 1)
    assert feed.state(last)
    assert feed.graph.wait(lambda: len(feed.states) == sent + 2)


def test_an_estimate_waits_for_its_transform(feed):
    stamp_ns = feed.step(0, tf=False)
    assert feed.state(stamp_ns, timeout=0.05) is None
    feed.arm.at(stamp_ns, feed.pose(0))
    assert feed.state(stamp_ns) is not None


def test_without_tf_an_estimate_is_dropped_after_the_deadline_counted_and_reported(feed):
    feed.tf_timeout(0.05)
    stamp_ns = feed.step(0, tf=False)
    report = feed.graph.wait_for_count("filter", "estimates dropped")
    assert "arm/base" in report.message or "arm/tactile_sensor" in report.message
    assert feed.state(stamp_ns, timeout=0.1) is None
    assert feed.state(feed.step(1)) is not None, "the next one with its transform is processed"


def test_the_transform_of_another_stamp_is_never_used_in_its_place(feed):
    feed.tf_timeout(0.05)
    assert feed.state(feed.step(0)) is not None
    stamp_ns = feed.step(1, tf=False)
    report = feed.graph.wait_for_count("filter", "estimates dropped")
    assert "later" in report.message
    assert feed.state(stamp_ns, timeout=0.1) is None


def test_tf_that_jumps_back_clears_the_belief_and_the_filter_goes_on_in_the_new_time(feed):
    for k in range(3):
        last = feed.state(feed.step(k))
    assert not last.flags & ContactState.REINITIALIZED
    feed.stamp_ns -= 100 * SECOND
    feed.arm.at(feed.stamp_ns, feed.pose(0))
    # an estimate that comes before the first transform of the new time is refused as late
    report = feed.graph.wait_for_count("filter", "restarts")
    state = feed.state(feed.step(0))
    assert state is not None and state.flags & ContactState.REINITIALIZED
    assert report.values["resets: /tf started anew"] == "1"
    following = feed.state(feed.step(1))
    assert following is not None and not following.flags & ContactState.REINITIALIZED


def test_without_contact_there_is_no_belief_and_a_new_contact_starts_a_new_one(feed):
    assert feed.state(feed.step(0)).flags & ContactState.MEASUREMENT_FUSED
    state = feed.state(feed.step(1, in_contact=False))
    assert state.flags & ContactState.NO_CONTACT and state.flags & ContactState.INVALID
    assert np.all(np.isnan(state.xi)) and np.all(np.isnan(state.covariance))
    assert feed.state(feed.step(2)).flags & ContactState.REINITIALIZED


def test_forces_are_filtered_and_forgotten_without_contact(feed):
    told = feed.graph.publisher(ContactForce, "contact/wrench_estimate")
    beliefs = feed.graph.collect(ContactForce, "contact/wrench_belief")
    library, cov = ForceFilter(), np.diag([0.1, 0.1, 0.4])

    def send(k: int, force: list[float]) -> None:
        stamp_ns, count = feed.stamp_ns + k * PERIOD_NS, len(beliefs)
        head = header(stamp_ns, SENSOR)
        told.publish(ContactForce(header=head, force=force, covariance=cov.ravel(), nis=math.nan))
        assert feed.graph.wait(lambda: len(beliefs) > count)
        assert library.step(stamp_ns, ForceGaussian(np.array(force), cov)) == ""
        assert ns_from_time(beliefs[-1].header.stamp) == stamp_ns
        np.testing.assert_allclose(beliefs[-1].force, library.belief.mean, rtol=1e-12)
        np.testing.assert_allclose(beliefs[-1].covariance.reshape(3, 3), library.belief.cov, rtol=1e-12)

    for k in range(4):
        feed.step(k)
        send(k, [0.1, -0.2, 3.0 + 0.1 * k])
    assert np.isfinite(beliefs[-1].nis)
    assert feed.state(feed.step(4, in_contact=False)).flags & ContactState.NO_CONTACT
    library.reset()
    send(5, [0.0, 0.0, 1.0])
    assert np.isnan(beliefs[-1].nis) and beliefs[-1].force[2] == 1.0


def test_without_contact_no_estimate_is_waited_for(feed):
    stamp_ns = feed.stamp_ns + PERIOD_NS
    feed.arm.at(stamp_ns, feed.pose(1))
    feed.send_presence(stamp_ns, in_contact=False)
    assert feed.state(stamp_ns).flags & ContactState.NO_CONTACT


def test_an_estimate_that_is_not_a_number_is_refused_and_the_belief_predicted(feed):
    for k in range(2):
        feed.state(feed.step(k))
    broken = PoseGaussian(feed.estimate(2).mean, np.full((6, 6), np.nan))
    state = feed.state(feed.step(2, estimate=broken))
    assert state.flags & ContactState.PREDICTED_ONLY and state.rejected == 1
    assert np.all(np.isfinite(state.xi))
    feed.graph.wait_for_count("filter", "estimates refused")


def test_an_outlier_is_gated(feed):
    for k in range(3):
        feed.state(feed.step(k))
    far = PoseGaussian(se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.8])), COV)
    state = feed.state(feed.step(3, estimate=far))
    assert state.flags & ContactState.GATED and state.nis > 100.0


@pytest.mark.parametrize("following", [6, 2], ids=["later", "earlier"])
def test_the_reset_service_starts_a_new_belief_whatever_the_stamps_before(feed, following):
    for k in range(6):
        feed.state(feed.step(k))
    answer = feed.graph.call(ResetFilter, "filter/reset", ResetFilter.Request(reason="test"))
    assert answer.success
    feed.states.clear()
    assert feed.state(feed.step(following)).flags & ContactState.REINITIALIZED


@pytest.mark.parametrize("what", ["presence", "estimate"])
@pytest.mark.parametrize(
    ("ahead", "frame", "complaint"),
    [
        (100 * SECOND, SENSOR, "s ahead of the clock (limit 0.1 s)"),
        (0, "left/tactile_sensor", "frame is 'left/tactile_sensor', must be 'arm/tactile_sensor'"),
    ],
    ids=["of the future", "of another sensor"],
)
def test_what_is_of_the_future_or_of_another_sensor_is_refused_and_the_next_is_taken(
    feed, what, ahead, frame, complaint
):
    feed.state(feed.step(0))
    stamp_ns = feed.stamp_ns + PERIOD_NS // 2 + ahead
    if what == "presence":
        feed.send_presence(stamp_ns, in_contact=False, frame=frame)
    else:
        feed.send_estimate(stamp_ns, feed.estimate(0), frame=frame)
    report = feed.graph.wait_for_count("filter", f"contact/{what} messages refused")
    assert f"contact/{what} refused: " in report.message and complaint in report.message
    state = feed.state(feed.step(1))
    assert state.flags == ContactState.MEASUREMENT_FUSED and len(feed.states) == 2


def test_an_estimate_that_no_sensor_can_feel_is_refused_and_the_belief_predicted(feed):
    feed.state(feed.step(0))
    deep = PoseGaussian(se3.exp(np.array([0.0, 0.0, -0.02, 0.0, 0.0, 0.0])), COV)
    state = feed.state(feed.step(1, estimate=deep))
    assert state.flags == ContactState.PREDICTED_ONLY
    report = feed.graph.wait_for_count("filter", "refused: not plausible")
    assert "depth is 20 mm, must be in [-5, 15] mm" in report.message


def test_a_stray_transform_is_refused_by_name_and_changes_no_belief(feed):
    states = [feed.state(feed.step(0))]
    for k in range(1, 6):
        stray = se3.exp([0.14, 0.0, 0.0, 0.0, 0.0, 0.0]) @ feed.pose(k)
        feed.arm.at(feed.stamp_ns + k * PERIOD_NS - PERIOD_NS // 2, stray)
        states.append(feed.state(feed.step(k)))
    assert_as_library(feed, states)
    report = feed.graph.wait_for_count("filter", "transforms refused", 5)
    assert "/tf: arm/tool refused: 'arm/base' -> 'arm/tool' jumped by " in report.message


def test_frames_that_nobody_looks_up_may_go_back_in_time(feed):
    feed.state(feed.step(0))
    for ahead in (0, -5 * SECOND, -SECOND):
        drone = transform_stamped(feed.stamp_ns + ahead, "map", "drone", np.eye(4))
        feed.arm.tf.publish(TFMessage(transforms=[drone]))
    assert feed.state(feed.step(1)).flags == ContactState.MEASUREMENT_FUSED
    feed.graph.wait_for_count("filter", "contact/estimate messages", 2)
    assert "restarts" not in feed.graph.reports("filter")[-1].values


def test_a_parameter_out_of_range_is_refused_with_its_range_and_the_old_value_stays(feed):
    answer = feed.graph.set_parameter("filter", "gate_probability", 1.5)
    assert not answer.successful and "gate_probability" in answer.reason and "0.5" in answer.reason
    assert feed.graph.get_parameter("filter", "gate_probability") == FilterSettings().gate_probability


def test_a_parameter_set_at_runtime_takes_effect_at_the_next_step(feed):
    feed.state(feed.step(0))
    assert feed.graph.set_parameter("filter", "process_noise_translation", 0.0).successful
    assert feed.graph.set_parameter("filter", "process_noise_rotation", 0.0).successful
    tight = feed.state(feed.step(1))
    for name in ("process_noise_translation", "process_noise_rotation"):
        assert feed.graph.set_parameter("filter", name, getattr(FilterSettings(), name)).successful
    library = ContactFilter(FilterSettings())
    library.step(feed.stamp_ns, feed.estimate(0), feed.pose(0))
    library.configure(FilterSettings(process_noise_translation=0.0, process_noise_rotation=0.0))
    expected = library.step(feed.stamp_ns + PERIOD_NS, feed.estimate(1), feed.pose(1))
    np.testing.assert_allclose(tight.covariance.reshape(6, 6), expected.cov, rtol=1e-6, atol=1e-15)


def test_a_stamp_that_comes_twice_is_refused(feed):
    feed.state(feed.step(0))
    for _ in itertools.repeat(None, 2):
        feed.step(0)
    assert feed.state(feed.step(1))
    assert len(feed.states) == 2


def test_an_estimate_that_comes_late_is_put_in_its_place(feed):
    feed.tf_timeout(0.05)
    assert feed.graph.set_parameter("filter", "history", 0.2).successful
    stamps = [feed.step(k) if k != 2 else feed.stamp_ns + 2 * PERIOD_NS for k in range(4)]
    feed.state(stamps[3])
    feed.send_estimate(stamps[2], feed.estimate(2))
    feed.graph.wait_for_count("filter", "late: put in place")
    last = feed.state(feed.step(4))
    assert feed.graph.set_parameter("filter", "history", 0.0).successful
    library = ContactFilter(FilterSettings())
    for k in range(5):
        expected = library.step(feed.stamp_ns + k * PERIOD_NS, feed.estimate(k), feed.pose(k))
    np.testing.assert_allclose(last.covariance.reshape(6, 6), expected.cov, rtol=1e-6, atol=1e-15)


def test_diagnostics_report_consistency_and_warn_of_overconfidence(feed):
    assert feed.graph.set_parameter("filter", "consistency.window", 10).successful
    assert feed.graph.set_parameter("filter", "consistency.patience", 0.0).successful
    assert feed.graph.set_parameter("filter", "gate_probability", 1.0).successful
    rng = np.random.default_rng(0)
    for k in range(14):
        noisy = PoseGaussian(
            se3.exp(20.0 * np.sqrt(np.diag(COV)) * rng.normal(size=6)) @ feed.estimate(k).mean, COV
        )
        assert feed.state(feed.step(k, estimate=noisy))
    report = feed.graph.wait_for_report("filter", lambda report: "overconfident" in report.message)
    assert "consistent: " in report.values["mean NIS / 6"]
    for name, value in (
        ("consistency.window", 240),
        ("consistency.patience", 2.0),
        ("gate_probability", 0.999999),
    ):
        assert feed.graph.set_parameter("filter", name, value).successful


def test_missing_estimates_are_reported_in_contact_only(feed):
    def silence(report) -> bool:
        return "contact/estimate: no message for" in report.message

    steps = itertools.count()
    assert feed.state(feed.step(next(steps))) is not None  # estimates have come
    end = time.monotonic() + 0.6  # age_limit is 0.25 s
    while time.monotonic() < end:
        feed.graph.spin(0.05)
        feed.step(next(steps), in_contact=False)
    assert not any(map(silence, feed.graph.reports("filter")))
    while not feed.graph.wait(lambda: any(map(silence, feed.graph.reports("filter"))), 0.05):
        feed.send_presence(feed.stamp_ns + next(steps) * PERIOD_NS)  # which announces an estimate
        assert time.monotonic() < end + 10.0


def test_with_simulated_time_stamps_are_held_against_that_clock_and_follow_it_back(graph):
    process = graph.start(FILTER, {"use_sim_time": True})
    clock = graph.publisher(Clock, "/clock", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    feed = Feed(graph, process)
    feed.stamp_ns = 2000 * SECOND
    assert feed.state(feed.step(0)), "before the clock has come nothing can be said of stamps"
    for seconds in (1000, 500):
        feed.stamp_ns = seconds * SECOND

        def told(seconds=seconds) -> bool:
            clock.publish(Clock(clock=time_from_ns(seconds * SECOND)))
            return any(report.header.stamp.sec == seconds for report in graph.diagnostics)

        assert graph.wait(told)
        feed.arm.at(feed.stamp_ns, feed.pose(0))
        assert feed.state(feed.step(1)), "a clock that goes back is followed"
        feed.send_presence(feed.stamp_ns + SECOND, in_contact=False)
    graph.wait_for_count("filter", "contact/presence messages refused", 2)
    assert not any(m.flags & ContactState.NO_CONTACT for m in feed.states)
