"""Estimates made anew from recorded images, by an estimator that stands in for the network."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from replay_bags import START_NS, STEP_NS, STORE, header, make, recording

from tactile_bringup.cli import main
from tactile_filter.bayes_filter import FilterSettings
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.estimator import ModelError
from tactile_perception.estimating.labels import EstimateError
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.estimating.presence import PresenceSettings
from tactile_records.bags.reader import read_bag
from tactile_records.replay import images as replay_images
from tactile_records.replay.images import estimated, wanted_with_images
from tactile_records.replay.inputs import inputs_of
from tactile_records.replay.run import run_filter
from tactile_records.replay.topics import ReplayError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
COV = np.diag([1e-8] * 3 + [1e-5] * 3)
FREE = 20  # images without contact, of which the reference is made


class Reduced:
    """A pre-processing that only makes images smaller."""

    def __call__(self, image):
        self.small = cv2.resize(image, (128, 128), interpolation=cv2.INTER_AREA)
        return self.small.reshape(1, 1, 128, 128).astype(np.float32) / 255.0

    def view(self, side: int):
        return self.small


class Brightness:
    """An estimator whose depth is the image's brightness; it refuses the brightest."""

    def __init__(self, model: object = "") -> None:
        self.model = str(model)
        if self.model == "broken.onnx":
            raise ModelError("broken.onnx: is not a usable ONNX model")

        self.preprocessor = Reduced()
        self.force = None
        self.metadata = SimpleNamespace(
            layout=None, plain_depth=None, novelty=None, preprocessing=PreprocessingSettings()
        )

    def estimate_prepared(self, prepared) -> PoseGaussian:
        depth = 0.01 * float(prepared.mean())
        if depth > 0.0099:
            raise EstimateError("the network answered with NaN")
        return PoseGaussian(se3.exp([0.0, 0.0, -depth, 0.0, 0.0, 0.0]), COV)


@pytest.fixture(autouse=True)
def estimator(monkeypatch):
    monkeypatch.setattr(replay_images, "Estimator", Brightness)


def picture(k: int):
    """Dark while nothing touches, with a little noise; then ever brighter."""
    level = 20 if k < FREE else 100 + k
    return (np.random.default_rng(k).integers(-2, 3, (480, 640)) + level).astype(np.uint8)


#: These pictures are none of a sensor.
ANY_IMAGE = {
    "check.least_contrast": 0.0, "check.least_white": 0.0, "check.most_white": 100.0,
    "check.least_likeness": -1.0, "check.least_continuity": -1.0,
}  # fmt: skip


def with_images(kind: str, count: int = 40):
    source = plain(kind, count)
    source.note["parameters"] = json.dumps({"/arm/estimator": ANY_IMAGE})
    return source


def plain(kind: str, count: int):
    source = recording(count).without("/arm/contact/estimate").without("/arm/contact/presence")
    for k in range(count):
        stamp_ns = START_NS + k * STEP_NS
        head = header(stamp_ns, "arm/tactile_sensor")
        if kind == "raw":
            message = make(IMAGE, head, 480, 640, "mono8", 0, 640, picture(k).reshape(-1))
            source.add("/arm/tactile/image", IMAGE, message, stamp_ns)
        else:
            data = cv2.imencode(".png", picture(k))[1].reshape(-1)
            message = make(COMPRESSED, head, "mono8; png", data)
            source.add("/arm/tactile/image/compressed", COMPRESSED, message, stamp_ns)
    return source


def beliefs(source, folder, model=None):
    bag, remarks = estimated(read_bag(source.write(folder), wanted_with_images), model)
    inputs = inputs_of(bag)
    return run_filter(inputs.arms[0], FilterSettings()).beliefs, remarks


