"""The table of topics and frames."""

from tactile_base import topics
from tactile_base.topics import QOS_KINDS, Topic

TABLE = [value for value in vars(topics).values() if isinstance(value, Topic)]


def test_each_topic_stands_in_the_table_once_with_who_publishes_it():
    assert len({topic.name for topic in TABLE}) == len(TABLE)
    for topic in TABLE:
        assert topic.publisher and topic.qos in QOS_KINDS
        assert topic.type.count("/") == 2 and topic.type.split("/")[1] in ("msg", "action")


def test_an_arm_is_found_in_the_name_of_its_topic():
    assert topics.BELIEF.of("left").name == "/left/contact/belief"
    assert topics.BELIEF.arm_of("/left/contact/belief") == "left"
    assert topics.BELIEF.arm_of("/left/contact/state") is None
    assert topics.BELIEF.arm_of("/contact/belief") is None
