"""What `tactile status` says of a task, in words."""

import math
from types import SimpleNamespace

import pytest

from tactile_bringup.commands.operate import _task


@pytest.mark.parametrize(
    "progress, words", [(0.4, "t 'all', track, 40 %: why"), (math.nan, "t 'all', track: why")]
)
def test_no_part_is_told_of_a_goal_that_goes_on_until_it_is_asked_to_end(progress, words):
    status = SimpleNamespace(task="t", goal_name="all", phase="track", progress=progress, reason="why")
    assert _task(status) == words
