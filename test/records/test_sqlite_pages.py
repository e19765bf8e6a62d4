"""Messages from the leaves of an sqlite3 file: those that sqlite itself reads, as long as it can."""

import sqlite3

import numpy as np
import pytest
from damaged_bags import damage, flips

from tactile_records.bags.sqlite_pages import stray_rows

ROWS = 6000
STAMPS = [0, 1, -1, 127, 128, 40_000, 2**23, 2**31, 2**47, 2**62, -(2**40)]


@pytest.fixture(scope="module", params=[512, 4096, 65536])
def file(request, tmp_path_factory):
    """A table of messages as ros2 bag has it, of all sizes, beside tables of other columns."""
    path, random = tmp_path_factory.mktemp("pages") / "bag.db3", np.random.default_rng(3)
    with sqlite3.connect(path) as database:
        database.execute(f"PRAGMA page_size = {request.param}")
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, qos TEXT)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        database.executemany(
            "INSERT INTO topics VALUES (?, ?, ?, ?)", [(1, "a", "b", "c"), (2, "d", "e", "")]
        )
        sizes = random.choice(
            [0, 1, 50, 300, 450, 4050, 4100, 9000], ROWS, p=[0.1, 0.1, 0.3, 0.3, 0.1, 0.04, 0.03, 0.03]
        )
        database.executemany(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)",
            [(k % 3, STAMPS[k % len(STAMPS)], random.bytes(size)) for k, size in enumerate(sizes.tolist())],
        )
    database.close()
    return path


def rows_of(file) -> list:
    with sqlite3.connect(file) as database:
        rows = database.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
    database.close()
    return rows


def test_all_messages_are_those_that_sqlite_reads(file):
    assert sorted(stray_rows(file)) == rows_of(file)


@pytest.mark.parametrize("part", [0.0, 0.001, 0.2, 0.5, 0.9, 0.999])
def test_of_a_file_that_ends_early_the_messages_before_the_end_are_found(file, part, tmp_path):
    data, whole = file.read_bytes(), rows_of(file)
    cut = tmp_path / "cut.db3"
    cut.write_bytes(data[: max(100, int(part * len(data)))])
    found = list(stray_rows(cut))
    assert set(found) <= set(whole)
    assert len(found) > 0.8 * part * ROWS - 60


def test_flipped_bits_raise_nothing_and_take_no_longer(file, tmp_path):
    data = file.read_bytes()
    changed = tmp_path / "flipped.db3"
    for kind, place in flips(len(data), 12):
        changed.write_bytes(damage(data, kind, place))
        assert len(list(stray_rows(changed))) <= 2 * ROWS


def test_records_that_share_their_bytes_do_not_multiply(tmp_path):
    """Cells of all pages that point to one long record."""
    size, pages = 4096, 400
    page = bytearray(size)
    page[0], page[3:5] = 13, (2000).to_bytes(2, "big")
    page[8 : 8 + 4000] = (4080).to_bytes(2, "big") * 2000
    page[4080:4083] = b"\xff\xff\x7f"  # a record of 2 MB
    head = bytearray(size)
    head[16:18] = size.to_bytes(2, "big")
    file = tmp_path / "hostile.db3"
    file.write_bytes(head + page * pages)
    assert list(stray_rows(file)) == []
