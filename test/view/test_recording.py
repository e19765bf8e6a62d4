"""A recording on the page: played, sought, stepped, and refused in words where there is nothing to show."""

import pytest
from cell_messages import DEPTH, RATE, START, TOPICS, messages, record

from tactile_records.bags.reader import BagError
from tactile_records.bags.writer import BagWriter
from tactile_view import recording as module
from tactile_view.cell_state import CellState
from tactile_view.recording import Recording


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return record(tmp_path_factory.mktemp("recorded") / "bag", 3.0)


@pytest.fixture
def opened(bag):
    state = CellState()
    return Recording(bag, state), state


def depth(state: CellState) -> float:
    return state.arms["arm"].newest("truth")["T_fs"][2, 3]


def test_it_is_played_in_its_own_time(bag, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
    state = CellState()
    recording = Recording(bag, state)
    for speed, seconds in ((1.0, 1.0), (2.0, 0.5), (0.5, 1.0)):
        before, recording.speed = recording.seconds, speed
        clock[0] += seconds
        recording.poll(0.0)
        assert recording.seconds - before == pytest.approx(speed * seconds, abs=1e-6)
    assert state.now_ns <= recording.now_ns and depth(state) == DEPTH
    clock[0] += 100.0
    recording.poll(0.0)
    assert recording.seconds == recording.duration and not recording.playing


def test_seeking_shows_the_state_of_that_time_also_backwards(opened):
    recording, state = opened
    for seconds, phase in ((2.0, "follow"), (0.2, "approach"), (2.5, "follow")):
        recording.seek(seconds)
        arm = state.arms["arm"]
        assert arm.controller.phase == phase
        x = arm.newest("pose")["T_base_sensor"][0, 3]
        assert x == pytest.approx(0.3 + 0.01 * seconds, abs=0.01 / RATE + 1e-9)
        assert arm.T_world_base[2, 3] == 0.5, "where the arm stands was said once, at the start"


def test_a_step_is_one_exposure(opened):
    recording, state = opened
    recording.seek(1.0)
    before = state.arms["arm"].newest("belief")["stamp_ns"]
    recording.step(1)
    assert state.arms["arm"].newest("belief")["stamp_ns"] - before == pytest.approx(1e9 / RATE, abs=2)
    recording.step(-3)
    assert before - state.arms["arm"].newest("belief")["stamp_ns"] == pytest.approx(2e9 / RATE, abs=3)
    assert not recording.playing


def test_the_time_line_has_all_phases_with_their_times(opened):
    recording, _ = opened
    while recording.look_on():
        pass
    assert recording.looked_through == 1.0
    phases = [
        (event.text, (event.stamp_ns - START) / 1e9) for event in recording.events if event.kind == "phase"
    ]
    assert phases == [("arm: approach", 0.0), ("arm: follow", pytest.approx(0.5, abs=1 / RATE))]


def test_a_bag_without_our_topics_is_refused_with_those_that_it_has(tmp_path):
    from cell_messages import packed

    from tactile_base.topics import Topic

    other = Topic("/chatter", "std_msgs/msg/String")
    with BagWriter(tmp_path / "bag", [other]) as bag:
        bag.write(other.name, packed(other.type, data="hello"), START)
    with pytest.raises(BagError, match="nothing to show; topics: /chatter"):
        Recording(tmp_path / "bag", CellState())


def test_a_bag_that_is_written_is_played_on_as_it_grows(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(module.time, "sleep", lambda seconds: None)
    told, state = list(messages(3.0)), CellState()
    with BagWriter(tmp_path / "bag", TOPICS) as bag:

        def go_on(seconds: float) -> None:
            while told and told[0][3] <= START + seconds * 1e9:
                topic, _, data, ns = told.pop(0)
                bag.write(topic, data, ns)
            bag.flush()
            clock[0] += 1.0
            recording.poll(0.0)

        bag.write(*told.pop(0)[::2], START)
        bag.flush()
        recording = Recording(tmp_path / "bag", state)
        recording.poll(0.0)
        assert recording.duration == 0.0 and recording.playing and recording.growing
        for seconds in (0.2, 1.0, 2.0):  # it is slower than it was, then as fast
            go_on(seconds)
            assert recording.duration == pytest.approx(seconds, abs=1.5 / RATE)
            assert recording.seconds == pytest.approx(seconds, abs=1.5 / RATE) and recording.playing
            assert depth(state) == DEPTH
        go_on(3.0)
    while recording.look_on():
        pass
    assert [event.text for event in recording.events] == ["arm: approach", "arm: follow"]
    clock[0] += 1.0
    recording.poll(0.0)
    assert recording.bag.problem == "" and not recording.growing and not recording.playing
    assert state.now_ns == recording.end_ns


def test_a_bag_whose_writer_was_killed_is_played_to_its_end(bag, tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    file = next(bag.glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    recording = Recording(cut, CellState())
    recording.seek(recording.duration)
    assert recording.playing and recording.growing
    clock[0] += module.STILL + 1.0
    recording.poll(0.0)
    assert not recording.playing and not recording.growing


def test_a_bag_that_is_cut_is_shown_as_far_as_it_goes(bag, tmp_path):
    file = next(bag.glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    state = CellState()
    recording = Recording(cut, state)
    assert 0.0 < recording.duration < 3.0 and "ends early" in recording.bag.problem
    recording.seek(recording.duration)
    assert depth(state) == DEPTH
