"""Bags are what other tools expect, and readable up to where their writer was killed."""

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from tactile_base.topics import Topic
from tactile_records.bags.reader import read_bag
from tactile_records.bags.writer import BagError, BagWriter
from tactile_wire.errors import DefinitionMissing
from tactile_wire.message_definitions import message_definition, type_hash

ROOT = Path(__file__).resolve().parents[2]
TWIST = Topic("/arm/command/twist", "geometry_msgs/msg/TwistStamped")
TREE = Topic("/tf_static", "tf2_msgs/msg/TFMessage", "latched")
STORE = get_typestore(Stores.LATEST)


@pytest.fixture(scope="module")
def definitions():
    """As installed packages would give them, from the definitions that `rosbags` brings."""
    types = (TWIST.type, TREE.type)
    return {name: STORE.generate_msgdef(name, ros_version=2)[0] for name in types}


def twist(speed: float) -> bytes:
    types = STORE.types
    vector = types["geometry_msgs/msg/Vector3"]
    stamp = types["builtin_interfaces/msg/Time"](1, 2)
    header = types["std_msgs/msg/Header"](stamp, "arm/tactile_sensor")
    value = types["geometry_msgs/msg/Twist"](vector(speed, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    return bytes(STORE.serialize_cdr(types[TWIST.type](header, value), TWIST.type))


def write(folder: Path, definitions, count: int = 5) -> BagWriter:
    bag = BagWriter(folder, [TWIST, TREE], definitions, note={"scene": "ramp"})
    for index in range(count):
        bag.write(TWIST.name, twist(0.01 * index), received_ns=1000 + index, published_ns=900 + index)
    return bag


def write_twists(bag: BagWriter, start_ns: int, count: int) -> None:
    for index in range(count):
        bag.write(TWIST.name, twist(index), start_ns + index, start_ns + index)


def overwrite(bag: BagWriter, start: int, damage: bytes) -> None:
    """Put `damage` in place of as many bytes of the bag's file."""
    data = bytearray(bag.file.read_bytes())
    data[start : start + len(damage)] = damage
    bag.file.write_bytes(data)


def test_a_bag_gives_back_what_was_written(tmp_path, definitions):
    write(tmp_path / "run", definitions).close()
    bag = read_bag(tmp_path / "run")
    assert bag.complete and bag.problem == "" and bag.note == {"scene": "ramp"}
    read = list(bag.decoded(TWIST.name))
    assert [message.twist.linear.x for _, message in read] == [0.0, 0.01, 0.02, 0.03, 0.04]
    assert [(raw.received_ns, raw.published_ns) for raw, _ in read][:2] == [(1000, 900), (1001, 901)]
    assert read[0][1].header.frame_id == "arm/tactile_sensor"


def test_other_readers_open_a_bag(tmp_path, definitions):
    write(tmp_path / "run", definitions).close()
    with AnyReader([tmp_path / "run"]) as reader:
        assert {(c.topic, c.msgtype, c.msgcount) for c in reader.connections} == {
            (TWIST.name, TWIST.type, 5),
            (TREE.name, TREE.type, 0),
        }
        speeds = [reader.deserialize(raw, c.msgtype).twist.linear.x for c, _, raw in reader.messages()]
    assert speeds == [0.0, 0.01, 0.02, 0.03, 0.04]


def test_metadata_names_files_topics_and_counts(tmp_path, definitions):
    write(tmp_path / "run", definitions).close()
    information = yaml.safe_load((tmp_path / "run" / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["run_0.mcap"]
    assert information["message_count"] == 5 and information["duration"]["nanoseconds"] == 4
    topic = information["topics_with_message_count"][0]
    assert topic["message_count"] == 5
    assert topic["topic_metadata"]["type_description_hash"] == STORE.hash_rihs01(TWIST.type)
    latched = information["topics_with_message_count"][1]["topic_metadata"]["offered_qos_profiles"][0]
    assert latched["durability"] == "transient_local"


def test_a_bag_whose_writer_was_killed_is_read_up_to_the_last_flush(tmp_path, definitions):
    code = f"""
import os, signal
from test_bag import write
from pathlib import Path
bag = write(Path({str(tmp_path / "run")!r}), {definitions!r}, count=50)
bag.flush()
bag.write("/arm/command/twist", b"lost", 2000, 2000)
os.kill(os.getpid(), signal.SIGKILL)
"""
    paths = os.pathsep.join([str(ROOT), str(Path(__file__).parent)])
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths})
    assert done.returncode == -signal.SIGKILL
    bag = read_bag(tmp_path / "run")
    assert len(bag.messages) == 50 and bag.note == {"scene": "ramp"}
    assert not bag.complete
    assert "ends early" in bag.problem and "50 messages before that were read" in bag.problem


@pytest.mark.parametrize("part", [0.3, 0.6, 0.95])
def test_a_truncated_bag_gives_what_is_readable(tmp_path, definitions, part):
    writer = write(tmp_path / "run", definitions, count=0)
    for index in range(200):
        writer.write(TWIST.name, twist(index), 1000 + index, 1000 + index)
        writer.flush()
    writer.close()
    whole = writer.file.read_bytes()
    writer.file.write_bytes(whole[: int(part * len(whole))])
    bag = read_bag(tmp_path / "run")
    read = [message.twist.linear.x for _, message in bag.decoded(TWIST.name)]
    assert not bag.complete and read == list(range(len(read))) and len(read) > 0


def test_damaged_data_is_noticed_and_what_came_before_is_kept(tmp_path, definitions):
    writer = write(tmp_path / "run", definitions)
    writer.flush()
    good = writer.file.stat().st_size
    write_twists(writer, 2000, 50)
    writer.close()
    overwrite(writer, good + 60, bytes(30))
    bag = read_bag(tmp_path / "run")
    assert not bag.complete and len(bag.messages) == 5
    assert "damaged near byte" in bag.problem


def test_a_damaged_chunk_does_not_hide_those_behind_it(tmp_path, definitions):
    writer = write(tmp_path / "run", definitions)
    sizes = []
    for _ in range(2):
        writer.flush()
        sizes.append(writer.file.stat().st_size)
        write_twists(writer, 2000, 50)
    writer.close()
    overwrite(writer, sizes[0] + 60, bytes(30))
    bag = read_bag(tmp_path / "run")
    assert not bag.complete and len(bag.messages) == 5 + 50


def test_after_a_damaged_length_the_index_tells_where_to_go_on(tmp_path, definitions):
    writer = write(tmp_path / "run", definitions)
    writer.flush()
    size = writer.file.stat().st_size
    write_twists(writer, 2000, 50)
    writer.flush()
    write_twists(writer, 3000, 7)
    writer.close()
    overwrite(writer, size + 1, b"\xff" * 8)
    bag = read_bag(tmp_path / "run")
    assert "no record of MCAP" in bag.problem and len(bag.messages) == 5 + 7


def test_a_chunk_that_damage_turned_into_an_unknown_record_is_missed_in_the_count(tmp_path, definitions):
    writer = write(tmp_path / "run", definitions)
    writer.flush()
    size = writer.file.stat().st_size
    write_twists(writer, 3000, 7)
    writer.close()
    data = bytearray(writer.file.read_bytes())
    data[size] |= 0x80  # records of private kinds are passed over
    writer.file.write_bytes(data)
    bag = read_bag(tmp_path / "run")
    assert len(bag.messages) == 5 and f"messages that were read: 5 of 12 on {TWIST.name}" in bag.problem


def other_bag(folder: Path, plugin, count: int = 3000) -> None:
    """A bag as `ros2 bag` would write it."""
    with Writer(folder, version=9, storage_plugin=plugin) as bag:
        fill(bag, count)


def fill(bag, count: int) -> None:
    connection = bag.add_connection(TWIST.name, TWIST.type, typestore=STORE)
    bag.add_connection(TREE.name, TREE.type, typestore=STORE)
    for index in range(count):
        bag.write(connection, 1000 + index, twist(index))


STORAGES = [
    (plugin, mode)
    for plugin in StoragePlugin
    for mode in CompressionMode
    if (plugin, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)  # chunks are a thing of MCAP
]


@pytest.mark.parametrize(("plugin", "mode"), STORAGES)
def test_bags_of_ros2_bag_are_read_in_every_storage_and_compression(tmp_path, plugin, mode):
    bag = Writer(tmp_path / "run", version=9, storage_plugin=plugin)
    if mode != CompressionMode.NONE:
        bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        fill(bag, 300)
    bag = read_bag(tmp_path / "run")
    assert bag.complete, bag.problem
    assert [message.twist.linear.x for _, message in bag.decoded(TWIST.name)] == list(range(300))
    assert bag.messages[7].received_ns == 1007
    assert bag.types[TREE.name] == TREE.type and bag.topics == {TWIST.name: 300}


@pytest.mark.parametrize("compression", CompressionType)
def test_chunks_of_every_compression_are_read_up_to_where_the_file_is_cut(tmp_path, definitions, compression):
    file = tmp_path / "one.mcap"
    noise = random.Random(1)
    with file.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=1 << 20, compression=compression)
        writer.start(profile="ros2")
        schema = writer.register_schema(TWIST.type, "ros2msg", definitions[TWIST.type].encode())
        channel = writer.register_channel(TWIST.name, "cdr", schema)
        for index in range(3000):
            writer.add_message(channel, index, twist(noise.random()), index)
        writer.finish()
    assert len(read_bag(file).messages) == 3000
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 4])
    part = read_bag(file)  # all of it was one chunk
    assert not part.complete and 500 < len(part.messages) < 3000
    assert [m.received_ns for m in part.messages] == list(range(len(part.messages)))


