"""Settings by hand: undone, done again, two sets, what others change, in whatever order it is heard."""

from types import SimpleNamespace

import pytest

from tactile_base.settings import SettingError
from tactile_bringup.tuning import OTHER_SET, RuntimeSetting, Tuning, runtime_setting

NODE = "/arm/controller"
DEPTH, KP, TASK = (NODE, "task.depth"), (NODE, "pid.kp"), (NODE, "task_name")


@pytest.fixture
def tuning() -> Tuning:
    tuning = Tuning()
    values = {"task.depth": 0.003, "pid.kp": (1.0, 2.0), "task_name": "pushing"}
    found = [
        RuntimeSetting(NODE, name, value, value, fixed=name == "task_name") for name, value in values.items()
    ]
    tuning.found(NODE, found)
    return tuning


def takes(tuning: Tuning, request, told_first: bool = False) -> None:
    """The node takes all of it, and tells of it before or after it answers."""
    if not told_first:
        tuning.finished(request, set(request.changes))
    for (node, name), value in request.changes.items():
        assert tuning.heard(node, name, list(value) if isinstance(value, tuple) else value) == ""
    if told_first:
        tuning.finished(request, set(request.changes))


@pytest.mark.parametrize("told_first", [False, True])
def test_undo_and_redo_go_back_and_forth(tuning, told_first):
    for value in (0.004, 0.005):
        takes(tuning, tuning.change({DEPTH: value}), told_first)
    for before in (0.004, 0.003):
        takes(tuning, tuning.undo(), told_first)
        assert tuning.now[DEPTH] == before
    with pytest.raises(SettingError, match="nothing to undo"):
        tuning.undo()
    takes(tuning, tuning.redo(), told_first)
    assert tuning.now[DEPTH] == 0.004
    takes(tuning, tuning.change({KP: (3.0, 4.0)}), told_first)
    with pytest.raises(SettingError, match="nothing to redo"):  # a new change ends what could be done again
        tuning.redo()


def test_a_refused_value_changes_nothing_and_what_was_done_can_still_be_undone(tuning):
    takes(tuning, tuning.change({DEPTH: 0.004}))
    tuning.finished(tuning.change({DEPTH: 9.0}), set())
    assert tuning.now[DEPTH] == 0.004
    tuning.finished(tuning.undo(), set())  # which the node refuses as well
    assert tuning.now[DEPTH] == 0.004
    takes(tuning, tuning.undo())
    assert tuning.now[DEPTH] == 0.003
    assert "by somebody else" in tuning.heard(*DEPTH, 9.0), "what was refused is no longer expected"


def test_what_somebody_else_changes_is_told_and_not_undone(tuning):
    takes(tuning, tuning.change({DEPTH: 0.004}))
    takes(tuning, tuning.change({KP: (3.0, 4.0)}))
    said = tuning.heard(*KP, [5.0, 6.0])
    assert said == f"{NODE} pid.kp = [5.0, 6.0] by somebody else, was [3.0, 4.0]"
    with pytest.raises(SettingError, match=r"no undo of .* it is \[5.0, 6.0\] by somebody else"):
        tuning.undo()
    takes(tuning, tuning.undo())  # what was before that is still ours
    assert tuning.now[DEPTH] == 0.003 and tuning.now[KP] == (5.0, 6.0)


def test_a_change_of_somebody_else_while_ours_is_asked_for_is_what_it_is_undone_to(tuning):
    request = tuning.change({DEPTH: 0.005})
    assert "by somebody else" in tuning.heard(*DEPTH, 0.004)
    takes(tuning, request, told_first=True)
    takes(tuning, tuning.undo())
    assert tuning.now[DEPTH] == 0.004


def test_one_that_comes_after_ours_and_before_our_answer_stays_known(tuning):
    request = tuning.change({DEPTH: 0.005})
    assert tuning.heard(*DEPTH, 0.005) == ""
    assert "by somebody else" in tuning.heard(*DEPTH, 0.006)
    tuning.finished(request, {DEPTH})
    assert tuning.now[DEPTH] == 0.006


