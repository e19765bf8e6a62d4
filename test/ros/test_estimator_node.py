"""The estimator node: models, images and answers of the network that cannot be used."""

import time

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from messages import gaussian_from_message, image_message
from sensor_msgs.msg import CompressedImage, Image
from std_srvs.srv import Trigger

from tactile_doubles.lying_camera import LYING_CAMERAS
from tactile_geometry import se3
from tactile_msgs.msg import ContactForce, ContactPresence, StageLatency
from tactile_perception.estimating.contact_model import SURFACE, SURFACE_FORCE, ContactModel
from tactile_perception.estimating.estimator import Estimator, shipped_model
from tactile_perception.estimating.model_metadata import INPUT_NAME, INVERSE_SIGMA, MEAN, ModelMetadata
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_scene.shapes.plane import Plane
from tactile_sim.tactip import TacTip

ESTIMATOR = "tactile_ros.nodes.estimator_node"
SENSOR = "arm/tactile_sensor"
PERIOD_NS = 16_666_667
SECOND = 1_000_000_000
REFERENCE_FRAMES = 3


def write_model(
    path, outputs: int = 6, told: ContactModel = SURFACE, settings: PreprocessingSettings | None = None
) -> str:
    """A model that answers with the mean brightness, and with NaN for a nearly white image."""
    settings = settings or PreprocessingSettings()
    onnx = pytest.importorskip("onnx", reason="onnx writes the model of this test; `make test` installs it")
    side, channels = settings.size, settings.channels
    graph = onnx.parser.parse_graph(f"""
        tiny (float[N,{channels},{side},{side}] {INPUT_NAME})
        => (float[N,{outputs}] {MEAN}, float[N,{outputs}] {INVERSE_SIGMA})
        <float limit = {{0.7}}, float zero = {{0.0}}, float ten = {{10.0}}, int64[3] axes = {{1, 2, 3}},
         int64[2] repeats = {{1, {outputs}}}, int64[2] shape = {{-1, 1}}>
        {{
            bright4 = ReduceMean<keepdims=0>({INPUT_NAME}, axes)
            bright = Reshape(bright4, shape)
            room = Sub(limit, bright)
            root = Sqrt(room)
            nothing = Mul(root, zero)
            answer = Add(bright, nothing)
            {MEAN} = Tile(answer, repeats)
            sure = Add(nothing, ten)
            {INVERSE_SIGMA} = Tile(sure, repeats)
        }}""")
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=8)
    facts = {"training_data": {"samples": 0}, "validation": {"loss": 0.0}}
    reference = np.full((*settings.crop_shape, 3), 90, np.uint8) if settings.difference else None
    metadata = ModelMetadata(settings, contact_model=told, reference=reference, **facts)
    onnx.helper.set_model_props(model, metadata.to_properties())
    onnx.save(model, str(path))
    return str(path)


def dots(seed: int = 0) -> np.ndarray:
    """An image of dark and bright squares, about half of it bright after pre-processing."""
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 2, (48, 64)) * 200, np.ones((10, 10))).astype(np.uint8)


def stamps(messages) -> set[int]:
    return {ns_from_time(m.header.stamp) for m in messages}


WHITE = np.full((480, 640), 200, np.uint8)


#: The pictures of these tests are none of a sensor, and sent again and again.
ANY_IMAGE = {
    "check.repeats": True, "check.least_contrast": 0.0, "check.fewest_markers": 0.0,
    "check.most_markers": 100.0, "check.least_white": 0.0, "check.most_white": 100.0,
    "check.least_likeness": -1.0, "check.least_continuity": -1.0,
}  # fmt: skip


