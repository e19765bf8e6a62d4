"""What a user reads of a mistake in a plug-in: `tactile check`, and a run of it by who has not checked.

    python test/other_package/plugin_mistakes.py [shape motion task arm camera] [--no-nodes | --all-nodes]

The mistakes are those that the tests of `tactile check` make (mistakes.py), of each kind,
installed as another package would be. Shapes, motions and tasks run without ROS (`tactile simulate`, ideal
sensor); of drivers, and of tasks, those of `LIVE`, or all drivers, run as nodes (`tactile launch`). All
simulated: the arm is one that follows exactly, the camera gives a gray picture.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import mistakes

from other_package import ENTRY_POINTS, installed
from tactile_bringup import cli, driver_check
from tactile_bringup.plugin_check import check_plugin

TEST = Path(__file__).resolve().parents[1]
GROUPS = {
    "shape": "shapes",
    "body motion": "motions",
    "task": "tasks",
    "arm driver": "arms",
    "camera driver": "cameras",
}
SCENE = """\
arms:
  arm:
    driver: {arm}
    start: {{position: [0.0, 0.0, {height}], rotation_deg: [0, 180, 0]}}
    {sensor}
bodies:
  body: {body}
"""
SENSOR = "sensor: {{in_tool: {{position: [0.0, 0.0, 0.065]}}{camera}}}"
BALL = "{{shape: {shape}, pose: {{position: [0.0, 0.0, -0.035]}}}}"  # its top at the height of the table
FOLLOWING = "{name: along, length: 0.01}"
MOVING = "{name: up, position: [0.0, 0.0, 0.32]}"
LIVE = {"task": (6, 12), "arm driver": (0, 3, 4, 6, 7, 10, 11), "camera driver": (0, 4, 5, 6, 7, 9, 10)}
LONG = 200  # characters of a cell
LONGEST = 90.0  # s, of a launch


def entry_points() -> str:
    """All mistakes, as a package brings them along: SHAPE_3 is called shape_3."""
    text = ENTRY_POINTS
    for kind, group in GROUPS.items():
        head = f"[tactile_servoing.{group}]\n"
        before = text if head in text else text + head
        names = "".join(
            f"{name_of(kind, k)} = {place_of(kind, k)}\n" for k in range(len(mistakes.KINDS[kind]))
        )
        text = before.replace(head, head + names)
    return text


def name_of(kind: str, number: int) -> str:
    """How a user calls the mistake of that number."""
    return f"{kind.split()[0]}_{number}"


def place_of(kind: str, number: int) -> str:
    """Where it can be imported from."""
    return f"mistakes:PLUGINS.{name_of(kind, number).upper()}"


def files_for(kind: str, name: str, folder: Path) -> list[str]:
    """The words that run a task on a scene in which this plug-in stands, whose files are written."""
    body, task, goal, arm, camera, height = "{shape: plane}", "surface_following", FOLLOWING, "sim", "", 0.032
    if kind == "shape":
        body = BALL.format(shape=name)
    elif kind == "body motion":
        body = f"{{shape: plane, motion: {name}}}"
    elif kind == "task":
        task = name
    elif kind == "arm driver":
        arm, task, goal, height = name, "move", MOVING, 0.3
    else:
        arm, camera = "bench_arm", f", camera: {name}, camera_rate: 60"
    sensor = "" if kind == "arm driver" else SENSOR.format(camera=camera)
    scene, file = folder / "cell.yaml", folder / "job.yaml"
    scene.write_text(SCENE.format(arm=arm, height=height, sensor=sensor, body=body))
    file.write_text(f"roles:\n  one: {{task: {task}}}\nscenes:\n  cell:\n    one: {{goals: [{goal}]}}\n")
    return [str(file), "--scene", str(scene)]


def checked(kind: str, number: int, folder: Path) -> str:
    """What `tactile check` says of it."""
    scene = ""
    if kind.endswith("driver"):
        files_for(kind, "bench_arm" if kind == "arm driver" else "bench_camera", folder)
        scene = str(folder / "cell.yaml")
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return "; ".join(check_plugin(kind, place_of(kind, number), scene=scene)) or "nothing"
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def simulated(kind: str, number: int, folder: Path) -> tuple[str, str]:
    """The screen, and the reason in report.json, of a run without ROS."""
    out = folder / "out"
    words = ["simulate", *files_for(kind, name_of(kind, number), folder), "--fidelity", "ideal"]
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = str(cli.main([*words, "--out", str(out)]))
        except Exception as error:
            code, _ = "", said.write(f"TRACEBACK {type(error).__name__}: {error}")
    return f"[{code}] {_headlines(said.getvalue())}", _reason(out / "report.json")


def launched(kind: str, number: int, folder: Path) -> tuple[str, str]:
    """The screen, and the reason in the report of the recording, of a run as nodes."""
    words = files_for(kind, name_of(kind, number), folder)
    command = [sys.executable, "-m", "tactile_bringup.cli"]
    launch = [*command, "launch", *words, "--headless", "--out", str(folder / "runs")]
    run = subprocess.run(
        [*launch, "--record", str(folder / "bag")], capture_output=True, text=True, timeout=LONGEST
    )
    if not (folder / "bag").exists():
        return f"[{run.returncode}] {_headlines(run.stdout + run.stderr)}", ""
    report = [*command, "report", str(folder / "bag"), "--out", str(folder / "report")]
    subprocess.run(report, capture_output=True, text=True, timeout=LONGEST)
    return f"[{run.returncode}] {_headlines(run.stdout + run.stderr)}", _reason(folder / "report/report.json")


def _headlines(text: str) -> str:
    """The lines that say how it ended, or what is wrong."""
    marks = ("tactile ", "task  ", "TRACEBACK", "shape '", "body motion '", "failed: ")
    lines = [line.strip() for line in text.splitlines() if line.startswith(marks) or "failed: " in line]
    return " / ".join(dict.fromkeys(" ".join(line.split()) for line in lines))


def _reason(path: Path) -> str:
    if not path.exists():
        return "no report"
    values = json.loads(path.read_text())
    complaints = "; ".join(map(str, values["complaints"]))
    return values["reason"] + (f" / complaints: {complaints}" if complaints else "") or "none: succeeded"


def short(text: str, places: Iterable[Path]) -> str:
    """As a cell of a table: without the folders of this machine, and no longer than a line or two."""
    for place in places:
        text = text.replace(f"{place}/", "")
    text = " ".join(text.replace("|", "/").split())
    return text if len(text) <= LONG else f"{text[: LONG - 4]} ..."


def rows(kinds: list[str], nodes: bool) -> Iterator[list[str]]:
    """A row for each mistake, and for each that nodes run: kind, mistake, check, screen, reason."""
    with tempfile.TemporaryDirectory() as base:
        site = Path(base) / "site"
        site.mkdir()
        folders = installed(site, entry_points())
        sys.path[:0] = folders
        os.environ["PYTHONPATH"] = os.pathsep.join([*folders, os.environ.get("PYTHONPATH", "")])
        for kind in kinds:
            for number, words in enumerate(mistakes.KINDS[kind]):
                folder = Path(base) / name_of(kind, number)
                folder.mkdir()
                check, runs = checked(kind, number, folder), []
                if not kind.endswith("driver"):
                    runs.append(("", simulated(kind, number, folder)))
                if nodes and number in LIVE.get(kind, ()):
                    runs.append((" (nodes)", launched(kind, number, folder)))
                for how, run in runs or [("", ("not run", ""))]:
                    texts = (words + how, check, *run)
                    yield [
                        kind,
                        *(short(text, (folder, TEST / "other_package", TEST.parent)) for text in texts),
                    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = {kind.split()[-1] if kind == "body motion" else kind.split()[0]: kind for kind in GROUPS}
    parser.add_argument("kinds", nargs="*", choices=[*names, []], help="(default: all)")
    parser.add_argument("--no-nodes", action="store_true", help="without what is launched")
    parser.add_argument("--all-nodes", action="store_true", help="with every driver launched (11 minutes)")
    arguments = parser.parse_args()
    driver_check.LISTEN = 0.4
    if arguments.all_nodes:
        LIVE.update({kind: tuple(range(len(mistakes.KINDS[kind]))) for kind in GROUPS if "driver" in kind})
    begun, last = time.monotonic(), ""
    for kind, *cells in rows([names[name] for name in arguments.kinds or names], not arguments.no_nodes):
        if kind != last:
            print(f"\n**{kind}**\n\n| mistake | `tactile check` | on the screen | reason in report.json |")
            print("| --- | --- | --- | --- |")
            last = kind
        print(f"| {' | '.join(cells)} |", flush=True)
    print(f"\n{time.monotonic() - begun:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
