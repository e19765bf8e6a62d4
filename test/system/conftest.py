"""What tests of whole tasks share."""

import pytest
from branches import end_all


@pytest.fixture(scope="module", autouse=True)
def no_run_waits_for_ever():
    yield
    end_all()
