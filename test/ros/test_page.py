"""The page beside a running graph, in a real browser: a setting changes in the node, a refused one says why, and
the button stops the arm.
"""

import pytest
from browser import Viewer, chromium
from ramp_cell import Cell

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.fixture(scope="module")
def cell(shared_graph, tmp_path_factory):
    return Cell(shared_graph, tmp_path_factory.mktemp("cell"), length=0.12)


@pytest.fixture(scope="module")
def viewer(cell, tmp_path_factory):
    with chromium() as browser:
        viewer = Viewer(browser, tmp_path_factory.mktemp("viewed"), "--port", "0", **cell.graph.variables)
        yield viewer
        viewer.close()