class Camera:
    """Publishes images of the test's choice and keeps what the estimator answers."""

    def __init__(self, graph, model: str) -> None:
        parameters = {"model": model, "presence.reference_frames": REFERENCE_FRAMES, **ANY_IMAGE}
        graph.start(ESTIMATOR, {**parameters, "diagnostics_period": 0.02})
        self.graph = graph
        self.stamp_ns = 0
        self.images = graph.publisher(Image, "tactile/image", qos.IMAGE)
        self.estimates = graph.collect(PoseWithCovarianceStamped, "contact/estimate")
        self.presences = graph.collect(ContactPresence, "contact/presence")
        self.latencies = graph.collect(StageLatency, "latency", qos.LATENCY)

    def restart(self) -> None:
        """A new start of the estimator, with a new reference."""
        self.graph.restart("estimator")
        for answers in (self.estimates, self.presences, self.latencies):
            answers.clear()
        # images are sent faster than their stamps go on; none is to be of the future
        self.stamp_ns = max(self.stamp_ns, time.time_ns() - SECOND)
        self.sent = 0
        self.reference()

    def send(self, image: np.ndarray | None = None, message: Image | None = None, after: int = 1) -> int:
        """Publish an image (of a contact, by default) `after` periods after the last; returns its stamp.

        Waits until it was taken: the next one would push it out.
        """
        self.stamp_ns += after * PERIOD_NS
        if message is None:
            message = image_message(self.stamp_ns, SENSOR, dots(5) if image is None else image)
        message.header.stamp = image_message(self.stamp_ns, SENSOR, WHITE).header.stamp
        self.images.publish(message)
        self.sent += 1
        self.graph.wait_for_count("estimator", "tactile/image messages", self.sent)
        return self.stamp_ns

    def reference(self) -> None:
        for _ in range(REFERENCE_FRAMES):
            self.send(dots())

    def answered(self, stamp_ns: int) -> bool:
        return self.graph.wait(lambda: stamp_ns in stamps(self.estimates))


@pytest.fixture(scope="module")
def running(shared_graph, model):
    return Camera(shared_graph, model)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("model") / "model.onnx")


@pytest.fixture
def camera(running):
    running.restart()
    return running


