"""Bags that were cut or flipped somewhere: what is readable is read, what is missing is told.

These are samples; damage_everywhere.py goes through hundreds of places (docs/replay.md has its results).
"""

import sqlite3

import pytest
import replay_bags as bags
from damaged_bags import as_sqlite, cuts, damage, flips, outcome, use
from mcap.reader import make_reader

from tactile_records.bags.reader import read_bag

EACH = 100  # messages in a chunk


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two seconds of two arms, one of which touches now and then."""
    source = bags.recording(120, arms=("left", "right"), touching=lambda k: k % 30 > 4)
    for arm in ("left", "right"):
        for belief in bags.believed(source, arm=arm):
            source.state(belief, arm)
    source.messages.sort(key=lambda message: message[3])
    source.note["roles"] = (
        '{"left": {"task": "trajectory", "goals": ["one"]}, "right": {"task": "trajectory"}}'
    )
    return source.write(tmp_path_factory.mktemp("whole") / "bag", flush_every=EACH)


@pytest.fixture(params=["mcap", "db3"])
def folder(whole, tmp_path, request):
    """The same recording in either format, to be damaged."""
    bag = read_bag(whole)
    if request.param == "db3":
        return as_sqlite(bag, tmp_path / "bag")
    copy = tmp_path / "bag"
    copy.mkdir()
    for path in whole.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    return copy


def outcomes(folder, whole, kind, count) -> dict[str, int]:
    """How often each outcome came up; what the commands raise, other than their refusals, is raised."""
    bag = read_bag(whole)
    file = next(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    found = []
    for place in kind(len(data), count):
        file.write_bytes(damage(data, *place))
        found.append(outcome(folder, bag))
        use(folder)
    return {name: found.count(name) for name in found}


def test_of_a_bag_that_ends_early_nothing_is_missed_in_silence(folder, whole):
    found = outcomes(folder, whole, cuts, 25)
    assert set(found) <= {"whole", "told", "refused"}
    assert found["told"] >= 18, found


def test_of_a_bag_with_one_bit_turned_nothing_is_missed_in_silence(folder, whole):
    found = outcomes(folder, whole, flips, 60)
    assert "silent" not in found, found
    checked = bool(list(folder.glob("*.mcap")))  # sqlite3 has no checksums: there a message may be another
    assert found.get("altered", 0) == 0 or not checked, found


@pytest.mark.parametrize("folder", ["mcap"], indirect=True)
def test_a_bad_byte_in_the_first_chunk_costs_that_chunk_and_names_its_topics_and_time(folder, whole):
    """Which has the types and topics, that the file's end repeats."""
    bag, file = read_bag(whole), next(folder.glob("*.mcap"))
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    first = summary.chunk_indexes[0]
    data = bytearray(file.read_bytes())
    data[first.chunk_start_offset + first.chunk_length // 2] ^= 1
    file.write_bytes(data)
    part = read_bag(folder)
    assert part.messages == bag.messages[EACH:]
    assert part.types == bag.types and part.definitions == bag.definitions
    assert f"damaged near byte {first.chunk_start_offset} of {len(data)}" in part.problem
    for topic in {message.topic for message in bag.messages[:EACH]}:
        assert f"{part.counts[topic]} of {bag.counts[topic]} on {topic}" in part.problem
    times = first.message_start_time / 1e9, first.message_end_time / 1e9
    assert "the others are from {:.3f} to {:.3f} s".format(*times) in part.problem


@pytest.mark.parametrize("folder", ["mcap"], indirect=True)
def test_a_length_that_reaches_over_other_chunks_does_not_hide_them(folder, whole):
    bag, file = read_bag(whole), next(folder.glob("*.mcap"))
    with file.open("rb") as stream:
        second = make_reader(stream).get_summary().chunk_indexes[1]
    data = bytearray(file.read_bytes())
    data[second.chunk_start_offset + 3] ^= 1  # 65 kB more
    file.write_bytes(data)
    part = read_bag(folder)
    assert "damaged near byte" in part.problem and len(part.messages) == len(bag.messages) - EACH


def test_rows_that_a_damaged_sqlite_bag_no_longer_shows_are_missed_in_the_count(whole, tmp_path):
    folder = as_sqlite(read_bag(whole), tmp_path / "bag")
    with sqlite3.connect(next(folder.glob("*.db3"))) as connection:
        connection.execute("DELETE FROM messages WHERE id BETWEEN 10 AND 19")
    bag = read_bag(folder)
    assert not bag.complete and "messages that were read, of those that metadata.yaml names" in bag.problem
