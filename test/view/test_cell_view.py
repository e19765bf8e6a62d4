"""What stands in the scene for what is known of a cell."""

import numpy as np
import pytest
import viser
from cell_messages import GOAL, messages, packed, sensor_pose, stamp

from tactile_base import topics
from tactile_bringup.launching.page_process import free_port
from tactile_view.cell_state import CellState
from tactile_view.cell_view import CellView, way_ahead

SECONDS = 0.1


@pytest.fixture
def server():
    server = viser.ViserServer(host="127.0.0.1", port=free_port("127.0.0.1"), verbose=False)
    yield server
    server.stop()


@pytest.fixture
def state() -> CellState:
    state = CellState()
    for message in messages(SECONDS):
        state.take(*message)
    return state


def node(server, name: str):
    """A node of the scene, which viser finds by name only for itself."""
    return server.scene._handle_from_node_name[f"/arms/arm/{name}"]


def test_the_way_ahead_leads_from_the_tip_to_the_goal_until_the_task_has_none(server, state):
    view = CellView(server, None)
    view.show(state)
    line, goal = node(server, "ahead"), node(server, "goal")
    tip = state.arms["arm"].newest("pose")["T_base_sensor"][:3, 3]
    np.testing.assert_allclose(line.points, [[tip, GOAL]], atol=1e-6)
    np.testing.assert_allclose(goal.position, GOAL)
    assert line.visible and goal.visible
    state.take(
        "/arm/controller/path",
        topics.PATH.type,
        packed(topics.PATH.type, **stamp(state.now_ns)),
        state.now_ns,
    )
    view.show(state)
    assert not line.visible and not goal.visible


def test_points_that_the_tip_has_passed_are_not_gone_back_to():
    tip = sensor_pose(0.0)[:3, 3]
    told = tip + np.array([[-0.004, 0.0, 0.0], [0.001, 0.0, 0.0], [0.006, 0.0, 0.0], [0.011, 0.002, 0.0]])
    np.testing.assert_array_equal(way_ahead(tip, told), [tip, *told[1:]])
    np.testing.assert_array_equal(way_ahead(told[-1], told), [told[-1], told[-1]])
    np.testing.assert_array_equal(way_ahead(tip, told[2:]), [tip, *told[2:]])