@pytest.mark.parametrize("part", [0.3, 0.6, 0.95])
def test_a_truncated_sqlite_bag_gives_what_sqlite_still_finds(tmp_path, part):
    """Messages that are larger than a page among them: none of those comes with its end cut off."""
    folder, long = tmp_path / "run", Topic("/long", "std_msgs/msg/String")
    texts = {index: str(index) * 3000 for index in range(0, 3000, 100)}
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        short = bag.add_connection(TWIST.name, TWIST.type, typestore=STORE)
        other = bag.add_connection(long.name, long.type, typestore=STORE)
        for index in range(3000):
            bag.write(short, 1000 + index, twist(index))
            if index in texts:
                message = STORE.types[long.type](texts[index])
                bag.write(other, 1000 + index, STORE.serialize_cdr(message, long.type))
    file = next(folder.glob("*.db3"))
    whole = file.read_bytes()
    file.write_bytes(whole[: int(part * len(whole))])
    bag = read_bag(folder)
    read = [message.twist.linear.x for _, message in bag.decoded(TWIST.name)]
    assert read == list(range(len(read))) and 0.8 * part < len(read) / 3000 < part + 0.05
    found = [message.data for _, message in bag.decoded(long.name)]
    assert len(found) > 20 * part and set(found) <= set(texts.values())
    assert not bag.complete and "ends early" in bag.problem


