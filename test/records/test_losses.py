"""What a recorder knows to have missed, from numbers and times alone."""

from collections import Counter

from tactile_base.stamps import SECOND_NS
from tactile_records.bags.contents import UNKNOWN, Bag, Gap
from tactile_records.bags.losses import CAUGHT_UP_NS, Losses

STEP = SECOND_NS // 60


def publish(losses: Losses, numbers, publisher: bytes = b"a", topic: str = "/t") -> list[Gap]:
    """A publisher's messages at 60 Hz; those that are not among the numbers did not come."""
    gaps = [losses.seen(topic, publisher, number, number * STEP) for number in numbers]
    return [gap for gap in gaps if gap is not None]


def test_numbers_that_are_missing_are_counted_with_the_messages_before_and_after_them():
    losses = Losses()
    gaps = publish(losses, [*range(5, 10), *range(13, 20), 21])
    assert gaps == [Gap("/t", 3, 9 * STEP, 13 * STEP), Gap("/t", 1, 19 * STEP, 21 * STEP)]
    assert losses.lost == {"/t": 4}


def test_each_publisher_of_a_topic_has_numbers_of_its_own():
    losses = Losses()
    assert publish(losses, range(1, 50)) == publish(losses, range(1000, 1050), b"b") == []
    assert publish(losses, [50]) == [] and len(publish(losses, [1051], b"b")) == 1


def test_what_the_middleware_alone_knows_to_be_lost_is_told_at_the_end():
    losses = Losses()
    publish(losses, [1, 2, 5])
    assert losses.last(Counter({"/t": 2}), 99 * STEP) == []
    assert losses.last(Counter({"/t": 5}), 99 * STEP) == [Gap("/t", 3, 5 * STEP, 99 * STEP)]


def test_a_publisher_that_is_not_heard_again_after_a_stop_may_have_sent_more():
    losses = Losses()
    publish(losses, range(1, 100), b"a", "/ended")
    publish(losses, range(1, 300), b"b", "/goes_on")
    publish(losses, range(1, 300, 60), b"c", "/rare")
    losses.held_up(100 * STEP, 200 * STEP)
    assert losses.last(Counter(), 300 * STEP) == [Gap("/ended", UNKNOWN, 99 * STEP, 200 * STEP)]


def test_a_publisher_that_is_there_long_after_a_stop_has_sent_nothing_more():
    losses = Losses()
    publish(losses, range(1, 100), b"there")
    publish(losses, range(1, 100), b"gone")
    losses.held_up(100 * STEP, 200 * STEP)
    assert losses.in_doubt(201 * STEP) == set()  # what was missed may still be on its way
    later = 200 * STEP + CAUGHT_UP_NS + 1
    assert losses.in_doubt(later) == {"/t"}
    losses.present("/t", {b"there", b"new"}, later)
    assert losses.last(Counter(), later) == [
        Gap("/t", UNKNOWN, 99 * STEP, 200 * STEP)
    ]  # of the one that is gone
    losses.present("/t", {b"gone"}, later)
    assert losses.in_doubt(later) == set() and losses.last(Counter(), later) == []


def test_a_message_that_was_long_on_its_way_shows_that_more_are():
    losses = Losses()
    publish(losses, range(1, 4))
    losses.delay("/t", SECOND_NS)
    assert losses.on_their_way(9 * STEP) == [Gap("/t", UNKNOWN, 3 * STEP, 9 * STEP)]
    losses.delay("/t", SECOND_NS // 10)
    assert losses.on_their_way(9 * STEP) == []


def test_a_bag_with_gaps_is_not_complete_and_says_what_it_lacks(tmp_path):
    bag = Bag(tmp_path, counts={"/t": 96, "/u": 5})
    assert bag.complete
    bag.gaps = [Gap("/t", 3, 10 * SECOND_NS, 11 * SECOND_NS), Gap("/t", 1, 12 * SECOND_NS, 13 * SECOND_NS)]
    bag.gaps.append(Gap("/u", UNKNOWN, 20 * SECOND_NS, 21 * SECOND_NS))
    assert not bag.complete and bag.lost == {"/t": 4, "/u": 0}
    lost, unknown = bag.problem.split("; ")
    between = "between 10.000 and 13.000 s (Unix time) (2 gaps)"
    assert lost == f"/t: 4 of 100 messages were published and not recorded, {between}"
    assert unknown.startswith("/u: what was published between 20.000 and 21.000 s (Unix time) may be missing")