def test_an_image_becomes_the_estimate_of_the_library_with_the_same_stamp_and_the_sensors_frame(
    camera, model
):
    stamp_ns = camera.send(dots(1))
    assert camera.answered(stamp_ns)
    message = camera.estimates[-1]
    assert message.header.frame_id == SENSOR
    expected = Estimator(model).estimate(dots(1))
    got = gaussian_from_message(message.pose)
    np.testing.assert_allclose(got.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(got.cov, expected.cov, rtol=1e-9, atol=1e-15)


def test_a_force_is_published_with_its_covariance_and_a_model_of_the_surface_has_none(
    graph, camera, tmp_path
):
    wrenches = camera.graph.collect(WrenchStamped, "contact/wrench")
    assert camera.answered(camera.send()) and not wrenches
    told = SURFACE_FORCE.narrowed(("z", "alpha", "beta", "Fx", "Fy", "Fz"), "here")
    model = write_model(tmp_path / "force.onnx", 9, told)
    settings = {"model": model, "presence.reference_frames": REFERENCE_FRAMES}
    graph.start(ESTIMATOR, {**settings, **ANY_IMAGE, "diagnostics_period": 0.02})
    images = graph.publisher(Image, "tactile/image", qos.IMAGE)
    wrenches = graph.collect(WrenchStamped, "contact/wrench")
    forces = graph.collect(ContactForce, "contact/wrench_estimate")
    start_ns = time.time_ns() - SECOND
    for number, picture in enumerate([dots()] * REFERENCE_FRAMES + [dots(5)], 1):
        images.publish(image_message(start_ns + number * PERIOD_NS, SENSOR, picture))
        graph.wait_for_count("estimator", "tactile/image messages", number)
    assert graph.wait(lambda: len(wrenches) == len(forces) == 1)
    (wrench,), (force,) = wrenches, forces
    exposed_ns = start_ns + (REFERENCE_FRAMES + 1) * PERIOD_NS
    for message in (wrench, force):
        assert ns_from_time(message.header.stamp) == exposed_ns and message.header.frame_id == SENSOR
    library = Estimator(model)
    library.estimate(dots(5))
    np.testing.assert_allclose(force.force, library.force.mean)
    np.testing.assert_allclose(force.covariance.reshape(3, 3), np.diag([0.01] * 3), rtol=1e-6)
    found = wrench.wrench.force
    assert [found.x, found.y, found.z] == list(force.force) and wrench.wrench.torque.z == 0.0
    said = graph.wait_for_report("estimator", lambda report: "contact model" in report.values).values
    assert said["contact model"] == "surface_force" and said["not labelled"] == "x, y, gamma"


def test_presence_compares_with_the_first_images_and_carries_the_stamp(camera):
    same, other = camera.send(dots()), camera.send()
    assert camera.graph.wait(lambda: other in stamps(camera.presences))
    by_stamp = {ns_from_time(m.header.stamp): m for m in camera.presences}
    assert not by_stamp[same].in_contact and by_stamp[same].score < by_stamp[other].score
    assert by_stamp[other].in_contact and by_stamp[other].score > by_stamp[other].threshold


def test_the_age_of_the_estimates_is_told(camera):
    camera.send()
    key = "estimator: age of outputs, median and largest (ms)"
    report = camera.graph.wait_for_report("estimator", lambda report: key in report.values)
    median, largest = map(float, report.values[key].split())
    assert 0.0 < median <= largest < 100_000.0


def test_without_contact_there_is_no_estimate(camera):
    untouched, touched = camera.send(dots()), camera.send()
    assert camera.answered(touched)
    assert [ns_from_time(m.header.stamp) for m in camera.estimates] == [touched]
    assert camera.graph.wait(lambda: {untouched, touched} <= stamps(camera.presences))


def test_nothing_is_published_before_the_reference_is_there_nor_while_a_new_one_is_taken(camera):
    assert not camera.estimates
    answer = camera.graph.call(Trigger, "estimator/capture_reference", Trigger.Request())
    assert answer.success
    camera.reference()
    answered = camera.send()
    assert camera.answered(answered)
    assert stamps(camera.estimates) == stamps(camera.presences) == {answered}


def test_a_reference_that_looks_like_contact_is_refused_at_activation_and_the_last_one_stays(camera):
    camera.graph.restart("estimator")
    camera.sent = 0
    for _ in range(REFERENCE_FRAMES):
        camera.send()  # in contact
    report = camera.graph.wait_for_count("estimator", "references refused")
    assert "reference of the contact presence refused: its change against the last one is" in report.message
    assert "the last one stays" in report.message
    assert camera.answered(camera.send()), "and contact is told"
    assert camera.graph.call(Trigger, "estimator/capture_reference", Trigger.Request()).success
    for _ in range(REFERENCE_FRAMES):
        camera.send()
    untouched = camera.send()
    assert camera.graph.wait(lambda: untouched in stamps(camera.presences))
    assert not camera.presences[-1].in_contact
    assert camera.graph.call(Trigger, "estimator/capture_reference", Trigger.Request()).success
    camera.reference()


def test_an_image_of_the_future_is_refused_and_the_next_one_taken(camera):
    before = camera.stamp_ns
    camera.stamp_ns = time.time_ns() + 10 * SECOND
    early = camera.send()
    report = camera.graph.wait_for_count("estimator", "tactile/image messages refused")
    assert "tactile/image refused: its stamp is" in report.message and "ahead of the clock" in report.message
    camera.stamp_ns = before
    assert camera.answered(camera.send())
    assert early not in stamps(camera.estimates)


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (image_message(0, SENSOR, WHITE[:240, :320]), "320x240"),
        (Image(height=480, width=640, encoding="mono16", step=1280, data=bytes(2 * 640 * 480)), "'mono16'"),
        (Image(height=480, width=640, encoding="mono8", step=640, data=bytes(1000)), "1000 bytes"),
        (Image(encoding="mono8"), "empty"),
    ],
    ids=["size", "encoding", "data", "empty"],
)
def test_an_image_that_cannot_be_used_is_refused_counted_and_told(camera, message, complaint):
    camera.send(message=message)
    report = camera.graph.wait_for_count("estimator", "images refused")
    assert report.level == 1 and complaint in report.message
    assert not camera.estimates
    assert camera.answered(camera.send()), "the node goes on with the next image"


def test_colors_and_crops_are_estimated_as_the_gray_image_that_they_are_of(camera, model):
    gray, rgb = dots(1), np.repeat(dots(1)[:, :, None], 3, axis=2)
    x0, y0, x1, y1 = PreprocessingSettings().bbox
    crop = np.ascontiguousarray(gray[y0:y1, x0:x1])
    color = Image(height=480, width=640, encoding="bgr8", step=1920, data=rgb.tobytes())
    expected = Estimator(model).estimate(gray)
    for message in (color, image_message(0, SENSOR, crop)):
        message.header.frame_id = "usb_cam"  # the frame of somebody else's driver does not matter
        assert camera.answered(camera.send(message=message))
        assert camera.estimates[-1].header.frame_id == SENSOR
        np.testing.assert_allclose(
            gaussian_from_message(camera.estimates[-1].pose).mean, expected.mean, atol=1e-12
        )


