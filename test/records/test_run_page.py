"""The page of a run: one file, with everything in it, and nothing of a recording is taken for HTML."""

import re
from html.parser import HTMLParser

import pytest
from test_figures import made_up

from tactile_records.runs.page import is_met, write_report_page
from tactile_records.runs.record import Event, RunRecord
from tactile_records.runs.report import write_reports

HOSTILE = "<script>alert(1)</script> & \"'"
EMPTY = ("meta", "img", "br")


class Parsed(HTMLParser):
    """Tags that are open, what was seen, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.tags, self.sources, self.text = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.sources += [value for name, value in attributes if name in ("src", "href")]
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    record = made_up()
    record.scene = HOSTILE
    record.result = {"succeeded": False, "reason": HOSTILE, "complaints": [HOSTILE]}
    record.events = [Event(10**9 * k, "warning", f"{HOSTILE} {k}") for k in range(300)]
    record.settings = {"controller": {"pid.kp": [7.0] * 6, "task.speed": 0.01}, "estimator": {HOSTILE: 1}}
    record.origin = {"command": HOSTILE, "machine": "one"}
    values = write_reports({"arm": record}, folder)
    parsed = Parsed(write_report_page({"arm": record}, values, folder).read_text())
    return parsed, values["arm"]


def test_it_needs_no_other_file_and_no_script(page):
    parsed, _ = page
    assert not parsed.open and not {"script", "link", "iframe"} & set(parsed.tags)
    assert len(parsed.sources) == 4 and all(s.startswith("data:image/png;base64,") for s in parsed.sources)


def test_texts_are_shown_as_they_are(page):
    parsed, _ = page
    assert parsed.text.count(HOSTILE) >= 204  # of 300 events the last 200


def test_numbers_are_those_of_the_report(page):
    parsed, values = page
    assert f"{values['depth_rms_mm']:.3f} mm" in parsed.text
    assert re.search(rf"depth z\D*{values['contact']['z']['bias']:+.3f}".replace("+", r"\+"), parsed.text)


def test_only_settings_that_differ_are_named(page):
    parsed, _ = page
    assert "pid.kp" in parsed.text and "task.speed" not in parsed.text
    assert "The first 100 are left out: 100 warning" in parsed.text


def test_what_a_record_does_not_hold_is_said(tmp_path):
    record = RunRecord(task="surface_following")
    values = write_reports({"arm": record}, tmp_path)
    text = Parsed(write_report_page({"arm": record}, values, tmp_path).read_text()).text
    for said in ("Nobody knows the truth", "does not say what the nodes were given", "does not say by which"):
        assert said in text


@pytest.mark.parametrize(
    "value, wanted, met",
    [
        ("0.04 mm", "<= 0.3 mm", True), ("26 ms", "<= 25 ms", False), ("100.0 %", "100 %", True),
        ("99.9 %", "100 %", False), ("no", "no", True), ("yes", "no", False), ("unknown", "<= 1 mm", None),
        ("10.0 ms", "as set", None), ("5", "", None),
    ],
)  # fmt: skip
def test_a_value_is_held_against_what_is_wanted(value, wanted, met):
    assert is_met(value, wanted) is met
