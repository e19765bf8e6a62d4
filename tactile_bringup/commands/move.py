"""`tactile move`: takes one arm of a scene to a pose through the air, slowly and within its bounds."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base.console import lasting_console
from tactile_base.whole_file import check_folder
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import EXIT_CODES, add_rehearse_option, graph_options, launch_graph
from tactile_bringup.graph import Graph, build_graph
from tactile_bringup.run_sequence import ArmPlan, check_places
from tactile_bringup.staged_arm import arm_of
from tactile_control.task_file import NamedGoal, Role
from tactile_control.tasks.move import MoveGoal, MoveTaskSettings
from tactile_doubles.rehearsal import rehearsed
from tactile_geometry import se3
from tactile_scene.scene import ArmScene
from tactile_scene.scene_file import load_scene

TASK = "move"
SPEED = 0.02  # m/s
LONGEST = 600.0  # s; a move that gets nowhere ends long before


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, TASK, run, __doc__, epilog=EXIT_CODES)
    add = parser.add_argument
    add("--scene", required=True, metavar="NAME", help="scene, or a scene file")
    add("--arm", metavar="NAME", help="which of its arms (default: the only one)")
    where = parser.add_mutually_exclusive_group(required=True)
    text = "x y z (m) of its controlled frame in its base, and its rotation about fixed x y z (deg; as it is)"
    where.add_argument("--to", nargs="+", type=float, metavar="N", help=text)
    where.add_argument("--start", action="store_true", help="to where it starts in the scene")
    add("--speed", type=float, default=SPEED, metavar="M/S", help=f"at most (default: {SPEED:g})")
    add_rehearse_option(parser)
    add("--headless", action="store_true", help="plain lines in place of the live display")
    add("--out", type=Path, default=Path("out/runs"), metavar="FOLDER", help="where the run's folder goes")


def run(arguments: argparse.Namespace) -> int:
    from tactile_bringup.launching.launcher import Manner

    graph = make_graph(arguments)
    folder = arguments.out / f"{time.strftime('%Y%m%d-%H%M%S')}-{TASK}"
    check_folder(folder)
    return launch_graph(graph, folder, lasting_console(), Manner(TASK, arguments.headless)).exit_code


def make_graph(arguments: argparse.Namespace) -> Graph:
    """Check what can be checked before anything moves.

    Raises `SettingError`, `ValueError` or `OSError` with what is wrong and what would be right.
    """
    scene = load_scene(arguments.scene)
    scene = rehearsed(scene) if arguments.rehearse else scene
    arm = arm_of(scene, arguments.arm)
    if not 0.0 < arguments.speed <= arm.limits.linear_velocity:
        raise ValueError(f"--speed {arguments.speed:g}: must lie in (0, {arm.limits.linear_velocity:g}] m/s")
    goal = NamedGoal("pose", chosen_goal(arguments, arm))
    check_places(goal, arm)
    settings = MoveTaskSettings().replaced(travel__speed=arguments.speed, travel__timeout=LONGEST)
    plan = ArmPlan(arm.name, Role("mover", TASK, settings, (goal,)), (goal,))
    return build_graph(TASK, scene, [plan], graph_options(arguments))


def chosen_goal(arguments: argparse.Namespace, arm: ArmScene) -> MoveGoal:
    """Where to; `ValueError` for what is no pose, or one that known joints do not reach."""
    if arguments.start:
        numbers = se3.euler_from_pose(arm.T_base_start)
        numbers[3:] = np.degrees(numbers[3:])
    else:
        numbers = np.array(arguments.to)
    if len(numbers) not in (3, 6):
        raise ValueError(f"--to: must be 3 or 6 numbers, these are {len(numbers)}")
    goal = MoveGoal(tuple(numbers[:3].tolist()), tuple(numbers[3:].tolist()))
    if (
        arm.kinematics is not None
    ):  # without a rotation it keeps that which it has, in its cell that of its start
        arm.kinematics.reach(goal.pose_from(arm.T_base_start), arm.kinematics.ready)
    return goal
