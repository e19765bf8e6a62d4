"""What stands in the scene for what is known of a cell."""

import numpy as np
import pytest
import viser
from cell_messages import DEPTH, GOAL, SHEAR, messages, packed, sensor_pose, stamp

from tactile_base import topics
from tactile_bringup.launching.page_process import free_port
from tactile_scene.scene_file import load_scene
from tactile_view.cell_state import CellState
from tactile_view.cell_view import SHEAR_SCALE, CellView
from tactile_view.drawing import STALK, look_from, way_ahead
from tactile_view.words import state_in_words

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


@pytest.mark.parametrize("scene", ["ramp", "tracking_cube", "pushing", "dual_pushing", "two_arms"])
def test_no_stalk_stands_before_a_contact_when_a_page_is_opened(server, scene):
    tips = CellView(server, load_scene(scene)).tips(CellState())
    eye, middle = look_from(tips)
    np.testing.assert_allclose(middle, np.mean([T[:3, 3] for T in tips], axis=0), atol=1e-12)
    for T in tips:
        contact = T[:3, 3] + 0.02 * T[:3, 2]
        for other in tips:
            for away in np.linspace(0.03, STALK, 50):  # the nearest point of the line of sight
                point = other[:3, 3] - away * other[:3, 2]
                way = contact - eye
                part = np.clip((point - eye) @ way / (way @ way), 0.0, 1.0)
                assert np.linalg.norm(eye + part * way - point) > 0.02, "a stalk is 25 mm thick"


def test_points_that_the_tip_has_passed_are_not_gone_back_to():
    tip = sensor_pose(0.0)[:3, 3]
    told = tip + np.array([[-0.004, 0.0, 0.0], [0.001, 0.0, 0.0], [0.006, 0.0, 0.0], [0.011, 0.002, 0.0]])
    np.testing.assert_array_equal(way_ahead(tip, told), [tip, *told[1:]])
    np.testing.assert_array_equal(way_ahead(told[-1], told), [told[-1], told[-1]])
    np.testing.assert_array_equal(way_ahead(tip, told[2:]), [tip, *told[2:]])


def test_around_the_shear_is_what_friction_holds_of_a_simulated_skin_alone(server, state):
    ideal = load_scene("plane").with_fidelity(
        "ideal", shear_depths=(0.0, DEPTH), shear_limits=(0.0, 2e-3), turn_limits=(0.0, 0.1)
    )
    view = CellView(server, ideal)
    view.show(state)
    rim = node(server, "contact/friction")
    assert rim.visible
    np.testing.assert_allclose(np.linalg.norm(rim.points, axis=-1), SHEAR_SCALE * 2e-3, rtol=1e-6)
    np.testing.assert_array_equal(rim.points[..., 2], 0.0)
    start, end = node(server, "shear").points[0]
    assert np.linalg.norm(end - start) == pytest.approx(SHEAR_SCALE * SHEAR, rel=1e-4)
    arm = state.arms["arm"]
    assert "the skin slides is 2.00 mm, of the simulated one" in state_in_words(arm, view.skin("arm"))
    view.set_scene(load_scene("ur_example"))
    view.show(state)
    assert not node(server, "contact/friction").visible
    assert "the skin slides is not known" in state_in_words(arm, view.skin("arm"))
