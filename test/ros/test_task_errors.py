"""What a client of the action reads of a task that raises, or never ends: the reason with its place."""

import math

from other_package import ERRORS, installed
from test_controller_node import CONTROLLER, FAST, World


def controller(graph, folder, task):
    """The world of a controller that runs this task, of another package."""
    (folder / "site").mkdir()
    graph.import_from(installed(folder / "site", ERRORS))
    graph.start(CONTROLLER, {**FAST, "task_name": task})
    world = World(graph)
    assert graph.wait(lambda: bool(world.twists) and bool(world.statuses))
    return world


def test_an_exception_in_a_task_is_in_result_and_status_with_its_line_and_its_traceback_in_the_log(
    graph, tmp_path
):
    world = controller(graph, tmp_path, "rubbing")
    result = world.result(world.send(task="rubbing"))
    words = "task 'rubbing': LinAlgError in phase follow: Singular matrix ("
    assert result.reason.startswith(words) and "my_errors.py:" in result.reason
    assert world.statuses[-1].reason == result.reason
    assert "Traceback" in (log := graph.log(CONTROLLER).read_text()) and "np.linalg.inv" in log


def test_a_task_that_cannot_be_made_is_a_refused_goal_and_the_node_goes_on(graph, tmp_path):
    world = controller(graph, tmp_path, "refusing")
    for _ in range(2):
        reason = world.refusal(task="refusing")
        assert "task 'refusing': KeyError: 'speed' (" in reason and "my_errors.py:" in reason


def test_a_task_without_a_step_to_give_fails_and_the_node_goes_on(graph, tmp_path):
    world = controller(graph, tmp_path, "silent")
    for _ in range(2):
        result = world.result(world.send(task="silent"))
        assert "task 'silent': step gives a NoneType, must be a Command (" in result.reason
    assert world.rests()


def test_nobody_says_how_much_is_done_of_a_goal_that_does_not_end_by_itself(graph):
    graph.start(CONTROLLER, {**FAST, "task_name": "object_tracking"})
    world = World(graph)
    assert graph.wait(lambda: bool(world.twists) and bool(world.statuses))
    handle = world.send(task="object_tracking", goal="{}")
    assert world.run_until(lambda: world.phase() == "track")
    assert math.isnan(world.statuses[-1].progress)
    cancelled = handle.cancel_goal_async()
    assert world.run_until(cancelled.done) and world.run_until(lambda: world.phase() == "done")
    assert world.statuses[-1].progress == 1.0