@pytest.mark.parametrize("zeros", [False, True])
def test_a_sqlite_bag_gives_its_messages_without_the_page_that_leads_to_them(tmp_path, zeros):
    """That page stands in the middle of a large file, whose end is missing, or zeros."""
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        connection = bag.add_connection(TWIST.name, TWIST.type, typestore=STORE)
        for index in range(5000):
            bag.write(connection, 1000 + index, index.to_bytes(1000, "little"))
    file = next((tmp_path / "run").glob("*.db3"))
    whole = file.stat().st_size

    def cut(size: int) -> None:
        with file.open("r+b") as stream:
            stream.truncate(size)
            stream.truncate(whole if zeros else size)

    cut(whole // 4)
    bag = read_bag(tmp_path / "run")
    read = [int.from_bytes(message.data, "little") for message in bag.messages]
    assert read == sorted(set(read)) and len(read) > 1000 and read[-1] < len(read) + 4  # those of a page
    assert not bag.complete and ("malformed" if zeros else "ends early") in bag.problem
    cut(5 * 4096)  # before any message
    with pytest.raises(BagError, match=r"nothing in it can be read.*sqlite3 run.db3 .recover"):
        read_bag(tmp_path / "run")


@pytest.mark.parametrize("page_size", [512, 4096, 65536])
def test_messages_of_all_sizes_are_read_page_by_page_as_sqlite_reads_them(tmp_path, page_size):
    file, random_ = tmp_path / "bag_0.db3", random.Random(3)
    stamps = [0, 1, -1, 127, 128, 40_000, 2**23, 2**31, 2**47, 2**62, -(2**40)]
    sizes = random_.choices(
        [0, 1, 50, 300, 450, 4050, 4100, 9000, 70_000], [9, 9, 30, 30, 9, 4, 4, 4, 1], k=3000
    )
    rows = [(k, 1, stamps[k % len(stamps)], random_.randbytes(size)) for k, size in enumerate(sizes, 1)]
    with sqlite3.connect(file) as database:
        database.execute(f"PRAGMA page_size = {page_size}")
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        columns = "topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL"
        database.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, {columns})")
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        database.execute("INSERT INTO topics VALUES (1, '/x', 'std_msgs/msg/String')")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    database.close()
    with file.open("ab") as stream:
        stream.truncate(file.stat().st_size - 1)
    read = [(message.received_ns, message.data) for message in read_bag(file).messages]
    assert read == [row[2:] for row in rows][: len(read)] and len(read) > len(rows) - 200


