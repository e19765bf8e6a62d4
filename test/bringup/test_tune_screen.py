"""The table of `tactile tune` in a terminal of 80 x 24: what keys do, what is shown, what strangers write."""

import io

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from tactile_bringup.tune_screen import Line, TuneScreen, keys_of
from tactile_bringup.tuning import RuntimeSetting, Tuning

NODES = ("/arm/controller", "/arm/filter")
ABOUT, SAID = 16, 21  # lines of the screen: what is known of the chosen setting, and the last message


class Desk:
    """A screen whose nodes take all but 9, and answer at once."""

    def __init__(self, **options) -> None:
        self.tuning = Tuning()
        for node in NODES:
            values = {f"task.number_{k}": 0.1 * k for k in range(12)} | {"pid.kp": (1.0,) * 6, "name": "left"}
            found = [RuntimeSetting(node, n, v, v, "what it means", "in [0, 5] m") for n, v in values.items()]
            found.append(RuntimeSetting(node, "scene", "ramp", "ramp", fixed=True))
            self.tuning.found(node, found)
        self.screen = TuneScreen(self.tuning, self.answer, "tune", **options)

    def answer(self, request) -> None:
        refused = {key for key, value in request.changes.items() if value == 9}
        taken = set(request.changes) if not refused else set()
        self.screen.finished(request, taken, ["it refuses 9"] if refused else [])

    def __call__(self, typed: str) -> list[str]:
        """The lines that are shown once that was typed."""
        for key in keys_of(typed):
            self.screen.press(key)
        file = io.StringIO()
        console = Console(file=file, width=80, height=24, color_system=None, legacy_windows=False)
        console.print(self.screen)
        lines = file.getvalue().splitlines()
        assert len(lines) == 24 and all(len(line) <= 80 for line in lines)
        return lines

    def chosen(self) -> str:
        return self("")[ABOUT].split(" = ")[0]


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_settings_stand_below_their_node_with_both_values_and_range(desk):
    lines = desk("")
    assert "28 settings of 2 nodes, set A" in lines[0] and lines[2].startswith("/arm/controller")
    assert lines[3].split() == ["task.number_0", "0.0", "0.0", "in", "[0,", "5]", "m"]
    assert (
        lines[ABOUT].startswith("task.number_0 = 0.0; changes at once")
        and "what it means" in lines[ABOUT + 1]
    )


def test_a_typed_value_is_in_force_and_a_refused_one_is_not(desk):
    lines = desk("\r\x150.25\r")
    assert lines[3].split()[:3] == ["task.number_0", "0.25", "0.0"] and "number_0 = 0.25" in lines[SAID]
    lines = desk("\r\x159\r")
    assert "it refuses 9" in lines[SAID] and lines[3].split()[1] == "0.25"
    assert "not valid YAML" in desk("\r\x15[1, 2\r")[SAID]
    desk("\r\x1b")
    assert desk.tuning.now["/arm/controller", "task.number_0"] == 0.25
    assert desk("u")[3].split()[1] == "0.0" and "nothing to undo" in desk("u")[SAID]
    assert desk("r")[3].split()[1] == "0.25"


def test_keys_choose_and_the_chosen_one_stays_in_view(desk):
    desk("\x1b[B\x1b[B")
    assert desk.chosen() == "task.number_10"  # by name
    desk("\x1b[6~")
    assert desk.screen._chosen == ("/arm/filter", "task.number_10")  # a page of 14 on
    desk("\x1b[F")
    assert desk.chosen() == "name"
    for key in ["\x1b[A"] * 40:
        assert any(desk.chosen() in line for line in desk(key)[2:ABOUT])
    assert desk.chosen() == "task.number_0"
    desk("\t\r\x150.25\r")
    assert desk.tuning.now["/arm/filter", "task.number_0"] == 0.25


def test_what_cannot_change_is_shown_when_asked_for_and_says_so(desk):
    assert not any("scene" in line for line in desk(""))
    desk("f/controller scene\r")
    assert desk.chosen() == "scene" and "cannot change while its node runs" in desk("")[ABOUT]
    assert "cannot change while /arm/controller runs" in desk("\r")[SAID]


def test_what_is_looked_for_is_shown_alone(desk):
    assert "2 settings of 2 nodes" in desk("/pid\r")[0] and "28 settings" in desk("/\r")[0]
    assert "0 settings" in desk("/nowhere\r")[0]
    assert "6 settings of 2 nodes" in Desk(find="number_1")("")[0]  # 1, 10 and 11


def test_sets_differences_and_files(desk, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    desk("s\r\x150.25\rs")
    assert "set A" in desk("")[0] and desk("")[3].split()[1] == "0.0"
    desk("s")
    assert "/arm/controller task.number_0: 0.0 -> 0.25" in desk("d")[2].rstrip()
    assert "(any key: back)" in "".join(desk("xw\r"))
    assert (tmp_path / "out/tune/parameters.yaml").is_file() and desk.screen.written
    assert "escape: leave it" in "".join(desk("x?"))
    desk("xq")
    assert desk.screen.ended


def test_a_line_is_edited_as_in_a_shell():
    line = Line("x:", "0.1", lambda text: None)
    for key in keys_of("2\x01-\x1b[C\x1b[3~\x05\x7f"):
        line.press(key)
    assert line.text == "-01"
    for key in keys_of("\x15" + "a" * 100):
        line.press(key)
    assert len(line.shown(80).plain) == 80 and line.shown(80).plain.endswith("a ")


def test_keys_are_told_apart():
    assert list(keys_of("a\x1b[A\x1bOBé\x1b[6~\x1b\x02")) == ["a", "up", "down", "é", "page down", "escape"]


def test_what_strangers_write_is_no_command_to_the_terminal():
    desk = Desk()
    evil = RuntimeSetting("/evil\x1b[2J", "na\x1b]0;title\x07me", "\x1b[31m[bold]", "", "do\x1bc", "in\x9b1m")
    desk.tuning.found("/evil\x1b[2J", [evil])
    shown = "\n".join(desk("/evil\r"))
    assert not set(shown) & {"\x1b", "\x07", "\x9b"} and "[bold]" in shown


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.sampled_from([*"abdfjkrsu/?9\r\t\x7f\x15", "\x1b", "\x1b[A", "\x1b[B", "\x1b[6~", "\x1b[D"]))
)
def test_no_keys_break_it(keys):
    desk = Desk()
    desk("".join(keys))
    desk.tuning.gone(NODES[0])
    desk("".join(keys))
    desk.tuning.gone(NODES[1])
    desk("".join(keys))
