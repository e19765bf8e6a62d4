"""The object node: aligns and fuses the contacts of several arms, and names those it leaves out."""

import sys
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from messages import gaussian_from_message, gaussian_message, matrix_from_transform
from tf2_msgs.msg import TFMessage

from tactile_filter.object.settings import TrackerSettings
from tactile_filter.object.tracker import ContactUpdate, ObjectTracker
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_msgs.msg import ContactState, StageLatency
from tactile_msgs.srv import ResetFilter
from tactile_ros import qos
from tactile_ros.conversions import header, ns_from_time, transform_stamped

NODE, FILTER, SIM = (
    "tactile_ros.nodes.object_node",
    "tactile_ros.nodes.filter_node",
    "tactile_ros.nodes.sim_node",
)
SECOND = 1_000_000_000
STEP = 16_666_667
COV = np.diag([1e-7, 1e-7, 1e-8, 1e-4, 1e-4, 4e-4])
OBJECT = se3.exp([0.5, 0.1, 0.2, 0.1, -0.3, 1.0])
FEATURES = {
    "left": se3.pose_from_euler([0.0, 0.03, 0.0, np.pi / 2, 0.0, 0.0]),
    "right": se3.pose_from_euler([0.0, -0.03, 0.0, -np.pi / 2, 0.0, 0.0]),
}
CONTACT = se3.exp([1e-3, 0, -3e-3, 0.1, 0, 0])
NAMES = tuple(FEATURES)
# on a busy machine the beliefs of one stamp may come far apart
PARAMETERS = {"arms": list(NAMES), "inputs.tf_timeout": 0.3, "inputs.wait": 0.5, "forget_after": 10.0}


class Feed:
    """Stands for the filters and the arms; keeps what the object node says."""

    def __init__(self, graph) -> None:
        self.graph = graph
        self.beliefs = {
            arm: graph.publisher(PoseWithCovarianceStamped, f"/{arm}/contact/belief") for arm in NAMES
        }
        self.states = {arm: graph.publisher(ContactState, f"/{arm}/contact/state") for arm in NAMES}
        self.tf = graph.publisher(TFMessage, "/tf", qos.TF)
        static = graph.publisher(TFMessage, "/tf_static", qos.TF_STATIC)
        bases = [transform_stamped(0, "world", f"{arm}/base", self.base(arm)) for arm in NAMES]
        static.publish(TFMessage(transforms=bases))
        self.found = graph.collect(PoseWithCovarianceStamped, "/object/belief")
        self.transforms = graph.collect(TFMessage, "/tf", qos.TF)
        self.latencies = graph.collect(StageLatency, "/object/latency", qos.LATENCY)
        graph.spin(0.3)  # discovery

    def restart(self) -> None:
        """A new start of the node, in a time later than all before."""
        self.graph.restart("/object")
        self.graph.spin(0.15)
        self.found.clear()
        self.transforms.clear()
        self.start_ns = time.time_ns() - SECOND // 10

    def base(self, arm: str) -> np.ndarray:
        return se3.exp([0.0, 0.4 if arm == "left" else -0.4, 0.0, 0.0, 0.0, 0.5])

    def sensor(self, arm: str) -> np.ndarray:
        return OBJECT @ FEATURES[arm] @ se3.inverse(CONTACT)

    def move(self, arm: str, stamp_ns: int) -> None:
        T = se3.inverse(self.base(arm)) @ self.sensor(arm)
        self.tf.publish(
            TFMessage(transforms=[transform_stamped(stamp_ns, f"{arm}/base", f"{arm}/tactile_sensor", T)])
        )

    def believe(self, arm: str, k: float, cov=COV, frame: str = "", mean=CONTACT, tf: bool = True) -> int:
        """Step k of an arm in contact."""
        stamp_ns = self.start_ns + round(k * STEP)
        if tf:
            self.move(arm, stamp_ns)
        frame = frame or f"{arm}/tactile_sensor"
        self.beliefs[arm].publish(gaussian_message(stamp_ns, frame, mean, cov))
        return stamp_ns

    def let_go(self, arm: str, k: int) -> int:
        stamp_ns = self.start_ns + k * STEP
        self.move(arm, stamp_ns)
        flags = ContactState.NO_CONTACT | ContactState.INVALID
        state = ContactState(header=header(stamp_ns, f"{arm}/tactile_sensor"), flags=flags)
        self.states[arm].publish(state)
        return stamp_ns

    def both(self, k: int) -> int:
        return [self.believe(arm, k) for arm in NAMES][-1]

    def at(self, stamp_ns: int) -> PoseGaussian | None:
        """The object's belief at that stamp, waiting for it; None if it does not come."""

        def found():
            return [m for m in self.found if ns_from_time(m.header.stamp) == stamp_ns]

        self.graph.wait(lambda: bool(found()))
        return gaussian_from_message(found()[0].pose) if found() else None

    def report(self, name: str, text: str):
        """A report whose value of that name has that text in it."""
        return self.graph.wait_for_report("object", lambda report: text in report.values.get(name, ""))