def test_a_model_of_colors_compares_them_with_todays_image_and_refuses_gray(graph, tmp_path):
    """Without a threshold, in another size: light that has grown since the training is no contact."""
    settings = PreprocessingSettings(
        raw_width=320, raw_height=240, bbox=(40, 0, 280, 240), color=True, median=0, difference=2.0,
        threshold_method="none", circle_mask_radius=0, size=32,
    )  # fmt: skip
    camera = Camera(graph, write_model(tmp_path / "color.onnx", settings=settings))
    camera.stamp_ns, camera.sent = time.time_ns() - SECOND, 0
    still = np.broadcast_to(np.linspace(60, 160, 320)[None, :, None], (240, 320, 3)).astype(np.uint8)
    pressed = still.copy()
    pressed[100:140, 140:180, 0] += 60  # blue alone
    for _ in range(REFERENCE_FRAMES):
        camera.send(still)
    rest, touch = camera.send(still), camera.send(pressed)
    assert graph.wait(lambda: {rest, touch} <= stamps(camera.presences))
    assert [message.in_contact for message in camera.presences[-2:]] == [False, True]
    assert camera.answered(touch) and rest not in stamps(camera.estimates)
    alone = Estimator(tmp_path / "color.onnx")
    alone.preprocessor.reference = still[:, 40:280]
    found = gaussian_from_message(camera.estimates[-1].pose).mean
    np.testing.assert_allclose(found, alone.estimate(pressed).mean, atol=1e-9)
    camera.send(np.ascontiguousarray(still[:, :, 0]))
    report = graph.wait_for_count("estimator", "images refused")
    assert "must be a color image (bgr8)" in report.message


def test_an_image_without_a_stamp_is_refused_with_what_would_be_right(camera):
    camera.images.publish(image_message(0, SENSOR, dots(1)))
    report = camera.graph.wait_for_count("estimator", "tactile/image messages refused")
    assert "has no stamp, must have the time of its exposure" in report.message


def test_compressed_images_are_taken_by_the_name_of_image_transport(graph, model):
    settings = {"images.transport": "compressed", "presence.reference_frames": REFERENCE_FRAMES}
    graph.start(ESTIMATOR, {"model": model, **settings, **ANY_IMAGE, "diagnostics_period": 0.02})
    images = graph.publisher(CompressedImage, "tactile/image/compressed", qos.IMAGE)
    estimates = graph.collect(PoseWithCovarianceStamped, "contact/estimate")
    start_ns = time.time_ns() - SECOND
    for number, (picture, form) in enumerate(
        [(dots(), "mono8; png compressed ")] * REFERENCE_FRAMES
        + [(dots(5), "bgr8; jpeg compressed bgr8"), (dots(5), "16UC1; compressedDepth")],
        1,
    ):
        data = cv2.imencode(".png" if "png" in form else ".jpg", picture)[1].tobytes()
        head = image_message(start_ns + number * PERIOD_NS, SENSOR, WHITE[:1, :1]).header
        images.publish(CompressedImage(header=head, format=form, data=data))
        graph.wait_for_count("estimator", "tactile/image/compressed messages", number)
    assert "format is '16UC1; compressedDepth'" in graph.wait_for_count("estimator", "images refused").message
    assert graph.wait(lambda: len(estimates) == 1)


def test_the_time_offset_of_a_camera_is_added_to_the_stamps(graph, model):
    settings = {"images.time_offset": -0.012, "presence.reference_frames": REFERENCE_FRAMES}
    graph.start(ESTIMATOR, {"model": model, **settings, **ANY_IMAGE})
    images = graph.publisher(Image, "tactile/image", qos.IMAGE)
    estimates = graph.collect(PoseWithCovarianceStamped, "contact/estimate")
    start_ns = time.time_ns() - SECOND
    for number, picture in enumerate([dots()] * REFERENCE_FRAMES + [dots(5)], 1):
        images.publish(image_message(start_ns + number * PERIOD_NS, SENSOR, picture))
        graph.wait_for_count("estimator", "tactile/image messages", number)
    assert graph.wait(lambda: len(estimates) == 1)
    exposed_ns = start_ns + (REFERENCE_FRAMES + 1) * PERIOD_NS
    assert ns_from_time(estimates[0].header.stamp) == exposed_ns - 12_000_000


