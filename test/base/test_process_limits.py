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
    monkeypatch.setattr(process_limits, "_STARTED", before)
    monkeypatch.setattr(process_limits, "core_times", lambda: after)
    words = process_limits.overload()
    assert bool(words) == bool(said)
    assert f"in use for {said} of the time" in words or not said


def test_a_machine_that_does_not_tell_is_not_overloaded(tmp_path):
    assert process_limits.core_times(tmp_path / "none") == (0.0, 0.0)
    (tmp_path / "other").write_text("what is this?")
    assert process_limits.core_times(tmp_path / "other") == (0.0, 0.0)
    idle, total = process_limits.core_times()
    assert 0.0 < idle < total