TABLE = """
simulation:
  rate: 60
  sensors: {left: {fidelity: ideal}, right: {fidelity: ideal}}
arms:
  left:
    base: {position: [-0.45, 0.1, 0.0]}
    start: {position: [0.0, 0.1, 0.017], rotation_deg: [0, 180, 0]}
    sensor: {camera_rate: 30}
  right:
    base: {position: [-0.45, -0.1, 0.0]}
    start: {position: [0.0, -0.1, 0.017], rotation_deg: [0, 180, 0]}
    sensor: {camera_rate: 30}
bodies:
  table: {shape: plane}
"""


@pytest.fixture(scope="module")
def running(shared_graph):
    shared_graph.start(NODE, PARAMETERS, namespace="")
    return Feed(shared_graph)


@pytest.fixture
def feed(running):
    running.restart()
    return running


def expected(feed, steps) -> PoseGaussian:
    """What the library says after these steps, each the arms in contact at a stamp."""
    tracker = ObjectTracker(NAMES, TrackerSettings())
    for k, arms in enumerate(steps):
        update = {
            arm: ContactUpdate(PoseGaussian(CONTACT, COV), feed.sensor(arm)) if arm in arms else None
            for arm in NAMES
        }
        found = tracker.step(feed.start_ns + k * STEP, update)
    return found.belief.pose.gaussian


def assert_same(got: PoseGaussian, wanted: PoseGaussian) -> None:
    np.testing.assert_allclose(got.mean, wanted.mean, atol=1e-9)
    scale = np.sqrt(np.diag(wanted.cov))
    scale = np.outer(scale, scale)
    np.testing.assert_allclose(got.cov / scale, wanted.cov / scale, atol=1e-6)


def test_contacts_of_one_stamp_become_one_belief_in_the_world_with_the_images_stamp(feed):
    stamps = [feed.both(k) for k in range(3)]
    beliefs = [feed.at(stamp_ns) for stamp_ns in stamps]
    assert None not in beliefs and len(feed.found) == 3
    assert {message.header.frame_id for message in feed.found} == {"world"}
    assert_same(beliefs[-1], expected(feed, [NAMES] * 3))
    report = feed.report("contacts used", "left, right")
    assert "known to" in report.values["object"] and "mm" in report.values["object"]


def test_a_contact_that_ends_leaves_the_object_to_the_other(feed):
    for k in range(3):
        feed.at(feed.both(k))
    feed.let_go("left", 3)
    alone = feed.at(feed.believe("right", 3))
    assert_same(alone, expected(feed, [NAMES] * 3 + [("right",)]))
    feed.report("contacts used", "right")


def test_contacts_of_different_stamps_are_taken_to_the_newest(feed):
    for k in range(2):
        feed.at(feed.both(k))
    feed.believe("left", 2)
    newest = feed.at(feed.believe("right", 2.4))
    np.testing.assert_allclose(newest.mean, OBJECT @ FEATURES["left"], atol=1e-9)
    feed.report("contacts used", "left, right")


def test_a_contact_that_is_too_old_is_left_out_and_named(feed):
    for k in range(3):
        feed.at(feed.both(k))
    assert feed.at(feed.believe("right", 8)) is not None
    report = feed.report("contacts too old", "left (")
    assert report.values["contacts used"] == "right"


