"""Events of several sources come out in the order of their stamps, whatever the order in which they came."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_filter.object.merge import EventMerge

MS = 1_000_000
WAIT, SILENCE = 20 * MS, 50 * MS


def stamps(groups) -> list[int]:
    return [group.stamp_ns for group in groups]


def fed(events, *, now_ns: int = 0) -> EventMerge:
    merge = EventMerge(["left", "right"])
    for source, stamp_ns in events:
        assert merge.add(source, stamp_ns, f"{source} {stamp_ns}", now_ns)
    return merge


def test_a_stamp_is_handed_out_when_all_have_come_as_far():
    merge = fed([("left", 10), ("right", 8)])
    assert stamps(merge.take(0, WAIT, SILENCE)) == [8]
    merge.add("right", 12, "", 0)
    (group,) = merge.take(0, WAIT, SILENCE)
    assert (group.stamp_ns, group.parts) == (10, {"left": "left 10"})
    assert stamps(merge.take(0, WAIT, SILENCE)) == []


def test_events_of_one_stamp_are_one_group_in_the_order_of_names():
    merge = fed([("right", 10), ("left", 10)])
    (group,) = merge.take(0, WAIT, SILENCE)
    assert list(group.parts.items()) == [("left", "left 10"), ("right", "right 10")]


def test_nobody_is_waited_for_longer_than_the_deadline():
    merge = fed([("right", 8), ("left", 10)])
    assert stamps(merge.take(0, WAIT, SILENCE)) == [8]
    assert stamps(merge.take(WAIT, WAIT, SILENCE)) == []
    assert stamps(merge.take(WAIT + 1, WAIT, SILENCE)) == [10]


def test_a_source_that_is_silent_or_was_never_heard_is_not_waited_for():
    assert stamps(fed([("left", 10)]).take(0, WAIT, SILENCE)) == [10]
    merge = fed([("right", 8)])
    merge.add("left", 10, "", SILENCE + 1)
    assert stamps(merge.take(SILENCE + 1, WAIT, SILENCE)) == [8, 10]


def test_an_event_that_is_not_later_than_its_sources_last_one_is_refused_and_counted():
    merge = fed([("left", 10)])
    assert not merge.add("left", 10, "", 0) and not merge.add("left", 9, "", 0)
    assert merge.out_of_order == 2 and len(merge) == 1


def test_one_that_was_not_waited_for_still_comes_out_and_is_counted():
    merge = fed([("left", 10)])
    merge.take(0, WAIT, SILENCE)
    merge.add("right", 9, "", 0)
    assert stamps(merge.take(0, WAIT, SILENCE)) == [9]
    assert merge.overtaken == 1


def test_after_a_clear_earlier_stamps_are_taken_again():
    merge = fed([("left", 10), ("right", 12)])
    merge.clear()
    assert len(merge) == 0 and merge.add("left", 3, "", 0)
    assert stamps(merge.take(0, WAIT, SILENCE)) == [3]


def test_an_unknown_source_is_an_error_that_lists_the_sources():
    with pytest.raises(KeyError, match=r"'lefft'.*did you mean 'left'.*left, right"):
        EventMerge(["left", "right"]).add("lefft", 1, "", 0)


@given(st.integers(0, 2**32 - 1))
def test_what_comes_out_does_not_depend_on_the_order_in_which_sources_arrive(seed):
    random = np.random.default_rng(seed)
    sources = ["a", "b", "c"]
    times = {s: [*sorted(random.choice(40, size=8, replace=False).tolist()), 100] for s in sources}
    results = []
    for _ in range(2):
        merge, taken = EventMerge(sources), []
        for source in sources:  # heard of before, so that each is waited for
            merge.add(source, -1, "", 0)
        waiting = {source: list(stamps) for source, stamps in times.items()}
        while any(waiting.values()):
            source = random.choice([s for s in sources if waiting[s]])
            stamp_ns = waiting[source].pop(0)
            merge.add(source, stamp_ns, stamp_ns, 0)
            taken += merge.take(0, WAIT, SILENCE)
        results.append([(group.stamp_ns, list(group.parts.items())) for group in taken])
    assert results[0] == results[1]
    assert [stamp_ns for stamp_ns, _ in results[0]] == sorted({-1}.union(*times.values()))
