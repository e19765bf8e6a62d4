"""Bags that were made to do harm, or by a program gone wrong: a sentence, in little time and memory."""

import re
import resource
import sqlite3
import tracemalloc

import pytest
import replay_bags as bags
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tactile_bringup.cli import main
from tactile_records.bags.contents import BagError, noted
from tactile_records.bags.reader import read_bag

LARGE = 300_000_000  # bytes that a small file says to hold
ALLOWED = 120_000_000  # bytes that reading it may take
TRANSFORMS = "tf2_msgs/msg/TFMessage"


@pytest.fixture
def recorded(tmp_path):
    """A recording of one second, as our recorder writes it."""
    source = bags.recording(60, touching=lambda k: True)
    for belief in bags.believed(source):
        source.state(belief)
    source.note["roles"] = '{"arm": {"task": "trajectory", "goals": ["one"]}}'
    return source.write(tmp_path / "bag")


@pytest.fixture
def commands(tmp_path, capsys):
    """What replay and report say of a bag; an error that is no refusal is raised."""

    def run(folder) -> str:
        status = main(["replay", str(folder), "--out", str(tmp_path / "out"), "--no-plot"])
        assert status in (0, 2)
        assert main(["report", str(folder), "--out", str(tmp_path / "report")]) in (0, 1, 2)
        printed = capsys.readouterr()
        return " ".join((printed.out + printed.err).split())

    return run


def peak(action) -> int:
    """Bytes of memory that an action takes at most."""
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# ---- what is small and unpacks to much ----


def with_one_message(file, data: bytes, compression: CompressionType, chunk_size: int = 1 << 40) -> None:
    with file.open("wb") as stream:
        writer = McapWriter(stream, compression=compression, chunk_size=chunk_size)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/long", "cdr", schema)
        for index in range(LARGE // len(data)):
            writer.add_message(channel, index, data, index)
        writer.finish()


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("size", [LARGE, 1_000_000], ids=["one chunk", "many chunks"])
def test_an_mcap_file_that_unpacks_to_far_more_than_its_size_is_read_up_to_a_limit(
    tmp_path, compression, size
):
    file = tmp_path / "bomb.mcap"
    with_one_message(file, bytes(size), compression, chunk_size=size)
    assert file.stat().st_size < 2_000_000
    problem = []

    def read() -> None:
        try:
            problem.append(read_bag(file).problem)
        except BagError as error:
            problem.append(str(error))

    limit = ALLOWED + 40 * file.stat().st_size
    assert peak(read) < 2 * limit and "holds more than" in problem[0]


def test_a_file_that_is_compressed_as_a_whole_is_unpacked_up_to_a_limit(tmp_path):
    (tmp_path / "bomb.db3.zstd").write_bytes(zstandard.compress(bytes(LARGE)))
    with pytest.raises(BagError, match=r"holds more than 10\d MB, 40 times its size"):
        read_bag(tmp_path / "bomb.db3.zstd")


def test_messages_that_unpack_to_too_much_end_the_reading_and_damaged_ones_are_passed_over(tmp_path):
    packed = zstandard.compress(b"good"), b"bad", zstandard.compress(bytes(LARGE))
    database(tmp_path, [(id, 1, 10 * id, data) for id, data in enumerate(packed, 1)])
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information: {compression_mode: MESSAGE, compression_format: zstd}"
    )
    bag = read_bag(tmp_path)
    assert [message.data for message in bag.messages] == [b"good"]
    assert "holds more than" in bag.problem
    assert "1 messages are damaged, the first: /long at 20 ns" in bag.problem


# ---- sqlite3 ----

TABLES = {
    "topics": "CREATE TABLE topics (id, name, type)",
    "messages": "CREATE TABLE messages (id, topic_id, timestamp, data)",
}
ENDLESS = "AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i"


def database(folder, messages=(), topics=((1, "/long", "std_msgs/msg/String"),), tables=None) -> None:
    """A bag of these rows; tables in place of the ordinary ones."""
    tables = tables or {}
    with sqlite3.connect(folder / "bag_0.db3") as connection:
        for name, text in (TABLES | tables).items():
            connection.execute(text)
            rows = topics if name == "topics" else messages
            if name not in tables:
                connection.executemany(f"INSERT INTO {name} VALUES ({'?, ' * (len(rows[0]) - 1)}?)", rows)


@pytest.mark.parametrize(
    "row",
    [
        ("two", 1, 20, b"x"),
        (2.5, 1, 20, b"x"),
        (2, "one", 20, b"x"),
        (2, 7, 20, b"x"),
        (2, None, 20, b"x"),
        (2, 1, "late", b"x"),
        (2, 1, 0.5, b"x"),
        (2, 1, None, b"x"),
        (2, 1, 20, "text"),
        (2, 1, 20, 5),
        (2, 1, 20, None),
    ],
)
def test_a_row_of_wrong_types_in_an_sqlite_bag_is_passed_over_and_named(tmp_path, row):
    database(tmp_path, [(1, 1, 10, b"one"), row, (3, 1, 30, b"three")])
    bag = read_bag(tmp_path)
    assert [message.data for message in bag.messages] == [b"one", b"three"]
    assert "make" in bag.problem and "no sense" in bag.problem, bag.problem


@pytest.mark.parametrize(
    "topic",
    [(2, None, "std_msgs/msg/String"), (2, b"raw", "std_msgs/msg/String"), (2, "/x", 5), ("b", "/x", "y")],
)
def test_a_topic_of_wrong_types_in_an_sqlite_bag_is_passed_over_and_named(tmp_path, topic):
    known = (1, "/long", "std_msgs/msg/String")
    database(tmp_path, [(1, 1, 10, b"one"), (2, 2, 20, b"two")], topics=[known, topic])
    bag = read_bag(tmp_path)
    assert bag.types == {"/long": "std_msgs/msg/String"} and len(bag.messages) == 1
    assert f"topic {topic[0]!r} makes no sense" in bag.problem


