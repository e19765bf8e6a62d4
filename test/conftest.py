"""What holds for all tests.

Property tests draw the same examples in every run; `--hypothesis-profile=explore` draws new ones, `=few` the
first ten.
"""

import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

os.environ.pop("ROS_DOMAIN_ID", None)  # each launch chooses one where nobody is, no arm of the user's either

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.register_profile("few", derandomize=True, deadline=None, max_examples=10)
settings.load_profile("same")

HERE = Path(__file__).parent


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what needs ROS 2, what runs against the clock; the longest first; drop what nobody asked for."""
    for item in items:
        if HERE / "ros" in item.path.parents:
            item.add_marker(pytest.mark.ros)
        if item.get_closest_marker("ros"):
            item.add_marker(pytest.mark.live)
    items.sort(key=lambda item: item.path.stem != "test_fuzz" and HERE / "system" not in item.path.parents)
    if "asked" not in config.option.markexpr:
        left_out = [item for item in items if item.get_closest_marker("asked")]
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)


@pytest.hookimpl(optionalhook=True)  # pytest-xdist's
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Go on after a process that died."""
    if config.option.dist != "loadfile":
        return None
    from by_file import ByFile  # where pytest-xdist is not, the rest works

    return ByFile(config, log)
