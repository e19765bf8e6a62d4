"""What is said of a machine that has too much to do."""

import pytest

from tactile_base import process_limits

STAT = "cpu  {user} 0 0 {idle} 0 0 0 0 0 0\ncpu0 1 2 3 4 5 6 7 8 9 0\n"


def write(path, user, idle):
    path.write_text(STAT.format(user=user, idle=idle))
    return path


@pytest.mark.parametrize(("user", "idle", "said"), [(60, 40, ""), (94, 6, ""), (97, 3, "97%"), (0, 0, "")])
def test_a_machine_is_overloaded_where_its_cores_had_hardly_any_time_left(
    monkeypatch, tmp_path, user, idle, said
):
    times = process_limits.core_times
    before = times(write(tmp_path / "stat", 1000, 5000))
    after = times(write(tmp_path / "stat", 1000 + user, 5000 + idle))
    words = told(monkeypatch, [(0.0, before), (3.0, after)])
    assert bool(words) == bool(said)
    assert f"in use for {said} of 3 s lately" in words or not said


def told(monkeypatch, looks):
    """What is said after looks at the cores, each at a time (s), the last of them at the end."""
    at = iter(looks)
    now = [0.0, (0.0, 0.0)]

    def turn() -> None:
        now[:] = next(at)

    monkeypatch.setattr(process_limits.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(process_limits, "core_times", lambda: now[1])
    turn()
    watch = process_limits.CoreWatch()
    for _ in looks[2:]:
        turn()
        watch.look()
    turn()
    return watch.overload()


def busy(seconds, idle_until, idle_from):
    """Looks at the cores of a machine that has nothing to do until one time (s) and from another on."""
    looks, idle = [], 0.0
    for step in range(round(seconds / 0.5) + 1):
        at = 0.5 * step
        looks.append((at, (idle, at)))
        idle += 0.5 if at < idle_until or at >= idle_from else 0.0
    return looks


@pytest.mark.parametrize(
    ("idle_until", "idle_from", "said"),
    [(56.0, 58.5, True), (57.0, 58.0, False), (10.0, 50.0, False), (57.5, 60.0, True)],
)
def test_an_overload_of_two_seconds_before_the_end_of_a_minute_is_told_and_an_old_one_is_not(
    monkeypatch, idle_until, idle_from, said
):
    assert bool(told(monkeypatch, busy(60.0, idle_until, idle_from))) == said


def test_a_machine_that_does_not_tell_is_not_overloaded(tmp_path):
    assert process_limits.core_times(tmp_path / "none") == (0.0, 0.0)
    (tmp_path / "other").write_text("what is this?")
    assert process_limits.core_times(tmp_path / "other") == (0.0, 0.0)
    idle, total = process_limits.core_times()
    assert 0.0 < idle < total