@pytest.mark.skipif(
    not shipped_model().is_file(), reason="the shipped model is not there: `make model` trains it"
)
def test_images_of_cameras_that_lie_are_refused_by_kind_told_at_once_and_the_next_true_one_is_taken(graph):
    settings = {"presence.reference_frames": REFERENCE_FRAMES, "diagnostics_period": 30.0}
    graph.start(ESTIMATOR, settings)
    images = graph.publisher(Image, "tactile/image", qos.IMAGE)
    presences, reports = (
        graph.collect(ContactPresence, "contact/presence"),
        graph.collect(DiagnosticArray, "/diagnostics", qos.DIAGNOSTICS),
    )
    sensor, stamp_ns = TacTip(seed=5), time.time_ns() - 2 * SECOND

    def send(image, taken: bool):
        nonlocal stamp_ns
        stamp_ns += PERIOD_NS
        images.publish(image_message(stamp_ns, SENSOR, image))
        time.sleep(0.05)  # the newest image wins
        if taken:
            assert graph.wait(lambda: stamp_ns in stamps(presences))

    for _ in range(REFERENCE_FRAMES):
        send(sensor.image(), taken=False)
    for depth in np.arange(0.0, 3.0, 0.25):
        sensor.advance(Plane(), se3.pose_from_euler([0, 0, 0.020 - depth * 1e-3, np.pi, 0, 0]))
        send(sensor.image(), taken=True)
    assert presences[-1].in_contact
    for kind in ("mirrored", "turned_180", "frozen", "noise", "grey"):
        camera = LYING_CAMERAS[kind](seed=1)
        truth = sensor.image()
        camera.see(truth)
        send(truth, taken=True)
        told = len(reports)
        for _ in range(3):
            send(camera(sensor.image()), taken=False)
        assert graph.wait(lambda told=told: any("refused" in r.status[0].message for r in reports[told:]))
        assert stamp_ns not in stamps(presences), kind
        send(sensor.image(), taken=True)
    values = {item.key: item.value for item in reports[-1].status[0].values}
    assert {name for name in values if name.startswith("images refused, ")} == {
        "images refused, another picture at once", "images refused, repeated",
        "images refused, no image of the sensor", "images refused, without contrast",
    }  # fmt: skip


def test_nan_from_the_network_is_refused_counted_and_told(camera):
    camera.send(WHITE)
    report = camera.graph.wait_for_count("estimator", "estimates refused")
    assert "NaN" in report.message
    assert not camera.estimates
    assert camera.answered(camera.send())


def test_lost_images_are_counted_by_their_stamps(camera):
    assert camera.answered(camera.send())
    assert camera.answered(camera.send(after=4))
    assert camera.graph.wait_for_count("estimator", "images lost", 3).values["images lost"] == "3"
    assert camera.graph.wait(lambda: camera.latencies and camera.latencies[-1].dropped[-1] == 3)


def test_an_image_older_than_the_last_is_refused_but_a_clock_set_back_is_followed(camera):
    assert camera.answered(camera.send())
    camera.send(after=-2)
    camera.graph.wait_for_count("estimator", "images out of order")
    assert camera.answered(camera.send(after=-600))


def test_a_camera_that_falls_silent_is_told_with_age_and_limit(camera):
    def told(report) -> bool:
        return "tactile/image: no message for" in report.message and "limit 0.25 s" in report.message

    camera.graph.wait_for_report("estimator", told)


def test_a_missing_model_ends_the_process_with_the_file_in_the_message(graph):
    process = graph.start(ESTIMATOR, {"model": "/nowhere/model.onnx"}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    assert "/nowhere/model.onnx: there is no such model file" in graph.log(ESTIMATOR).read_text()


def test_a_model_of_the_wrong_shape_ends_the_process_with_the_right_shape_in_the_message(graph, tmp_path):
    process = graph.start(ESTIMATOR, {"model": write_model(tmp_path / "model.onnx", outputs=5)}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    log = graph.log(ESTIMATOR).read_text()
    assert "must have mu float32 (N, 6)" in log


def test_without_autostart_a_missing_model_leaves_the_node_unconfigured_and_alive(graph):
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState, GetState

    process = graph.start(ESTIMATOR, {"model": "/nowhere/model.onnx", "autostart": False}, wait=False)
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    assert not graph.call(ChangeState, "estimator/change_state", request).success
    state = graph.call(GetState, "estimator/get_state", GetState.Request()).current_state.label
    assert state == "unconfigured" and process.poll() is None
    graph.wait_for_report("estimator", lambda report: "/nowhere/model.onnx" in report.message)
    assert graph.stop(ESTIMATOR) == 0
