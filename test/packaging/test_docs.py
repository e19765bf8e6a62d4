"""What the documentation points at and tells to type is there; its examples of plug-ins run."""

import argparse
import configparser
import dataclasses
import re
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactile_base import topics
from tactile_bringup import driver_check
from tactile_bringup.cli import _parser
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_bringup.plugin_check import check_plugin
from tactile_control.task_file import load_task
from tactile_drivers.arm import open_arm
from tactile_drivers.safety import SafeArm
from tactile_drivers.scene import load_scene
from tactile_drivers.sim.tactip import TacTip
from tactile_records.runs import metrics, object_tracking, pushing
from tactile_records.runs.report import write_numbers

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PLACEHOLDER = re.compile(r"\[-|\.\.\.|[…|]")  # a line that shows options rather than to be typed


def pages(root: Path) -> list[Path]:
    return [*root.glob("*.md"), *(root / "docs").rglob("*.md")]


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as GitHub and GitLab make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands(page: Path) -> Iterator[str]:
    """Every `tactile ...` line of the code blocks, as one line, without comment."""
    text = page.read_text().replace("\\\n", " ")
    for line in text.splitlines():
        typed = re.match(r"(?: {4}|)(tactile [a-z].*)$", line)
        if typed:
            yield re.sub(r"\s+#.*$", "", typed[1])


def test_every_relative_link_leads_somewhere(root: Path):
    broken = []
    for page in pages(root):
        for link in LINK.findall(page.read_text()):
            target, _, anchor = link.partition("#")
            if "://" in link:
                continue
            path = page.parent / target if target else page
            if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
                broken.append(f"{page.relative_to(root)}: {link}")
    assert not broken


def test_every_command_in_the_docs_is_one_that_tactile_takes(root: Path, capsys: pytest.CaptureFixture[str]):
    refused, found = [], 0
    for page in pages(root):
        for command in commands(page):
            if PLACEHOLDER.search(command):
                continue
            found += 1
            try:
                _parser().parse_args(shlex.split(command)[1:])
            except (SystemExit, argparse.ArgumentError) as error:
                if getattr(error, "code", 1):
                    reason = capsys.readouterr().err.strip().splitlines()[-1]
                    refused.append(f"{page.relative_to(root)}: {command}: {reason}")
    assert not refused
    assert found > 50


def subparser(words: list[str]) -> tuple[argparse.ArgumentParser, list[str]]:
    """The parser of a command, which may have commands of its own, and the words that are left."""
    parser = _parser()
    while words:
        actions = [item for item in parser._actions if isinstance(item, argparse._SubParsersAction)]
        if not actions or words[0] not in actions[0].choices:
            break
        parser, words = actions[0].choices[words[0]], words[1:]
    return parser, words


def test_every_option_within_a_sentence_is_one_of_its_command(root: Path):
    unknown, found = [], 0
    for page in pages(root):
        if page.name == "CHANGELOG.md":  # which names old ones, too
            continue
        for command in re.findall(r"`tactile ([a-z][^`]*)`", page.read_text()):
            parser, words = subparser(command.split())
            assert parser.prog != "tactile", (
                f"{page.relative_to(root)}: there is no command `tactile {command}`"
            )
            for word in words:
                if word.startswith("--"):
                    found += 1
                    if word.rstrip(",.;:") not in parser._option_string_actions:
                        unknown.append(f"{page.relative_to(root)}: tactile {command}: {word}")
    assert not unknown
    assert found > 10


def test_every_file_named_in_the_docs_exists(root: Path):
    """Paths in code style below one of our folders."""
    folders = "bench|config|docs|launch|scripts|test|tactile_[a-z]+"
    named = re.compile(rf"(?<![\w/.])((?:{folders})/[\w./-]*\w\.(?:py|yaml|md|sh|rviz|txt|xml|h|c|onnx))\b")
    missing = []
    for page in pages(root):
        if page.name != "CHANGELOG.md":
            missing += [
                f"{page.relative_to(root)}: {path}"
                for path in named.findall(page.read_text())
                if not (root / path).exists() and not re.search("[A-Z]{3}", path)  # NAME stands for a name
            ]
    assert not missing


def test_every_module_named_in_the_docs_can_be_found(root: Path):
    named = re.compile(r"(?:from|import|-m|`)\s?(tactile_(?!servoing)[a-z]+(?:\.[a-z_0-9]+)+)")
    missing = []
    for page in pages(root):
        if page.name == "CHANGELOG.md":
            continue
        for module in named.findall(page.read_text()):
            path = root / module.replace(".", "/")
            # the last name may be of something in a module
            if not any(place.with_suffix(".py").exists() or place.is_dir() for place in (path, path.parent)):
                missing.append(f"{page.relative_to(root)}: {module}")
    assert not missing


def test_the_table_of_topics_is_that_of_the_code(root: Path):
    text = (root / "docs" / "architecture.md").read_text()
    for topic in [item for item in vars(topics).values() if isinstance(item, topics.Topic)]:
        assert f"`{topic.name}`" in text, topic.name
        if not topic.name.startswith("/"):
            row = next(line for line in text.splitlines() if line.startswith(f"| `{topic.name}`"))
            assert topic.type in row and topic.publisher in row, row