def test_sqlite_rows_that_share_their_bytes_do_not_multiply(tmp_path):
    """Cells of all pages that point to one long record, in a file whose end is missing."""
    file, size = tmp_path / "bag_0.db3", 4096
    with sqlite3.connect(file) as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.execute("INSERT INTO topics VALUES (1, '/x', 'std_msgs/msg/String')")
        database.execute("INSERT INTO messages VALUES (7, 1, 1, ?)", (bytes(2_000_000),))
    database.close()
    data = bytearray(file.read_bytes())
    (leaf,) = [n for n in range(0, len(data), size) if data[n] == 13 and n > size]
    count = 480  # cells, all of them at the place of the one that there is
    data[leaf + 3 : leaf + 5] = count.to_bytes(2, "big")
    data[leaf + 8 : leaf + 8 + 2 * count] = data[leaf + 8 : leaf + 10] * count
    file.write_bytes(data + data[leaf : leaf + size] * 200)
    with file.open("r+b") as stream:
        stream.seek(28)
        stream.write((10**6).to_bytes(4, "big"))
    bag = read_bag(file)
    assert len(bag.messages) == 1 and "ends early" in bag.problem


def test_rows_behind_a_damaged_page_of_a_sqlite_bag_are_read(tmp_path):
    other_bag(tmp_path / "run", StoragePlugin.SQLITE3)
    file = next((tmp_path / "run").glob("*.db3"))
    data = bytearray(file.read_bytes())
    at = data.index(twist(1500.0))
    page = at // 4096 * 4096
    data[page : page + 4096] = b"\xff" * 4096
    file.write_bytes(data)
    bag = read_bag(tmp_path / "run")
    read = [message.twist.linear.x for _, message in bag.decoded(TWIST.name)]
    assert not bag.complete and 1500.0 not in read and 2950 < len(read) < 3000
    assert read == sorted(set(read)) and read[-1] == 2999.0


def test_a_bag_in_several_files_is_one_bag_and_a_missing_one_is_named(tmp_path, definitions):
    for number in (0, 1, 2, 10):
        write(tmp_path / f"run_{number}", definitions, count=number + 1).close()
    (tmp_path / "run").mkdir()
    for number in (0, 1, 2, 10):
        (tmp_path / f"run_{number}" / f"run_{number}_0.mcap").rename(tmp_path / "run" / f"run_{number}.mcap")
    bag = read_bag(tmp_path / "run")
    assert bag.complete and len(bag.messages) == 1 + 2 + 3 + 11
    assert [m.received_ns for m in bag.messages[-11:]] == [1000 + i for i in range(11)]
    names = ["run_0.mcap", "run_1.mcap", "run_7.mcap"]
    text = yaml.safe_dump({"rosbag2_bagfile_information": {"relative_file_paths": names}})
    (tmp_path / "run" / "metadata.yaml").write_text(text)
    bag = read_bag(tmp_path / "run")
    assert not bag.complete and "run_7.mcap: the file is missing" in bag.problem


