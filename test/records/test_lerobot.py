"""Recordings as a LeRobot data set, held against what LeRobot writes of its format v3.0.

https://huggingface.co/docs/lerobot/lerobot-dataset-v3, and `lerobot/datasets/utils.py` of release 0.4.4.
"""

import json

import cv2
import numpy as np
import pyarrow.parquet
import pytest
from replay_bags import (
    START_NS,
    STEP_NS,
    STORE,
    T_base_sensor,
    believed,
    header,
    make,
    pose,
    recording,
    stamp,
)
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from tactile_bringup.cli import main
from tactile_wire.message_definitions import message_definition

IMAGE, POSE, STATUS = (
    "sensor_msgs/msg/CompressedImage",
    "geometry_msgs/msg/PoseStamped",
    ("tactile_msgs/msg/ControllerStatus"),
)
STORE.register({k: v for k, v in get_types_from_msg(message_definition(STATUS), STATUS).items()
                if k not in STORE.types})  # fmt: skip
COUNT, LAG_NS = 24, 6_000_000
SPEED = np.array([1e-3, 2e-3, 0.0, 0.0, 0.1, 0.0])


def picture(k: int, side: int = 48):
    return np.full((side, 64), 8 * k, np.uint8)


def status(k: int, stamp_ns: int):
    values = {name: np.zeros(6) for name in ("hold", "error", "reference", "feedforward", "unlimited")}
    values |= dict.fromkeys(("task", "phase", "goal_name", "reason", "trouble"), "")
    values |= {"goal": 0, "at_work": True, "saturated": np.zeros(6, bool), "limited": k * SPEED}
    values |= {"progress": 0.0, "path_length": 0.0, "belief_age": 0.0, "hold_stamp": stamp(0)}
    values |= {"header": header(stamp_ns, "arm/tactile_sensor"), "belief_stamp": stamp(stamp_ns - LAG_NS)}
    kind = STORE.types[STATUS]
    return kind(**{name: values[name] for name in kind.__dataclass_fields__ if name in values})


def bag(folder, scene: str = "test", without=(), side: int = 48, damaged=()):
    """An image, a pose, from the sixth on a belief, and 6 ms later a command at each step of 1/60 s."""
    source = recording(COUNT)
    source.note["scene"] = scene
    for k in set(range(COUNT)) - set(without):
        data = (
            np.zeros(9, np.uint8) if k in damaged else cv2.imencode(".png", picture(k, side))[1].reshape(-1)
        )
        message = make(IMAGE, header(START_NS + k * STEP_NS, "arm/tactile_sensor"), "mono8; png", data)
        source.add("/arm/tactile/image/compressed", IMAGE, message, START_NS + k * STEP_NS)
    for belief in believed(source):
        source.state(belief)
    for k in range(COUNT):
        stamp_ns = START_NS + k * STEP_NS
        where = make(POSE, header(stamp_ns, "arm/base"), pose(T_base_sensor(k * STEP_NS * 1e-9)))
        source.add("/arm/arm/pose", POSE, where, stamp_ns)
        source.add("/arm/controller/status", STATUS, status(k, stamp_ns + LAG_NS), stamp_ns + LAG_NS)
    return source.write(folder)


def export(capsys, *arguments) -> tuple[int, str]:
    code = main(["export", *map(str, arguments), "--as", "lerobot"])
    captured = capsys.readouterr()
    return code, captured.out + captured.err


@pytest.fixture
def dataset(tmp_path, capsys):
    sources = bag(tmp_path / "one"), bag(tmp_path / "two", scene="other")
    code, said = export(capsys, *sources, "--out", tmp_path / "set")
    assert code == 0 and f"two: {COUNT} frames at 60 Hz, surface_following in other" in said
    return tmp_path / "set"


def frames(folder, episode: int):
    table = pyarrow.parquet.read_table(folder / f"data/chunk-000/file-{episode:03d}.parquet")
    return {name: table[name].to_pylist() for name in table.column_names}