def test_a_contact_that_disagrees_is_refused_counted_and_named(feed):
    for k in range(3):
        feed.at(feed.both(k))
    off = se3.exp([0, 0, -12e-3, 0, 0, 0]) @ CONTACT
    feed.believe("left", 3)
    feed.at(feed.believe("right", 3, cov=2 * COV, mean=off))
    report = feed.graph.wait_for_count("object", "right: contacts refused")
    assert "right (NIS" in report.values["contacts refused"] and report.values["contacts used"] == "left"


def test_the_object_is_a_frame_of_tf_too(feed):
    stamp_ns = feed.both(0)
    belief = feed.at(stamp_ns)

    def frames():
        return [t for m in feed.transforms for t in m.transforms if t.child_frame_id == "object"]

    assert feed.graph.wait(lambda: bool(frames()))
    assert frames()[0].header.frame_id == "world"
    np.testing.assert_allclose(matrix_from_transform(frames()[0].transform), belief.mean, atol=1e-12)
    for k in range(1, 4):
        feed.at(feed.both(k))
    feed.graph.spin(0.1)
    assert len(frames()) == 1, "no more than 15 a second"


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        ({"cov": np.full((6, 6), np.nan)}, "not finite"),
        ({"frame": "left/base"}, "frame is 'left/base', must be 'right/tactile_sensor'"),
        ({"cov": -COV}, "negative variance"),
        ({"mean": se3.exp([0.0, 0.0, -0.02, 0.0, 0.0, 0.0])}, "depth is 20 mm, must be in [-5, 15] mm"),
    ],
)
def test_a_belief_that_cannot_be_used_is_refused_counted_and_reported(feed, bad, complaint):
    feed.at(feed.both(0))
    feed.believe("right", 1, **bad)
    report = feed.graph.wait_for_report("object", lambda report: complaint in report.message)
    assert report.values["/right/contact/belief messages refused"] == "1"
    assert feed.at(feed.both(2)) is not None


def test_a_belief_without_a_transform_is_dropped_after_the_deadline_and_reported(feed):
    feed.at(feed.both(0))
    feed.believe("right", 5, tf=False)
    report = feed.graph.wait_for_count("object", "right: beliefs dropped")
    assert "world" in report.message or "right" in report.message
    assert feed.at(feed.believe("left", 6)) is not None


def test_a_belief_that_comes_twice_is_refused(feed):
    feed.at(feed.both(0))
    feed.believe("right", 0)
    feed.graph.wait_for_count("object", "right: beliefs refused")
    assert len(feed.found) == 1


def test_the_reset_service_forgets_places_that_were_found(feed):
    for k in range(3):
        feed.at(feed.both(k))
    answer = feed.graph.call(ResetFilter, "/object/reset", ResetFilter.Request(reason="test"))
    assert answer.success
    again = feed.at(feed.believe("right", 3))
    np.testing.assert_allclose(again.mean, OBJECT @ FEATURES["right"], atol=1e-9)


@pytest.mark.parametrize("tf", [True, False])
def test_a_jump_back_in_time_starts_anew(feed, tf):
    """Seen in the transforms, or in the beliefs where they come first."""
    for k in range(3):
        feed.at(feed.both(k))
    feed.start_ns -= 20 * SECOND
    if tf:
        for arm in NAMES:
            feed.move(arm, feed.start_ns - STEP)
    stamp_ns = feed.believe("right", 0, tf=tf)
    feed.graph.wait_for_count("object", "restarts")
    if not tf:
        feed.believe("right", 1)
        stamp_ns = feed.believe("right", 2)
    again = feed.at(stamp_ns)
    np.testing.assert_allclose(again.mean, OBJECT @ FEATURES["right"], atol=1e-9)


def test_a_parameter_out_of_range_is_refused_with_its_range_and_the_old_value_stays(feed):
    for name, value, why in (
        ("max_age", -1.0, "Max: 10"),
        ("forget_after", 0.01, "must not be longer than forget_after"),
        ("place.left.sigma", [0.0] * 5, "6 elements"),
        ("place.left.sigma", [0.0] * 5 + [-1.0], "must lie in"),
    ):
        before = feed.graph.get_parameter("/object", name)
        answer = feed.graph.set_parameter("/object", name, value)
        assert not answer.successful and name.split(".")[-1] in answer.reason and why in answer.reason
        assert list(np.atleast_1d(feed.graph.get_parameter("/object", name))) == list(np.atleast_1d(before))