def test_every_number_of_a_report_has_its_meaning_in_the_docs(root: Path):
    text = (root / "docs" / "control.md").read_text()
    for name, meaning in metrics.REPORT_FIELDS.items():
        assert f"| `{name}` | {meaning} |" in text
    tracking = (root / "docs" / "tasks.md").read_text()
    for name in object_tracking.FIELDS.keys() - metrics.REPORT_FIELDS.keys() - {"tracking.leader"}:
        assert f"`{name.removeprefix('tracking.').split('.')[0]}`" in tracking, name
    for name in pushing.FIELDS.keys() - metrics.REPORT_FIELDS.keys():
        assert f"| `{name.removeprefix('push.')}` | {pushing.FIELDS[name]} |" in tracking, name


# ---- examples of plug-ins ----


def install(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the files of a page into a folder, and make its packages as good as installed."""
    blocks = re.findall(r"^```\w+\n# ([\w./-]+\.\w+)\n(.*?)^```", page.read_text(), re.M | re.S)
    for name, text in blocks:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for project in folder.glob("*/pyproject.toml"):
        described = configparser.ConfigParser()  # what these files use of TOML it reads as well
        described.read_string(project.read_text().replace('"', ""))
        name = project.parent.name
        info = project.parent / f"{name}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        for section in described.sections():
            if section.startswith("project.entry-points."):
                points = "".join(f"{point} = {place}\n" for point, place in described[section].items())
                with (info / "entry_points.txt").open("a") as file:
                    file.write(f"[{section.removeprefix('project.entry-points.')}]\n{points}")
        monkeypatch.syspath_prepend(str(project.parent))
        for module in project.parent.glob("*.py"):
            monkeypatch.delitem(sys.modules, module.stem, raising=False)


@pytest.fixture
def examples(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with all packages of the pages on tasks and drivers."""
    for page in ("add_a_task.md", "own_arm.md"):
        install(root / "docs" / page, tmp_path / page, monkeypatch)
    return tmp_path


def test_the_task_of_the_docs_runs_and_reports(examples: Path, tmp_path: Path):
    task = load_task(examples / "add_a_task.md" / "my_tasks" / "rubbing.yaml", "plane")
    run = run_arms_offline(load_scene("plane"), task, OfflineOptions(fidelity="ideal", seed=1))
    numbers = write_numbers(run, "arm", tmp_path / "report.json")
    assert numbers["succeeded"], numbers["reason"]
    assert numbers["strokes_mm"] == pytest.approx(60.0, abs=1.5)  # two strokes of 20 mm, two of 10 mm


def test_the_shape_and_the_motion_of_the_docs_run(examples: Path):
    folder = examples / "add_a_task.md" / "my_tasks"
    scene = load_scene(folder / "swinging_bowl.yaml")
    task = load_task(folder / "stay.yaml", scene.name)
    record = run_arms_offline(scene, task, OfflineOptions(fidelity="ideal", seed=1))["arm"]
    assert record.result["succeeded"], record.result["reason"]
    working = record.working(record.pose.stamp_ns)
    assert np.ptp(record.pose.T_base_sensor[working][:, 2, 3]) == pytest.approx(0.008, abs=0.002)


@pytest.mark.live
def test_the_plug_ins_of_the_docs_keep_their_contracts(examples: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(driver_check, "LISTEN", 0.5)
    lab = examples / "own_arm.md" / "my_lab"
    monkeypatch.chdir(lab)
    cv2.imwrite("still.png", TacTip(seed=1).image())
    for kind, name in (("task", "rubbing"), ("shape", "bowl"), ("body motion", "swing")):
        assert check_plugin(kind, name) == [], name
    scene = str(lab / "my_cell.yaml")
    assert check_plugin("arm driver", "my_arm", scene=scene, moves=True) == []
    assert check_plugin("camera driver", "my_camera", scene=scene) == []


def test_the_arm_driver_of_the_docs_follows_twists_and_stops(examples: Path):
    scene = load_scene(examples / "own_arm.md" / "my_lab" / "my_cell.yaml").arms["arm"]
    safe = SafeArm(scene, time.time_ns)
    safe.drive(open_arm(scene, safe.take_state))
    try:
        while safe.state is None:
            pass
        assert safe.command(time.time_ns(), np.zeros(6)) == ""
        assert safe.command(time.time_ns(), [0.0, 0.0, 0.01, 0.0, 0.0, 0.0]) == ""
        while not safe.state.twist.any():
            pass
        safe.stop("enough")
        while safe.state.twist.any():
            pass
        assert safe.state.reason == "enough"
        assert "not finite" in safe.command(time.time_ns(), np.full(6, np.nan))
    finally:
        safe.close()


def test_each_fault_of_the_docs_has_its_test(root: Path):
    text = (root / "docs" / "safety.md").read_text()
    rows = [line for line in text[text.index("## Faults") :].splitlines() if line.startswith("| ")][2:]
    assert len(rows) >= 100
    for row in rows:
        file, _, name = row.strip("| ").split(" | ")[-1].partition("::")
        assert f"def {name}(" in (root / file).read_text(), row
    faults = [row.split(" | ")[0] for row in rows]
    assert len(set(faults)) == len(faults)


def test_settings_of_the_drivers_in_the_docs_are_declared(examples: Path):
    from my_camera import MyCameraSettings

    assert {field.name for field in dataclasses.fields(MyCameraSettings)} == {"device", "delay"}
