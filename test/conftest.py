"""What holds for all tests.

Property tests draw the same examples in every run; `--hypothesis-profile=explore` draws new ones.

Tests with real nodes in processes of their own depend on the load of the machine: discovery and deadlines are
in real time. One that fails is tried twice more, and the summary shows it (R).
"""

from pathlib import Path

import pytest
from hypothesis import settings

REAL_TIME = ("nodes", "system", "bringup")

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile("same")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if item.path.is_relative_to(here) and item.path.relative_to(here).parts[0] in REAL_TIME:
            item.add_marker(pytest.mark.flaky(reruns=2, reruns_delay=1))