def test_raw_and_compressed_images_give_the_same_beliefs(tmp_path):
    raw, remarks = beliefs(with_images("raw"), tmp_path / "raw")
    packed, others = beliefs(with_images("compressed"), tmp_path / "packed")
    valid = [belief for belief in raw if belief.valid]
    assert [b.stamp_ns for b in valid] == [START_NS + k * STEP_NS for k in range(FREE, 40)]
    assert remarks == others == [] and len(raw) > len(valid)
    for one, other in zip(raw, packed, strict=True):
        assert one.mean.tobytes() == other.mean.tobytes() and one.cov.tobytes() == other.cov.tobytes()
    first = 0.01 * np.float32(picture(FREE).mean() / 255.0)
    assert valid[0].mean[2, 3] == pytest.approx(-first, rel=1e-3)


def test_images_that_cannot_be_used_are_named_and_the_others_are(tmp_path):
    source = with_images("compressed")
    broken = make(
        COMPRESSED, header(START_NS + 30 * STEP_NS, "arm/tactile_sensor"), "mono8; png", np.zeros(9, np.uint8)
    )
    bright = cv2.imencode(".png", np.full((480, 640), 255, np.uint8))[1].reshape(-1)
    refused = make(COMPRESSED, header(START_NS + 33 * STEP_NS, "arm/tactile_sensor"), "mono8; png", bright)
    topic, places = "/arm/tactile/image/compressed", {30: broken, 33: refused}
    rows = [k for k, message in enumerate(source.messages) if message[0] == topic]
    for number, message in places.items():
        old = source.messages[rows[number]]
        source.messages[rows[number]] = (*old[:2], bytes(STORE.serialize_cdr(message, COMPRESSED)), old[3])
    source.messages.append((*source.messages[rows[35]][:3], source.messages[-1][3]))
    found, remarks = beliefs(source, tmp_path / "bag")
    valid = {round((b.stamp_ns - START_NS) / STEP_NS) for b in found if b.valid}
    assert valid == set(range(FREE, 40)) - {30, 33}
    assert remarks == [
        "arm: 1 images cannot be used, the first: "
        "'mono8; png': is not a readable image (truncated or of another format)",
        "arm: 1 estimates are no Gaussians, the first: the network answered with NaN",
        "arm: 1 images are not later than the one before them, "
        f"the first: stamp {START_NS + 35 * STEP_NS} ns",
    ]


def test_images_of_an_encoding_that_is_not_known_are_refused_and_said_to_be_so(tmp_path):
    source = with_images("raw", 3)
    head = header(START_NS, "arm/tactile_sensor")
    message = make(IMAGE, head, 2, 2, "bayer_rggb8", 0, 6, np.zeros(12, np.uint8))
    source.messages = [m for m in source.messages if m[0] != "/arm/tactile/image"]
    source.add("/arm/tactile/image", IMAGE, message, START_NS)
    _, remarks = estimated(read_bag(source.write(tmp_path / "bag"), wanted_with_images), None)
    assert "encoding is 'bayer_rggb8', must be 'mono8', or one of" in remarks[0]
    assert remarks[1] == "arm: too few images for the reference of the contact presence"


def test_the_recorded_model_and_presence_settings_are_taken_where_they_are_there(tmp_path):
    model = tmp_path / "mine.onnx"
    model.write_bytes(b"")
    source = with_images("compressed", 3)
    for parameters, taken, remarked in (
        ({"model": str(model)}, str(model), False),
        ({"model": "/gone.onnx"}, "", True),
        ({}, "", False),
    ):
        source.note = {"parameters": json.dumps({"/arm/estimator": {**parameters, "presence.on": 0.5}})}
        bag = read_bag(source.write(tmp_path / f"bag{len(list(tmp_path.iterdir()))}"), wanted_with_images)
        remarks: list[str] = []
        chosen = replay_images._Estimates(bag, "arm", None, remarks)
        assert chosen.perceive.estimator.model == taken and bool(remarks) == remarked
        assert chosen.presence.settings == PresenceSettings(on=0.5)


