"""The source tree, which is what these tests look at."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def root() -> Path:
    """Folder of the clone."""
    return Path(__file__).parents[2]
