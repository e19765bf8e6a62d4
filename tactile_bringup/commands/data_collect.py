"""Press and shear an arm's tactile sensor against a flat surface, as the paper does, or against an edge.

An image and a label of each contact are kept. The same command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tactile_base.console import lasting_console, say
from tactile_base.settings import SettingError, unknown_name
from tactile_base.whole_file import check_folder
from tactile_base.yaml_file import name_and_value, read_yaml
from tactile_bringup.commands.changes import add_command, add_set_option, natural_int, positive_int
from tactile_bringup.commands.launch import EXIT_CODES, add_rehearse_option, graph_options
from tactile_bringup.graph import Graph, build_graph
from tactile_bringup.run_sequence import ArmPlan
from tactile_bringup.staged_arm import arm_of
from tactile_control.task_file import NamedGoal, Role
from tactile_doubles.rehearsal import rehearsed
from tactile_geometry import se3
from tactile_perception.datasets.dataset import DatasetError, open_folder
from tactile_perception.datasets.writer import IMAGE_KINDS, DatasetWriter
from tactile_records.collecting.geometry import contact_frame, edge_frame
from tactile_records.collecting.parameters import check_same_run
from tactile_records.collecting.sample_store import found_surface
from tactile_records.collecting.settings import TASK, CollectionGoal, DataCollectionSettings
from tactile_scene.sampling import ON_EDGES, VALIDATION_START
from tactile_scene.scene import ArmScene, BodyScene, Scene
from tactile_scene.scene_file import load_scene

if TYPE_CHECKING:
    from tactile_bringup.launching.launcher import Outcome


LOOK = 1.0  # s, between two looks whether there is enough
FLAT, EDGED = "plane", "box"
SHAPES = {FLAT: "flat surface", EDGED: "box with an edge"}


def register(commands: Any) -> None:
    help = "labelled images with an arm"
    parser = add_command(commands, "collect", run, __doc__, help=help, epilog=EXIT_CODES)
    add = parser.add_argument
    add("out", type=Path, help="data folder")
    add("--scene", default="plane", metavar="NAME", help="scene, or a scene file (plane)")
    add("--samples", type=positive_int, default=6000, metavar="N", help="samples in the folder (6000)")
    add("--seed", type=natural_int, default=0, help="of the poses (0)")
    add("--validation", action="store_true", help="other poses than the training data of the same seed")
    add("--arm", metavar="NAME", help="which arm (default: the one with a camera)")
    add("--surface", metavar="NAME", help="which surface (default: the only plane)")
    add_edge_option(parser)
    text = "find the surface first: 1 touch for its height, 3 and more for its tilt too (0)"
    add("--touch", type=natural_int, default=0, metavar="N", help=text)
    add("--images", default="both", help="keep processed images, raw ones, or both (both)")
    add("--config", type=Path, help="YAML file with sections of settings (docs/data.md)")
    add_set_option(parser, "one of them", "SECTION.NAME=VALUE")
    add("--rate", type=float, metavar="HZ", help="simulated exposures a second")
    add("--record", type=Path, metavar="BAG", help="write a bag (MCAP) to this new folder")
    add("--record-images", action="store_true", help="with images")
    add_rehearse_option(parser)
    add("--headless", action="store_true", help="plain lines in place of the live display")
    add("--logs", type=Path, default=Path("out/runs"), metavar="FOLDER", help="for logs")


def add_edge_option(parser: argparse.ArgumentParser) -> None:
    """--edge, of whatever makes contacts."""
    text = "press on an edge, that of a box (shape: box) nearest to the start, in place of a flat surface"
    parser.add_argument("--edge", action="store_true", help=text)


@dataclass(frozen=True)
class Plan:
    """What will be collected: the graph that does it, and how many samples are missing."""

    graph: Graph
    samples: int
    missing: int


def run(arguments: argparse.Namespace) -> int:
    console = lasting_console()
    status = collected(arguments, console)
    say(console, "\n".join(_contents(arguments.out)))
    return status


def collected(
    arguments: argparse.Namespace, console: Console, enough: Callable[[], bool] = lambda: False
) -> int:
    """Make the samples that are missing, or some of them until `enough` says so; returns the exit code."""
    plan = make_plan(arguments)
    say(console, f"{arguments.out}: {plan.missing} of {plan.samples} samples are missing")
    if not plan.missing or enough():
        return 0
    outcome, ended_by_us = _launch(plan, arguments, console, enough)
    if ended_by_us:
        return 0
    if outcome.exit_code:
        say(console, "the same command goes on from here")
    return outcome.exit_code


def _launch(
    plan: Plan, arguments: argparse.Namespace, console: Console, enough: Callable[[], bool]
) -> tuple[Outcome, bool]:
    """Run it; whether it was ended since there was enough."""
    from tactile_bringup.launching.launcher import Launcher, Manner
    from tactile_bringup.launching.progress import CollectionDisplay

    folder = arguments.logs / f"{time.strftime('%Y%m%d-%H%M%S')}-collect"
    live = console.is_terminal and not arguments.headless
    with CollectionDisplay(console, live, plan.samples) as display:
        launcher, over = Launcher(plan.graph, folder.absolute(), display, Manner("data collect")), Event()
        ended_by_us = Event()

        def watch() -> None:
            while not over.wait(LOOK):
                if enough():
                    ended_by_us.set()
                    launcher.end()
                    return

        watching = Thread(target=watch, daemon=True)
        watching.start()
        outcome = launcher.run()
        over.set()
        watching.join()
        return outcome, ended_by_us.is_set()


def _contents(folder: Path) -> list[str]:
    """What the folder holds now, and where touches have found the surface."""
    try:
        surface = found_surface(folder)
        return [*([surface[1]] if surface else []), *open_folder(folder).report.lines()]
    except DatasetError as error:
        return [str(error)]


def make_plan(arguments: argparse.Namespace) -> Plan:
    """Check everything that can be checked before a node is started.

    Raises `SettingError`, `ValueError` or `OSError` with what is wrong and what would be right.
    """
    check_folder(arguments.out)
    if arguments.images not in IMAGE_KINDS:
        raise ValueError(f"--images {arguments.images}: must be one of {', '.join(IMAGE_KINDS)}")
    if arguments.record is not None and arguments.record.exists():
        raise ValueError(f"--record {arguments.record}: exists already; remove it or record elsewhere")
    scene = load_scene(arguments.scene)
    scene = rehearsed(scene) if arguments.rehearse else scene
    arm = sensing_arm(scene, arguments.arm)
    surface = chosen_surface(scene, arm, arguments.surface, EDGED if arguments.edge else FLAT)
    first = defaults(arm, arguments.touch, arguments.edge)
    settings = chosen_settings(first, arguments.config, arguments.changes).replaced(
        data__folder=str(arguments.out.absolute()),
        data__images=arguments.images,
        data__frame=tuple(se3.euler_from_pose(frame_on(scene, surface, arm)).tolist()),
    )
    goal = CollectionGoal(
        samples=arguments.samples, seed=arguments.seed, first=VALIDATION_START if arguments.validation else 0
    )
    robot = arm.driver + " (double)" * arguments.rehearse
    same: dict[str, Any] = {"seed": goal.seed, "first": goal.first}
    same |= {"images": settings.data.images, "frame": settings.data.frame}
    kept = ("sampling", "preprocessing", *["edge"] * arguments.edge, *["force"] * settings.force.labelled)
    same |= {name: dataclasses.asdict(settings.group(name)) for name in kept}
    check_same_run(arguments.out, {"robot": robot, "scene": scene.name, "arm": arm.name, **same})
    with DatasetWriter(arguments.out, settings.preprocessing, arguments.images) as writer:
        missing = len(set(range(1, arguments.samples + 1)) - writer.done)
    goals = (NamedGoal(f"{missing} samples", goal),)
    plan = ArmPlan(arm.name, Role("collector", TASK, settings, goals), goals)
    graph = build_graph(TASK, scene, [plan], graph_options(arguments, changes=()))
    return Plan(graph, arguments.samples, missing)


def sensing_arm(scene: Scene, name: str | None) -> ArmScene:
    """The arm of that name, or the only one, whose sensor gives images."""
    what = "an arm whose sensor gives images"
    return arm_of(scene, name, lambda arm: scene.gives_images(arm.name), what)


def chosen_surface(scene: Scene, arm: ArmScene, name: str | None, shape: str = FLAT) -> BodyScene:
    """The surface of that name, or the only one of that shape that the arm can touch."""
    surfaces, wanted = scene.bodies_of(arm.name), SHAPES[shape]
    if name is None:
        fitting = [surface for surface in surfaces.values() if surface.shape == shape]
        if len(fitting) != 1:
            found = ", ".join(f"{item.name} ({item.shape})" for item in surfaces.values()) or "none"
            raise ValueError(
                f"{scene.path}: data are collected on one {wanted} (shape: {shape}); there are: {found}; "
                "choose one with --surface"
            )
        return fitting[0]
    if name not in surfaces:
        raise ValueError(f"--surface: {unknown_name(name, list(surfaces))}")
    if surfaces[name].shape != shape:
        raise ValueError(
            f"--surface {name}: is a {surfaces[name].shape}, must be a {wanted} (shape: {shape})"
        )
    return surfaces[name]


def frame_on(scene: Scene, surface: BodyScene, arm: ArmScene) -> Any:
    """T_base_f (4, 4): the contact frame on the surface, or the edge, under where the arm starts."""
    assert arm.sensor is not None
    T_base_surface, radius = scene.T_base_body(arm.name, surface.name), arm.sensor.settings.tip_radius
    if surface.shape == EDGED:
        size: Any = surface.parameters
        return edge_frame(T_base_surface, size.size, arm.T_base_start, radius)
    return contact_frame(T_base_surface, arm.T_base_start, radius)


def defaults(arm: ArmScene, touches: int, edge: bool) -> DataCollectionSettings:
    """What is done where nothing else is said: on an edge it is pressed deeper and less tilted."""
    assert arm.sensor is not None
    measured = arm.sensor.settings.force_sensor
    settings = DataCollectionSettings().replaced(touch__points=touches, force__labelled=measured)
    if not edge:
        return settings
    return settings.replaced(
        edge__pressed=True,
        edge__tip_radius=arm.sensor.settings.tip_radius,
        **{f"sampling__{name}": value for name, value in ON_EDGES.items()},
    )


def chosen_settings(
    settings: DataCollectionSettings, file: Path | None, changes: list[str]
) -> DataCollectionSettings:
    """These, changed by a file and the command line."""
    names = [name for name in settings.group_names() if name != "data"]  # that has options of its own
    if file is not None:
        root = read_yaml(file)
        root.allow(*names)
        for name in root.values:
            section, group = root.section(name), settings.group(name)
            checked: Any = section.checked(type(group), vars(group) | section.values)
            settings = dataclasses.replace(settings, **{name: checked})
    for change in changes:
        path, value = name_and_value(change, "motion.contact_speed=0.01")
        name, dot, key = path.partition(".")
        if not dot or name not in names:
            raise SettingError(f"--set {change}: {unknown_name(name, names)}, then a dot and a name")
        settings = settings.merged({name: {key: value}}, f"--set {change}")
    return settings