def test_only_the_topics_that_are_wanted_are_kept_and_all_are_counted(tmp_path, definitions):
    write(tmp_path / "run", definitions).close()
    bag = read_bag(tmp_path / "run", lambda topic, type_name: topic == TREE.name)
    assert bag.messages == [] and bag.counts == {TWIST.name: 5, TREE.name: 0}


def test_an_existing_bag_is_not_overwritten(tmp_path, definitions):
    write(tmp_path / "run", definitions).close()
    with pytest.raises(BagError, match="run exists already; remove it or record elsewhere"):
        BagWriter(tmp_path / "run", [TWIST], definitions)


@pytest.mark.parametrize("act", ["flush", "close"])
@pytest.mark.parametrize("moved", [False, True])
def test_a_bag_that_is_deleted_or_moved_while_it_is_written_is_an_error(tmp_path, definitions, act, moved):
    bag = write(tmp_path / "run", definitions)
    if moved:
        (tmp_path / "run").rename(tmp_path / "elsewhere")
    else:
        shutil.rmtree(tmp_path / "run")
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / bag.file.name).touch()  # somebody else's, of the same name
    with pytest.raises(BagError, match=r"run_0\.mcap: cannot be written: it was deleted or moved"):
        getattr(bag, act)()


def test_what_is_no_bag_is_an_error_that_names_it(tmp_path):
    with pytest.raises(BagError, match="nowhere: no such bag"):
        read_bag(tmp_path / "nowhere")
    with pytest.raises(BagError, match=r"holds 0 \.mcap files, must hold one"):
        read_bag(tmp_path)
    (tmp_path / "text.mcap").write_text("not a bag at all")
    with pytest.raises(BagError, match="nothing in it can be read"):
        read_bag(tmp_path)


def test_a_definition_holds_all_that_a_type_uses(tmp_path, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    folder = tmp_path / "share" / "toy_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Part.msg").write_text("float64[<=6] values  # m\nuint8 KIND=3\n")
    (folder / "Whole.msg").write_text("Part[] parts\ntoy_msgs/Part one\nstring<=8 name\n")
    text = message_definition("toy_msgs/msg/Whole")
    assert text.count("MSG: toy_msgs/Part") == 1 and "# m" in text
    assert type_hash("toy_msgs/msg/Whole", text).startswith("RIHS01_")


def test_our_definitions_come_with_the_python_package_where_no_messages_are_built(tmp_path, monkeypatch):
    copy = tmp_path / "share" / "tactile_servoing" / "tactile_msgs"
    shutil.copytree(ROOT / "tactile_msgs", copy)
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    for name in ("msg/ContactState", "action/RunTask_FeedbackMessage"):
        assert message_definition(f"tactile_msgs/{name}")


def test_a_missing_definition_is_an_error_that_says_where_it_was_sought(tmp_path, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with pytest.raises(DefinitionMissing, match=f"no definition of toy_msgs/msg/Part.*{tmp_path}"):
        message_definition("toy_msgs/msg/Part")


def test_the_type_of_an_actions_feedback_is_called_as_ros_calls_it(tmp_path):
    """Although mcap-ros2-support 0.6 refuses it (docs/operating.md): rosbag2 knows the type by this name."""
    feedback = Topic("/arm/run_task/_action/feedback", "tactile_msgs/action/RunTask_FeedbackMessage")
    with BagWriter(tmp_path / "bag", [feedback]) as bag:
        bag.write(feedback.name, b"", received_ns=1000)
    with bag.file.open("rb") as stream:
        ((schema, _, _),) = make_reader(stream).iter_messages()
    assert schema.name == feedback.type
    assert "MSG: tactile_msgs/action/RunTask_Feedback\n" in schema.data.decode()
