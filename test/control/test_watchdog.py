"""The watchdog ramps to rest and says which input, how old, and the limit."""

import pytest

from tactile_control.watchdog import Watchdog, WatchdogSettings

MS = 1_000_000
FRESH = {"belief": 0, "presence": 0, "pose": 0}


def test_fresh_inputs_pass():
    state = Watchdog(WatchdogSettings()).step(90 * MS, FRESH)
    assert state.ok and state.scale == 1.0


def test_a_silent_input_is_at_rest_within_200_ms_of_its_last_stamp():
    watchdog = Watchdog(WatchdogSettings())
    scales = [watchdog.step(t * MS, {"belief": 0, "pose": t * MS}).scale for t in range(0, 201, 5)]
    assert scales[0] == 1.0 and scales[-1] == 0.0
    assert scales == sorted(scales, reverse=True)


def test_the_reason_names_input_age_and_limit():
    state = Watchdog(WatchdogSettings()).step(130 * MS, {"belief": 0, "pose": 120 * MS})
    assert state.reason == "belief is 130 ms old, limit 100 ms"


def test_all_silent_inputs_are_named():
    state = Watchdog(WatchdogSettings()).step(130 * MS, {"belief": 0, "pose": None})
    assert "belief is 130 ms old" in state.reason and "no pose has arrived" in state.reason


def test_it_recovers_when_inputs_come_back():
    watchdog = Watchdog(WatchdogSettings(ramp_time=0.08))
    assert not watchdog.step(130 * MS, {"belief": 0}).ok
    assert watchdog.step(140 * MS, {"belief": 135 * MS}).scale == 1.0
    assert watchdog.step(239 * MS, {"belief": 135 * MS}).scale == pytest.approx(0.95)  # the ramp starts anew
    assert watchdog.step(275 * MS, {"belief": 135 * MS}).scale == pytest.approx(0.5)


def test_one_who_was_held_up_while_an_input_grew_old_commands_rest_at_once_and_still_has_patience():
    watchdog = Watchdog(WatchdogSettings())
    assert watchdog.step(10 * MS, FRESH).ok
    state = watchdog.step(5000 * MS, FRESH)
    assert state.scale == 0.0 and not state.failed
    assert watchdog.step(5010 * MS, {"belief": 5005 * MS}).ok


def test_a_stamp_from_the_future_is_refused():
    state = Watchdog(WatchdogSettings()).step(0, {"belief": 3000 * MS})
    assert state.reason == "belief is stamped 3000 ms ahead of the clock"


def test_it_fails_only_when_its_patience_is_over():
    watchdog = Watchdog(WatchdogSettings(patience=0.5))
    states = {t: watchdog.step(t * MS, {"belief": 0}) for t in range(0, 800, 10)}
    first = min(t for t, state in states.items() if state.failed)
    assert 600 <= first <= 620
    assert not states[400].failed and states[400].scale == 0.0


def test_without_patience_it_still_comes_to_rest_first():
    watchdog = Watchdog(WatchdogSettings(patience=0.0))
    assert not watchdog.step(110 * MS, {"belief": 0}).failed
    assert watchdog.step(200 * MS, {"belief": 0}).failed