def test_the_command_puts_the_new_estimates_into_the_new_bag(tmp_path, capsys):
    bag = with_images("compressed").write(tmp_path / "bag")
    options = ["--out", str(tmp_path / "out"), "--no-plot", "--from", "images"]
    assert main(["replay", str(bag), *options]) == 0
    counts = read_bag(tmp_path / "out" / "replay").topics
    assert counts["/arm/contact/estimate"] == counts["/arm/contact/belief"] == 40 - FREE
    assert main(["replay", str(bag), *options, "--model", "broken.onnx"]) == 2
    assert "broken.onnx: is not a usable ONNX model" in capsys.readouterr().err
    assert main(["replay", str(bag), "--out", str(tmp_path / "out"), "--model", "any.onnx"]) == 2
    assert "--model needs --from images" in capsys.readouterr().err


def test_a_bag_without_images_is_an_error_that_says_how_to_record_them(tmp_path):
    bag = read_bag(recording(3).write(tmp_path / "bag"), wanted_with_images)
    with pytest.raises(ReplayError, match=r"no images on <arm>/tactile/image.*--record-images records them"):
        estimated(bag, None)


def test_images_that_cannot_show_the_sensor_are_refused_as_they_were_live(tmp_path):
    source = with_images("raw")
    topic = "/arm/tactile/image"
    source.note["parameters"] = json.dumps({"/arm/estimator": {**ANY_IMAGE, "check.least_contrast": 0.5}})
    head = header(START_NS + 30 * STEP_NS, "arm/tactile_sensor")
    frozen = make(IMAGE, head, 480, 640, "mono8", 0, 640, picture(29).reshape(-1))
    rows = [k for k, message in enumerate(source.messages) if message[0] == topic]
    old = source.messages[rows[30]]
    source.messages[rows[30]] = (*old[:2], bytes(STORE.serialize_cdr(frozen, IMAGE)), old[3])
    found, remarks = beliefs(source, tmp_path / "bag")
    valid = {round((b.stamp_ns - START_NS) / STEP_NS) for b in found if b.valid}
    assert valid == set(range(FREE, 40)) - {30}
    assert remarks == [
        "arm: 1 images cannot be used, the first: repeated: it equals the one before it bit for bit: "
        "the camera is frozen"
    ]


class Blue(Reduced):
    """Takes images in color alone."""

    def __call__(self, image):
        assert image.shape == (480, 640, 3)
        return super().__call__(np.ascontiguousarray(image[:, :, 0]))


class Colors(Brightness):
    """The same by blue alone, which a picture in gray does not tell apart from red."""

    def __init__(self, model: object = "") -> None:
        super().__init__(model)
        self.metadata.preprocessing = PreprocessingSettings(color=True, threshold_method="none")
        self.preprocessor = Blue()


@pytest.mark.parametrize("kind", ["raw", "compressed"])
def test_a_model_of_colors_gets_the_colors_of_a_recording(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(replay_images, "Estimator", Colors)
    source = recording(30).without("/arm/contact/estimate").without("/arm/contact/presence")
    source.note["parameters"] = json.dumps({"/arm/estimator": ANY_IMAGE})
    for k in range(30):
        stamp_ns, image = START_NS + k * STEP_NS, np.dstack([picture(k), picture(0), picture(0)])
        head = header(stamp_ns, "arm/tactile_sensor")
        if kind == "raw":
            message = make(IMAGE, head, 480, 640, "bgr8", 0, 1920, image.reshape(-1))
            source.add("/arm/tactile/image", IMAGE, message, stamp_ns)
        else:
            message = make(COMPRESSED, head, "bgr8; png", cv2.imencode(".png", image)[1].reshape(-1))
            source.add("/arm/tactile/image/compressed", COMPRESSED, message, stamp_ns)
    valid = [belief for belief in beliefs(source, tmp_path / "bag")[0] if belief.valid]
    assert [belief.stamp_ns for belief in valid] == [START_NS + k * STEP_NS for k in range(FREE, 30)]
    first = 0.01 * np.float32(picture(FREE).mean() / 255.0)
    assert valid[0].mean[2, 3] == pytest.approx(-first, rel=1e-3)
