"""Events come in the order of their stamps whatever order their messages arrive in."""

import itertools

from tactile_filter.events import EventJoin, measurement_join


def drain(join: EventJoin) -> list[int]:
    stamps = []
    while join.ready() is not None:
        stamps.append(join.pop().stamp_ns)
    return stamps


def interleavings(a: list, b: list):
    """All ways to merge two sequences that each keep their order."""
    for positions in itertools.combinations(range(len(a) + len(b)), len(a)):
        merged = [None] * (len(a) + len(b))
        rest = iter(b)
        first = iter(a)
        yield [next(first) if i in positions else next(rest) for i in range(len(merged))]


def test_events_come_out_once_each_in_the_order_of_stamps_for_every_order_of_arrival():
    for arrivals in interleavings([("a", s) for s in (1, 2, 3)], [("b", s) for s in (1, 2, 3)]):
        join, out = EventJoin(("a", "b")), []
        for source, stamp in arrivals:
            assert join.add(source, stamp, None, 0)
            out += drain(join)
        assert out == [1, 2, 3] and join.dropped == join.late == 0


def test_what_is_handed_out_does_not_depend_on_arrival_when_a_source_skips_a_stamp():
    for arrivals in interleavings([("a", s) for s in (1, 2, 3)], [("b", s) for s in (1, 3)]):
        join, out = EventJoin(("a", "b")), []
        for source, stamp in arrivals:
            join.add(source, stamp, None, 0)
            out += drain(join)
        assert out == [1, 3] and join.dropped == 1


def test_an_event_waits_as_long_as_its_missing_source_may_still_deliver():
    join = EventJoin(("a", "b"))
    join.add("a", 2, "late or lost?", 0)
    join.add("b", 1, None, 0)
    assert join.ready() is None  # a has skipped 1, b may still bring 2
    assert join.dropped == 1 and join.oldest().stamp_ns == 2


def test_a_stamp_that_is_not_later_is_refused_and_counted():
    join = EventJoin(("a",))
    join.add("a", 5, None, 0)
    assert drain(join) == [5]
    assert not join.add("a", 5, None, 0) and not join.add("a", 4, None, 0)
    assert join.late == 2


def test_clearing_forgets_the_last_stamp_so_that_time_may_start_anew():
    join = EventJoin(("a",))
    join.add("a", 500, None, 0)
    drain(join)
    join.clear()
    assert join.add("a", 3, None, 0) and drain(join) == [3]


def test_an_estimate_or_a_presence_without_contact_makes_an_event():
    join, out = measurement_join(), []
    messages = ("presence", 1, False), ("estimate", 2, "a"), ("presence", 3, True), ("estimate", 4, "b")
    for source, stamp, content in (*messages, ("presence", 4, True)):
        join.add(source, stamp, (content, 0), 0)
        while (event := join.ready()) is not None:
            out.append((event.stamp_ns, sorted(join.pop().parts)))
    assert out == [(1, ["presence"]), (2, ["estimate"]), (4, ["estimate"])]
    assert join.dropped == 1  # the presence in contact whose estimate did not come
    assert join.late == 1  # the presence whose estimate came first
