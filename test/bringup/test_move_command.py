"""`tactile move` refuses what an arm may not do before anything starts."""

import pytest

from tactile_bringup.cli import main
from tactile_bringup.commands import move

SCENE = """
arms:
  arm:
    base: {position: [0.1, 0.0, 0.0]}
    start: {position: [0.4, 0.0, 0.3], rotation_deg: [180, 0, 0]}
    limits: {linear_velocity: 0.05}
    safety: {workspace_lower: [0.2, -0.3, 0.05], workspace_upper: [0.6, 0.3, 0.5]}
    keep_out: {vice: {lower: [0.4, 0.1, 0.0], upper: [0.5, 0.2, 0.2]}}
    sensor: {}
    MORE
simulation: {sensors: {arm: {fidelity: ideal}}}
"""
KNOWN = "kinematics: {description: ur5e, tool: {position: [0.0, 0.0, 0.3]}}"


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """Runs the command; the graphs that it would have launched."""
    graphs = []

    def launched(graph, *rest):
        graphs.append(graph)
        return type("Outcome", (), {"exit_code": 0})

    monkeypatch.setattr(move, "launch_graph", launched)

    def ask(*words: str, more: str = "", scene: str = SCENE) -> tuple[int, list]:
        (tmp_path / "cell.yaml").write_text(scene.replace("MORE", more))
        return main(["move", "--scene", str(tmp_path / "cell.yaml"), "--out", str(tmp_path), *words]), graphs

    return ask


@pytest.mark.parametrize(
    ("words", "more", "complaint"),
    [
        ("--to 0.3 0 0.04", "", "(0.3, 0, 0.04) m is outside the workspace of 'arm'"),
        ("--to 0.45 0.15 0.1", "", "(0.45, 0.15, 0.1) m is in 'vice', which 'arm' is kept out of"),
        ("--to 0.45 0.085 0.1", "", "or too near"),
        ("--to 0.3 0 0.2 --speed 0.06", "", "--speed 0.06: must lie in (0, 0.05] m/s"),
        ("--to 0.3 0 0.2 --speed 0", "", "--speed 0: must lie in"),
        ("--to 0.3 0", "", "--to: must be 3 or 6 numbers, these are 2"),
        ("--to nan 0 0.2", "", "position[0]: is not a number"),
        ("--to 0.3 0 0.2 --arm left", "", "--arm must name an arm; unknown name 'left'; valid: arm"),
        ("--to 0.6 0 0.3 0 -90 0", KNOWN, "out of reach of the ur5e"),
        ("--to 1.5 0 0.3", KNOWN, "out of reach of the ur5e"),
    ],
)
def test_a_pose_out_of_bounds_is_refused_before_anything_starts(asked, capsys, words, more, complaint):
    code, graphs = asked(*words.split(), more=more)
    assert code == 2 and not graphs
    assert complaint in " ".join(capsys.readouterr().err.split())


def test_to_the_start_of_the_scene(asked):
    code, (graph,) = asked("--start", "--speed", "0.03")
    goal = graph.plans[0].goals[0]
    assert code == 0 and goal.start is None
    assert goal.goal.position == pytest.approx((0.3, 0.0, 0.3))
    assert [abs(angle) for angle in goal.goal.rotation_deg] == pytest.approx([180.0, 0.0, 0.0])
    given = graph.node("/arm/controller").parameters
    assert (given["task_name"], given["travel.speed"]) == ("move", 0.03)


def test_a_goal_of_a_task_file_is_checked_as_well(tmp_path, capsys):
    (tmp_path / "cell.yaml").write_text(SCENE.replace("MORE", ""))
    (tmp_path / "away.yaml").write_text(
        "roles: {mover: {task: move}}\n"
        "scenes: {cell: {mover: {goals: [{name: up, position: [0.3, 0, 0.6]}]}}}\n"
    )
    assert main(["launch", str(tmp_path / "away.yaml"), "--scene", str(tmp_path / "cell.yaml")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "goal 'up': (0.3, 0, 0.6) m is outside the workspace of 'arm'" in said
