"""What a span of time holds is what was written then, in every kind of file, and little else is read."""

import random
import sqlite3
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer

from tactile_records.bags import seeking, seeking_mcap
from tactile_records.bags.contents import BagError
from tactile_records.bags.seeking import SeekableBag

TYPE = "std_msgs/msg/String"
COUNT, START = 4000, 1_000_000
#: Topic, time of reception and bytes, in the order of writing, which is not quite that of the times.
_RANDOM = random.Random(3)
WRITTEN = [
    ("/seldom" if k % 1000 == 7 else "/a" if k % 3 else "/b", START + 10 * k + _RANDOM.randrange(40),
     _RANDOM.randbytes(_RANDOM.randrange(4, 60)))
    for k in range(COUNT)
]  # fmt: skip


def mcap(path: Path, written=WRITTEN, **options) -> Path:
    """As another program writes it: chunks of 4 kB, with all indexes unless told otherwise."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=4096, **{"compression": CompressionType.ZSTD, **options})
        writer.start("ros2", "test")
        schema = writer.register_schema(TYPE, "ros2msg", b"string data")
        channels: dict[str, int] = {}
        for topic, ns, data in written:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], ns, data, ns)
        writer.finish()
    return path


def without_end(path: Path) -> Path:
    """The same without summary and footer, as of a writer that was killed, or still writes."""
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\x0f" + (4).to_bytes(8, "little"))])  # its record "data end"
    return path


def packed(path: Path) -> Path:
    target = path.with_name(path.name + ".zstd")
    target.write_bytes(zstandard.compress(path.read_bytes()))
    path.unlink()
    return target


def sqlite(folder: Path) -> Path:
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {
            topic: writer.add_connection(topic, TYPE, msgdef="string data", rihs01="RIHS01_" + 64 * "0")
            for topic in ("/a", "/b", "/seldom")
        }
        for topic, ns, data in WRITTEN:
            writer.write(topics[topic], ns, data)
    return folder / "bag"


def without_index(bag: Path) -> Path:
    with sqlite3.connect(next(bag.glob("*.db3"))) as database:
        database.execute("DROP INDEX timestamp_idx")
    return bag


#: What a program may leave out, and how ours or `ros2 bag` may have kept or lost it.
KINDS = {
    "indexed": lambda folder: mcap(folder / "run.mcap"),
    "lz4": lambda folder: mcap(folder / "run.mcap", compression=CompressionType.LZ4),
    "without end": lambda folder: without_end(mcap(folder / "run.mcap")),
    "without indexes": lambda folder: mcap(folder / "run.mcap", index_types=IndexType.NONE),
    "without summary": lambda folder: mcap(
        folder / "run.mcap", repeat_channels=False, repeat_schemas=False, use_statistics=False
    ),
    "without chunks": lambda folder: mcap(folder / "run.mcap", use_chunking=False),
    "packed as a whole": lambda folder: packed(mcap(folder / "run.mcap")),
    "sqlite3": sqlite,
    "sqlite3 without index": lambda folder: without_index(sqlite(folder)),
}


def expected(start_ns: int, stop_ns: int, names=None) -> list[tuple[int, str, bytes]]:
    wanted = [(ns, t, data) for t, ns, data in WRITTEN if names is None or t in names]
    return sorted(row for row in wanted if start_ns <= row[0] < stop_ns)


@pytest.mark.parametrize("kind", KINDS)
def test_a_span_holds_what_was_written_then(kind, tmp_path):
    bag = SeekableBag(KINDS[kind](tmp_path))
    assert bag.start_ns == min(ns for _, ns, _ in WRITTEN) and bag.end_ns == max(ns for _, ns, _ in WRITTEN)
    assert set(bag.contents.types.items()) == {(topic, TYPE) for topic in ("/a", "/b", "/seldom")}
    for span in ((0, 2**62), (START + 20_000, START + 20_500), (0, START), (START + 39_000, 2**62)):
        for names in (None, {"/seldom"}, {"/a", "/b"}, {"/none"}):
            found = [(m.received_ns, m.topic, m.data) for m in bag.between(*span, names)]
            assert sorted(found) == expected(*span, names)
            assert [ns for ns, *_ in found] == sorted(ns for ns, *_ in found)


@pytest.fixture
def read_places(monkeypatch):
    """The places that are read from now on."""
    places, before = [], seeking_mcap.SeekingMcap._messages

    def counted(self, place, names=None):
        places.append(place.at)
        return before(self, place, names)

    monkeypatch.setattr(seeking_mcap.SeekingMcap, "_messages", counted)
    return places


@pytest.mark.parametrize("kind", ["indexed", "without end"])
def test_only_what_is_asked_for_is_read_and_what_was_read_last_is_kept(kind, tmp_path, read_places):
    bag = SeekableBag(KINDS[kind](tmp_path))
    assert len(read_places) <= 2, "to open it, no more than what tells the topics"
    read_places.clear()
    list(bag.between(START + 20_000, START + 20_100))
    assert 1 <= len(read_places) <= 3
    list(bag.between(START + 20_000, START + 20_100))
    assert len(read_places) <= 3, "again"
    read_places.clear()
    list(bag.between(0, bag.end_ns, {"/seldom"}))
    assert len(read_places) <= 4, "four messages of it there are"


def test_what_is_kept_has_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(seeking_mcap, "KEPT", 20_000)
    bag = SeekableBag(mcap(tmp_path / "run.mcap"))
    assert sum(1 for _ in bag.between(0, bag.end_ns + 1)) == COUNT
    (part,) = bag._parts
    kept = sum(seeking_mcap._cost(messages) for messages in part._kept.values())
    assert kept == part._size <= 20_000


def test_of_several_files_each_is_read_in_its_time(tmp_path):
    for k in range(3):
        mcap(tmp_path / f"run_{k}.mcap", WRITTEN[k::3])
    found = [message.received_ns for message in SeekableBag(tmp_path).between(0, 2**62)]
    assert found == sorted(ns for _, ns, _ in WRITTEN)


def test_a_damaged_chunk_is_told_once_and_the_others_are_read(tmp_path):
    file = mcap(tmp_path / "run.mcap")
    bag = SeekableBag(file)
    place = bag._parts[0].places[5]
    data = bytearray(file.read_bytes())
    data[(place.at + place.stop) // 2] ^= 0x10
    file.write_bytes(data)
    for _ in range(2):
        times = [message.received_ns for message in bag.between(0, 2**62)]
        assert COUNT - 200 < len(times) < COUNT
    assert bag.contents.problem.count(f"damaged near byte {place.at}") == 1


def test_a_file_that_ends_within_a_chunk_is_read_up_to_there_and_that_is_told(tmp_path):
    file = mcap(tmp_path / "run.mcap", compression=CompressionType.NONE)
    file.write_bytes(file.read_bytes()[:60_000])
    bag = SeekableBag(file)
    times = [message.received_ns for message in bag.between(0, 2**62)]
    assert times == sorted(ns for _, ns, _ in WRITTEN[: len(times)]) and bag.end_ns == times[-1]
    assert "its writer was killed, or still writes" in bag.contents.problem


@pytest.mark.parametrize("options", [{}, {"index_types": IndexType.NONE}, {"use_chunking": False}])
def test_what_is_written_after_it_was_opened_is_taken_in_and_nothing_twice(tmp_path, options):
    """Cut anywhere, also within records, as a reader finds it whose writer is at work."""
    whole = mcap(tmp_path / "whole.mcap", **options).read_bytes()
    file, at, lengths = tmp_path / "run.mcap", 9000, random.Random(5)
    file.write_bytes(whole[:at])
    bag = SeekableBag(file)
    seen = rows(bag)
    while at < len(whole):
        assert bag.open_ended and bag.contents.problem.count("ends early") == 1
        assert not bag.look_again()
        more = whole[at : at + lengths.randrange(1, 5000)]
        at += len(more)
        with file.open("ab") as stream:
            stream.write(more)
        assert bag.look_again()
        before, seen = seen, rows(bag)
        assert set(before) <= set(seen) and len(seen) == len(set(seen)) >= len(before)
    assert sorted(seen) == expected(0, 2**62) and bag.end_ns == seen[-1][0]
    assert not bag.open_ended and not bag.look_again() and bag.contents.problem == ""


def rows(bag: SeekableBag) -> list[tuple[int, str, bytes]]:
    return [(m.received_ns, m.topic, m.data) for m in bag.between(0, 2**62)]


def test_what_is_none_is_refused(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"no bag at all")
    with pytest.raises(BagError, match=r"nothing in it can be read \(run.mcap: is not an MCAP file"):
        SeekableBag(tmp_path)
    with pytest.raises(BagError, match="it holds no message"):
        SeekableBag(mcap(tmp_path / "run.mcap", []))


def test_a_damaged_database_that_is_too_large_to_be_read_as_a_whole_says_so(tmp_path, monkeypatch):
    bag = without_index(sqlite(tmp_path))
    monkeypatch.setattr(seeking, "LARGEST_WHOLE", 1000)
    with pytest.raises(BagError, match=r"no index of timestamps; and of \d+ bytes it is too large"):
        SeekableBag(bag)
