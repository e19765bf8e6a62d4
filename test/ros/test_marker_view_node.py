"""The marker view node publishes pictures of the markers, no more often than asked for."""

import time

import numpy as np
import pytest
from messages import image_message
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from tactile_perception.markers.detection import density_change, detect
from tactile_perception.markers.view import side_by_side
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_sim.collection import press_then_shear
from tactile_sim.tactip import TacTip

VIEW = "tactile_ros.nodes.marker_view_node"
SENSOR = "arm/tactile_sensor"
PERIOD_NS = 16_666_667


def contact(depth: float) -> np.ndarray:
    sensor = TacTip(seed=1)
    press_then_shear(sensor, np.array([0.0, 0.0, depth, 0.0, 0.0, 0.0]))
    return sensor.image()


@pytest.fixture(scope="module")
def running(shared_graph):
    shared_graph.start(VIEW, {"rate": 10.0, "diagnostics_period": 0.02})
    shared_graph.images = shared_graph.publisher(Image, "tactile/image", qos.IMAGE)
    shared_graph.pictures = shared_graph.collect(Image, "tactile/marker_view", qos.IMAGE)
    return shared_graph


@pytest.fixture
def view(running):
    """The node with no reference yet."""
    running.restart("marker_view")
    running.pictures.clear()
    running.sent = 0
    return running


def send(view, stamp_ns: int, image: np.ndarray) -> None:
    """Publish an image and wait until it was taken: the next one would push it out."""
    view.images.publish(image_message(stamp_ns, SENSOR, image))
    view.sent += 1
    view.wait_for_count("marker_view", "tactile/image messages", view.sent)


def stamps(view) -> list[int]:
    return [ns_from_time(picture.header.stamp) for picture in view.pictures]


def test_pictures_are_those_of_the_library_with_the_images_stamp_and_at_most_ten_a_second(view):
    rest, pressed = contact(-1e-3), contact(4e-3)
    start = time.time_ns()
    sent = [start + k * PERIOD_NS for k in range(13)]
    for k, stamp_ns in enumerate(sent):
        send(view, stamp_ns, rest if k == 0 else pressed)
    assert view.wait(lambda: len(view.pictures) == 3)
    assert stamps(view) == [sent[0], sent[6], sent[12]]
    picture = view.pictures[-1]
    assert (picture.encoding, picture.header.frame_id) == ("bgr8", SENSOR)
    got = np.frombuffer(bytes(picture.data), np.uint8).reshape(picture.height, picture.width, 3)
    markers = detect(pressed)
    change = density_change(markers, detect(rest), pressed.shape)
    np.testing.assert_array_equal(got, side_by_side(pressed, markers, change))


def test_an_image_without_markers_is_no_reference_and_is_told(view):
    send(view, time.time_ns(), np.zeros((480, 640), np.uint8))
    report = view.wait_for_count("marker_view", "images refused")
    assert "0 markers found" in report.message and not view.pictures
    stamp_ns = time.time_ns() + 10**9
    send(view, stamp_ns, contact(-1e-3))
    assert view.wait(lambda: stamps(view) == [stamp_ns]), "the next image is taken"


def test_a_new_reference_is_taken_on_request(view):
    pressed, start = contact(4e-3), time.time_ns()
    send(view, start, contact(-1e-3))
    assert view.call(Trigger, "marker_view/capture_reference", Trigger.Request()).success
    send(view, start + 10**9, pressed)
    assert view.wait(lambda: len(view.pictures) == 2)
    last = np.frombuffer(bytes(view.pictures[-1].data), np.uint8).reshape(480, 1280, 3)
    markers = detect(pressed)
    np.testing.assert_array_equal(
        last, side_by_side(pressed, markers, density_change(markers, markers, (480, 640)))
    )