def test_the_files_say_of_each_other_what_the_format_asks(dataset):
    info = json.loads((dataset / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 60 and info["splits"] == {"train": "0:2"}
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 2 * COUNT, 2)
    episodes = pyarrow.parquet.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(0, 24), (24, 48)]
    tasks = pyarrow.parquet.read_table(dataset / "meta/tasks.parquet").to_pylist()
    assert [t["__index_level_0__"] for t in tasks] == [
        "surface_following in test",
        "surface_following in other",
    ]
    for number, episode in enumerate(episodes):
        path = info["data_path"].format(
            chunk_index=episode["data/chunk_index"], file_index=episode["data/file_index"]
        )
        table = pyarrow.parquet.read_table(dataset / path)
        assert set(table.column_names) == set(info["features"]) and table.num_rows == episode["length"]
        columns = frames(dataset, number)
        np.testing.assert_allclose(columns["timestamp"], np.arange(COUNT) / 60, atol=1e-6)
        assert columns["frame_index"] == list(range(COUNT))
        assert columns["index"] == list(range(number * COUNT, (number + 1) * COUNT))
        assert {*columns["episode_index"]} == {*columns["task_index"]} == {number}
        for name, feature in info["features"].items():
            if feature["dtype"] == "float32" and name != "timestamp":
                assert len(feature["names"]) == feature["shape"][0] == len(columns[name][0])


def test_a_frame_holds_its_image_where_the_arm_was_what_was_believed_and_what_was_done(dataset):
    columns = frames(dataset, 1)
    for k in range(COUNT):
        image = cv2.imdecode(np.frombuffer(columns["observation.images.arm"][k]["bytes"], np.uint8), -1)
        assert image.shape == (48, 64, 3) and abs(image.astype(int) - 8 * k).max() <= 2
        state, T = np.array(columns["observation.state"][k]), T_base_sensor(k * STEP_NS * 1e-9)
        np.testing.assert_allclose(state[:3], T[:3, 3], atol=1e-6)
        np.testing.assert_allclose(Rotation.from_quat(state[3:]).as_matrix(), T[:3, :3], atol=1e-6)
        np.testing.assert_allclose(columns["action"][k], k * SPEED, atol=1e-7)
    contact = np.array(columns["observation.contact"])
    assert (contact[:4] == 0.0).all() and (contact[8:, 12] == 1.0).all()
    assert (contact[8:, 6:12] > 0.0).all()


def test_statistics_are_those_of_all_frames(dataset):
    found = json.loads((dataset / "meta/stats.json").read_text())
    for name in ("observation.state", "observation.contact", "action"):
        values = np.vstack([frames(dataset, number)[name] for number in range(2)])
        for what in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(found[name][what], getattr(values, what)(axis=0), atol=1e-6)
        assert found[name]["count"] == [2 * COUNT]
    mean = np.mean([8 * k / 255 for k in range(COUNT)])
    np.testing.assert_allclose(found["observation.images.arm"]["mean"], np.full((3, 1, 1), mean), atol=1e-6)


def test_what_is_missing_or_damaged_is_said_and_the_rest_is_there(tmp_path, capsys):
    source = bag(tmp_path / "bag", without=(9, 10), damaged=(15,))
    code, said = export(capsys, source, "--out", tmp_path / "set")
    assert (
        code == 0 and "frames show an image again" in said and "the image before it is in its place" in said
    )
    images = [cell["bytes"] for cell in frames(tmp_path / "set", 0)["observation.images.arm"]]
    assert len(images) == COUNT and images[15] == images[14]


def test_a_lower_rate_takes_fewer_frames(tmp_path, capsys):
    code, said = export(capsys, bag(tmp_path / "bag"), "--fps", 20, "--out", tmp_path / "set")
    assert code == 0 and ": 8 frames at 20 Hz" in said
    np.testing.assert_allclose(
        frames(tmp_path / "set", 0)["action"], 3 * np.arange(8)[:, None] * SPEED, atol=1e-7
    )


def test_what_cannot_be_one_data_set_is_refused_in_a_sentence(tmp_path, capsys):
    one, other = bag(tmp_path / "one"), bag(tmp_path / "other", side=32)
    code, said = export(capsys, one, other, "--out", tmp_path / "set")
    assert code == 2 and "its arms or image sizes differ from those of" in said
    assert not (tmp_path / "set/meta/info.json").exists()
    code, said = export(capsys, one, "--out", tmp_path / "set")
    assert code == 2 and "is not empty" in said
    code, said = export(capsys, recording(10).write(tmp_path / "none"), "--out", tmp_path / "set2")
    assert code == 2 and "no arm with poses and images" in said
    code, said = export(capsys, bag(tmp_path / "blind", without=range(COUNT)), "--out", tmp_path / "set2")
    assert code == 2 and "record them with --record-images" in said
    assert main(["export", str(one), str(other), "--out", str(tmp_path / "csv")]) == 2
    assert "writes one run" in capsys.readouterr().err