@pytest.mark.parametrize(
    "tables, problem",
    [
        (
            {"messages": f"CREATE VIEW messages (id, topic_id, timestamp, data) {ENDLESS}, 1, 1, 1 FROM n"},
            "messages must be a table, is a view",
        ),
        (
            {"topics": f"CREATE VIEW topics (id, name, type) {ENDLESS}, '/x', 'y' FROM n"},
            "topics must be a table, is a view",
        ),
        (
            {"messages": "CREATE VIRTUAL TABLE messages USING fts4(id, topic_id, timestamp, data)"},
            "messages must be a table, is a virtual table",
        ),
        (
            {"messages": "CREATE TABLE messages (id, topic_id, timestamp, data AS (zeroblob(1000000000)))"},
            "column data of messages is computed",
        ),
    ],
)
def test_an_sqlite_bag_that_computes_its_rows_is_refused(tmp_path, tables, problem):
    database(tmp_path, [(1, 1, 10, b"one")], tables=tables)
    with pytest.raises(BagError, match=problem):
        read_bag(tmp_path)


# ---- metadata.yaml ----


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "relative_file_paths: {a: b}",
        "relative_file_paths: [5]",
        "custom_data: [1, 2]",
        "custom_data: {a: &x [1, 2], b: [*x, *x]}",
        "topics_with_message_count: [5]",
        "topics_with_message_count: [{topic_metadata: {name: /a}, message_count: many}]",
        "custom_data: {a: !!python/object:os.system {}}",
        "custom_data: " + "[" * 100_000,
        "custom_data: {a: " + "7" * 5000 + "}",
        "custom_data: \x00",
    ],
    ids=lambda text: text[:30],
)
def test_metadata_that_cannot_be_understood_is_passed_over_and_named(recorded, text):
    inner = text if text == "[]" else "{" + text + "}"
    (recorded / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {inner}")
    bag = read_bag(recorded)
    assert len(bag.messages) > 200 and "metadata.yaml: cannot be understood" in bag.problem


# ---- types ----

NESTED = "\n".join(f"================\nMSG: deep/P{k}\nP{k + 1}[2] next" for k in range(3000))


def with_definition(folder, type_name: str, text: str):
    """The same recording, one type of which is defined otherwise."""
    bag = read_bag(folder)
    file = next(folder.glob("*.mcap"))
    with file.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        channels = {}
        for topic, kind in bag.types.items():
            definition = text if kind == type_name else bag.definitions[kind]
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for message in bag.messages:
            writer.add_message(
                channels[message.topic], message.received_ns, message.data, message.published_ns
            )
        writer.finish()
    return folder


@pytest.mark.parametrize("type_name", [bags.TRANSFORMS, bags.ESTIMATE, bags.STATE, bags.PRESENCE])
@pytest.mark.parametrize(
    "text",
    [
        "this is no definition {{{",
        "float64 x",
        "Missing part",
        "{type_name} again",
        "float64[4000000000] many",
        "Empty[1000000000] many\n================\nMSG: deep/Empty\n",
        f"P0[2] next\n{NESTED}\n================\nMSG: deep/P3000\nuint8 x",
        "std_msgs/Header header\nstring[] names",
        "(" * 100_000,
    ],
    ids=lambda text: text[:20],
)
def test_a_definition_that_cannot_be_used_is_a_sentence(recorded, commands, type_name, text):
    short = type_name.replace("/msg/", "/")
    said = commands(
        with_definition(recorded, type_name, text.format(type_name=short) if "{type" in text else text)
    )
    assert re.search("cannot be (decoded|used|replayed)|the installed one is taken", said), said


@pytest.mark.parametrize(
    "type_name", ["", "a", "a/b/c/d", "../../etc/msg/passwd", "no_such/msg/Type", "a/msg/" + "x" * 300]
)
def test_a_type_without_definition_that_is_not_installed_is_a_sentence(tmp_path, commands, type_name):
    database(tmp_path, [(1, 1, 10, bytes(8))], topics=[(1, "/arm/contact/estimate", type_name)])
    said = commands(tmp_path)
    assert "no definition of" in said or "is no name of a type" in said, said


# ---- where results cannot be written ----


@pytest.fixture
def full_disk():
    """Files may have 1 kB, as if the disk were full then."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("command", ["replay", "report"])
def test_results_that_do_not_fit_onto_the_disk_are_a_sentence(recorded, full_disk, tmp_path, capsys, command):
    place = tmp_path / "results"
    assert main([command, str(recorded), "--out", str(place)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith(f"tactile {command}: {place}") and "File too large" in said


@pytest.mark.parametrize("command", ["replay", "report"])
def test_a_folder_for_results_that_cannot_be_made_is_a_sentence(recorded, tmp_path, capsys, command):
    (tmp_path / "file").write_text("")
    assert main([command, str(recorded), "--out", str(tmp_path / "file" / "results")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith(f"tactile {command}: {tmp_path / 'file'}")
    assert "Not a directory" in said or "cannot be a folder" in said


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "{", "[1]", '{"/arm/filter": 3}', '{"a": ' + "9" * 5000 + "}"]
)
def test_a_note_of_a_bag_that_is_not_what_it_should_be_is_a_sentence(text):
    with pytest.raises(BagError, match="the bag's note 'parameters'"):
        noted({"parameters": text}, "parameters")