def test_values_that_follow_fast_are_ours_although_the_last_alone_is_told(tuning):
    first, second = tuning.change({DEPTH: 0.004}), tuning.change({DEPTH: 0.005})
    assert tuning.heard(*DEPTH, 0.005) == ""
    tuning.finished(first, {DEPTH})
    with pytest.raises(SettingError, match="still being asked for"):
        tuning.undo()
    tuning.finished(second, {DEPTH})
    assert tuning.now[DEPTH] == 0.005
    takes(tuning, tuning.undo())
    takes(tuning, tuning.undo())
    assert tuning.now[DEPTH] == 0.003


def test_two_sets_are_kept_apart_and_undone_as_a_whole(tuning):
    request = tuning.other_set()
    assert request.changes == {}  # B begins with what is in force
    takes(tuning, request)
    assert tuning.chosen == "B"
    takes(tuning, tuning.change({DEPTH: 0.002}))
    takes(tuning, tuning.change({KP: (3.0, 4.0)}))
    request = tuning.other_set()
    assert request.changes == {DEPTH: 0.003, KP: (1.0, 2.0)} and request.way == OTHER_SET
    takes(tuning, request)
    assert tuning.chosen == "A"
    takes(tuning, tuning.undo())
    assert tuning.now[DEPTH] == 0.002 and tuning.now[KP] == (3.0, 4.0)


def test_a_set_that_is_refused_is_not_chosen(tuning):
    takes(tuning, tuning.other_set())
    takes(tuning, tuning.change({DEPTH: 0.002}))
    tuning.finished(tuning.other_set(), set())
    assert tuning.chosen == "B" and tuning.now[DEPTH] == 0.002


def test_what_somebody_else_changes_is_of_both_sets(tuning):
    takes(tuning, tuning.other_set())
    tuning.heard(*KP, [7.0, 8.0])
    assert tuning.other_set().changes == {}


def test_what_differs_is_told_against_what_the_node_was_started_with(tuning):
    assert tuning.different() == {}
    tuning.found(NODE, [RuntimeSetting(NODE, "task.depth", 0.004, 0.003)])
    assert tuning.different() == {DEPTH: (0.003, 0.004)}


def test_what_cannot_change_is_not_asked_for(tuning):
    with pytest.raises(SettingError, match=f"task_name: cannot change while {NODE} runs"):
        tuning.change({TASK: "move"})


def test_a_node_that_is_gone_takes_its_settings_along(tuning):
    takes(tuning, tuning.change({DEPTH: 0.004}))
    tuning.gone(NODE)
    assert not tuning.settings and not tuning.nodes and tuning.heard(*DEPTH, 0.004) == ""
    with pytest.raises(SettingError, match="its node is gone"):
        tuning.undo()


def descriptor(description: str, constraints: str = "", *ranges: tuple[float, float]) -> SimpleNamespace:
    """As of any node, ours or not."""
    return SimpleNamespace(
        description=description,
        additional_constraints=constraints,
        floating_point_range=[SimpleNamespace(from_value=low, to_value=high) for low, high in ranges],
        integer_range=[],
        read_only=False,
    )


def test_a_setting_is_read_from_its_descriptor():
    about = descriptor("how deep; in [0, 0.01] m; started with 0.003", "in [0, 0.01] m", (0.0, 0.01))
    setting = runtime_setting(NODE, "task.depth", 0.004, about)
    assert (setting.start, setting.lower, setting.upper, setting.group) == (0.003, 0.0, 0.01, "task")
    assert setting.doc == "how deep; in [0, 0.01] m"
    mode = runtime_setting(NODE, "mode", "fast", descriptor("one; started with ''", "one of fast, exact"))
    assert mode.choices == ("fast", "exact") and mode.start == ""


def test_a_node_of_somebody_else_has_settings_as_well():
    setting = runtime_setting("/other", "gain", [1.0, 2.0], descriptor("", "", (0.0, 5.0)))
    assert setting.start == (1.0, 2.0) and setting.bounds == "in [0, 5]" and setting.doc == ""
    assert runtime_setting("/other", "use_sim_time", False, descriptor("")).fixed


def test_what_was_typed_is_read_as_the_setting_is():
    number, text = (RuntimeSetting(NODE, "x", value, value) for value in (1.0, "1"))
    assert (
        number.parsed("1e-3") == 1e-3 and number.parsed("[1, 2]") == (1, 2) and text.parsed("1e-3") == "1e-3"
    )
    with pytest.raises(SettingError, match="x: not valid YAML"):
        number.parsed("[1, 2")