def test_a_place_given_at_runtime_holds_from_the_next_step(feed):
    feed.at(feed.both(0))
    pose = se3.euler_from_pose(FEATURES["left"]).tolist()
    assert feed.graph.set_parameter("/object", "place.left.pose", pose).successful
    assert feed.graph.set_parameter("/object", "place.left.given", True).successful
    found = feed.at(feed.both(1))
    assert feed.graph.set_parameter("/object", "place.left.given", False).successful
    np.testing.assert_allclose(found.mean, OBJECT, atol=1e-9)


def test_latency_is_reported_from_the_exposure(feed):
    for k in range(3):
        feed.at(feed.both(k))
    stamp_ns = feed.both(3)
    assert feed.graph.wait(lambda: any(ns_from_time(m.exposed[-1]) == stamp_ns for m in feed.latencies))
    assert {message.stage for message in feed.latencies} == {"object"}


def test_an_arm_that_says_nothing_is_reported(feed):
    report = feed.graph.wait_for_report("object", lambda r: "/right/contact/state" in r.message)
    assert "no message" in report.message


@pytest.mark.parametrize(
    ("arms", "complaint"),
    [([""], "must name at least one arm"), (["left", "left"], "be there once")],
)
def test_without_arms_to_listen_to_it_does_not_start(graph, arms, complaint):
    process = graph.start(NODE, {"arms": [f"'{arm}'" for arm in arms]}, wait=False, namespace="")
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1 and complaint in graph.log(NODE).read_text()


def test_two_simulated_arms_know_one_table_and_one_of_them_goes_on_alone(graph, tmp_path):
    """The real chain: simulator, a filter for each arm, and this node; the arms stand still, 3 mm deep.

    Each contact holds the object by itself, at its own place; so both have to be heard for both to be used.
    """
    scene = tmp_path / "table.yaml"
    scene.write_text(TABLE)
    places = {f"place.{arm}.given": True for arm in NAMES}
    places["place.right.pose"] = [0.0, -0.2, 0.0, 0.0, 0.0, 0.0]
    graph.start(NODE, {**PARAMETERS, **places, "forget_after": 2.0}, namespace="")
    for arm in NAMES:
        graph._start(f"{arm} filter", [sys.executable, "-m", FILTER], None, True, arm)
    found = graph.collect(PoseWithCovarianceStamped, "/object/belief")
    graph.start(SIM, {"scene": str(scene)}, namespace="")
    graph.wait_for_report("object", lambda report: report.values.get("contacts used") == "left, right")
    assert graph.wait(lambda: len(found) > 20)
    assert_on_the_table(found[-1])
    both = turn_variance(found[-1])

    assert graph.stop("right filter") == 0
    graph.diagnostics.clear()
    graph.wait_for_report("object", lambda report: report.values.get("contacts used") == "left")
    report = graph.wait_for_report("object", lambda report: "/right/contact/state" in report.message)
    assert "no message" in report.message
    found.clear()
    assert graph.wait(lambda: len(found) > 20)
    assert_on_the_table(found[-1])
    assert turn_variance(found[-1]) > 1.5 * both


def turn_variance(message) -> float:
    """Of the rotation, which one contact alone knows less of."""
    return np.trace(message.pose.covariance.reshape(6, 6)[3:, 3:])


def assert_on_the_table(message) -> None:
    """The left contact is the object's frame: where the sensor's center was when it touched the table."""
    belief = gaussian_from_message(message.pose)
    sigma = np.sqrt(np.diag(message.pose.covariance.reshape(6, 6)))
    assert (np.abs(belief.mean[:3, 3] - [0.0, 0.1, 0.02]) < 5.0 * sigma[:3]).all()
    np.testing.assert_allclose(belief.mean[:3, 2], [0.0, 0.0, -1.0], atol=5.0 * sigma[3:].max())


def test_sigint_ends_it_with_exit_code_0(graph):
    graph.start(NODE, PARAMETERS, namespace="")
    feed = Feed(graph)
    feed.start_ns = time.time_ns()
    feed.at(feed.both(0))
    assert graph.stop(NODE) == 0
