"""What holds for all tests.

Property tests draw the same examples in every run; `--hypothesis-profile=explore` draws new ones, `=few` the
first ten.
"""

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))  # tests import `launched`, `ur_cell`

if "ROS_DOMAIN_ID" in os.environ:  # one for each process that runs tests beside others
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    os.environ["ROS_DOMAIN_ID"] = str((int(os.environ["ROS_DOMAIN_ID"]) + 25 * worker - 1) % 100 + 1)

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.register_profile("few", derandomize=True, deadline=None, max_examples=10)
settings.load_profile("same")

HERE = Path(__file__).parent
WHOLE_TASKS = "whole tasks"
LONGEST = (WHOLE_TASKS, "test_fuzz")  # what begins last ends last


def share(item: pytest.Item) -> str:
    """What one of several processes runs (`--dist loadgroup`): a file, whose tests share what they start.

    Whole tasks on nodes want a core: one at a time.
    """
    whole_task = HERE / "system" in item.path.parents and item.get_closest_marker("ros")
    return WHOLE_TASKS if whole_task else item.path.stem


@pytest.hookimpl(tryfirst=True)  # before xdist looks for groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what needs ROS 2, what runs against the clock, and who runs what; drop what nobody asked for."""
    for item in items:
        if HERE / "ros" in item.path.parents:
            item.add_marker(pytest.mark.ros)
        if item.get_closest_marker("ros"):
            item.add_marker(pytest.mark.live)
        item.add_marker(pytest.mark.xdist_group(share(item)))
    items.sort(key=lambda item: share(item) not in LONGEST)
    if "asked" not in config.option.markexpr:
        left_out = [item for item in items if item.get_closest_marker("asked")]
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)
