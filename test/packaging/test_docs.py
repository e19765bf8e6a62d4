"""What the documentation points at and tells to type is there; its examples of plug-ins run.

Its reference is written from the code (scripts/reference), here into a folder of its own, which stands for
docs/reference.
"""

import argparse
import csv
import dataclasses
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from other_package import as_installed

from tactile_base import topics
from tactile_bringup import driver_check
from tactile_bringup.cli import command_line
from tactile_bringup.new_package import write_package
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_bringup.plugin_check import check_plugin
from tactile_control.pid import PidSettings
from tactile_control.task_file import load_task
from tactile_drivers.safety import SafeArm
from tactile_drivers.uvc_camera import UvcCameraSettings
from tactile_filter.filter_settings import FilterSettings
from tactile_records.runs import metrics, object_tracking, pushing
from tactile_records.runs.report import write_numbers
from tactile_scene.arm import open_arm
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.scene import SensorSettings
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes.box import BoxSettings

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PLACEHOLDER = re.compile(r"\[-|\.\.\.|[…|]")  # a line that shows options rather than to be typed


@pytest.fixture(scope="session")
def reference(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that stands for docs/reference."""
    folder = tmp_path_factory.mktemp("reference")
    script = root / "scripts" / "reference"
    done = subprocess.run([sys.executable, str(script), str(folder)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def pages(root: Path) -> list[Path]:
    """Those that are written by hand."""
    written = root / "docs" / "reference"
    return [*root.glob("*.md"), *(page for page in (root / "docs").rglob("*.md") if page.parent != written)]


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as GitHub, GitLab and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(page: Path, place: Path, root: Path, reference: Path) -> list[str]:
    """Relative links of a page that lead nowhere; it stands at `place`."""
    broken, text = [], re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)
    for link in LINK.findall(text):
        target, _, anchor = link.partition("#")
        if "://" in link:
            continue
        path = Path(os.path.normpath(place.parent / target)) if target else place
        if path.parent == root / "docs" / "reference":
            path = reference / path.name
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(f"{place.relative_to(root)}: {link}")
    return broken


def commands(page: Path) -> Iterator[str]:
    """Every `tactile ...` line of the code blocks, as one line, without comment."""
    text = page.read_text().replace("\\\n", " ")
    for line in text.splitlines():
        typed = re.match(r"(?: {4}|)(tactile [a-z].*)$", line)
        if typed:
            yield re.sub(r"\s+#.*$", "", typed[1])


def test_every_relative_link_leads_somewhere(root: Path, reference: Path):
    broken = [link for page in pages(root) for link in broken_links(page, page, root, reference)]
    for page in reference.glob("*.md"):
        broken += broken_links(page, root / "docs" / "reference" / page.name, root, reference)
    assert not broken


def test_the_site_has_every_page_once(root: Path, reference: Path):
    listed = re.findall(r": ([\w./]+\.md)$", (root / "mkdocs.yml").read_text(), re.M)
    there = [str(page.relative_to(root)) for page in pages(root) if page.name != "CHANGELOG.md"]
    there += [f"docs/reference/{page.name}" for page in reference.glob("*.md")]
    assert sorted(listed) == sorted(there)


def test_every_command_in_the_docs_is_one_that_tactile_takes(root: Path, capsys: pytest.CaptureFixture[str]):
    refused, found = [], 0
    for page in pages(root):
        for command in commands(page):
            if PLACEHOLDER.search(command):
                continue
            found += 1
            try:
                command_line().parse_args(shlex.split(command)[1:])
            except (SystemExit, argparse.ArgumentError) as error:
                if getattr(error, "code", 1):
                    reason = capsys.readouterr().err.strip().splitlines()[-1]
                    refused.append(f"{page.relative_to(root)}: {command}: {reason}")
    assert not refused
    assert found > 50


def subparser(words: list[str]) -> tuple[argparse.ArgumentParser, list[str]]:
    """The parser of a command, which may have commands of its own, and the words that are left."""
    parser = command_line()
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


def test_every_file_named_in_the_docs_exists(root: Path, reference: Path):
    """Paths in code style below one of our folders; what a commit had is named with it."""
    folders = "bench|config|docs|examples|launch|scripts|test|tactile_[a-z]+"
    named = re.compile(rf"(?<![\w/.])((?:{folders})/[\w./-]*\w\.(?:py|yaml|md|sh|rviz|txt|xml|h|c|onnx))\b")
    missing = []
    for page in pages(root):
        if page.name != "CHANGELOG.md":
            text = page.read_text()
            missing += [
                f"{page.relative_to(root)}: {found[1]}"
                for found in named.finditer(text)
                if not (root / found[1]).exists()
                and not (
                    found[1].startswith("docs/reference/") and (reference / Path(found[1]).name).exists()
                )
                and not re.search("[A-Z]{3}", found[1])  # NAME stands for a name
                and not re.match(r"[^`]*`\s+of\s+commit\s+[0-9a-f]{7}\b", text[found.end() :])
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


# ---- the reference ----


def test_the_reference_has_every_topic_with_type_and_publisher(reference: Path):
    lines = (reference / "topics.md").read_text().splitlines()
    for topic in [item for item in vars(topics).values() if isinstance(item, topics.Topic)]:
        (row,) = [line for line in lines if line.startswith(f"| `{topic.name}` |")]
        assert topic.type in row and topic.publisher in row, row


def test_the_reference_has_every_number_of_a_report(reference: Path):
    text = (reference / "report.md").read_text()
    for fields in (metrics.REPORT_FIELDS, object_tracking.FIELDS, pushing.FIELDS):
        for name, meaning in fields.items():
            assert f"| `{name}` | {meaning} |" in text


def test_the_reference_has_every_setting_and_none_twice(reference: Path):
    text = "".join((reference / name).read_text() for name in ("scene.md", "tasks.md", "settings.md"))
    for kind in (UvcCameraSettings, ArmLimits, SensorSettings, FilterSettings, PidSettings, BoxSettings):
        (section,) = re.findall(rf"\(`{kind.__name__}`\)\n\n(.*?)\n\n", text, re.S)
        for item in dataclasses.fields(kind):
            assert f"| `{item.name}` |" in section and str(item.metadata["doc"])[:20] in section, item.name
    kinds = re.findall(r"\(`(\w+)`\)\n\n\|", text)
    twice = {
        "ContactSettings",
        "TrackingSettings",
    }  # a task's and the simulated sensor's; a task's and an arm's
    assert len(kinds) > 50 and {name for name in kinds if kinds.count(name) > 1} <= twice


def test_the_reference_has_every_command(reference: Path):
    text = (reference / "commands.md").read_text()
    for command in ("tactile launch", "tactile camera check", "tactile data collect", "tactile stop"):
        assert f"\n## {command}\n" in text
        parser, _ = subparser(command.split()[1:])
        for option in parser._option_string_actions:
            assert option in text, f"{command} {option}"


def test_the_reference_says_which_settings_are_a_nodes_parameters(reference: Path):
    text = (reference / "nodes.md").read_text()
    controller = text[text.index("\n## controller") : text.index("\n## estimator")]
    assert "| `task_name` | the kind of task that it runs; default `'surface_following'` | no |" in controller
    assert "| `bounds.*` | [ContactBounds](settings.md#contactbounds) | no |" in controller
    assert "`contact/state`" in controller and "`run_task`" in controller


def test_each_fault_has_its_test_and_a_row_of_the_reference(root: Path, reference: Path):
    with (root / "docs" / "faults.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 380
    for row in rows:
        file, _, name = row["test"].partition("::")
        found = [path for path in root.glob(f"test/**/{file}") if f"def {name}(" in path.read_text()]
        assert len(found) == 1, f"{row['fault']}: {row['test']} is in {found or 'no file'}"
        assert all(row[key] for key in ("section", "fault", "injected", "response")), row
    faults = [(row["section"], row["fault"]) for row in rows]
    assert len(set(faults)) == len(faults)
    text = (reference / "faults.md").read_text()
    assert all(f"| {row['fault']} | {row['injected']} |" in text for row in rows)


# ---- examples of plug-ins ----


def install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the packages of a folder as good as installed."""
    for project in folder.glob("*/pyproject.toml"):
        monkeypatch.syspath_prepend(as_installed(project.parent))
        for module in project.parent.glob("*.py"):
            monkeypatch.delitem(sys.modules, module.stem, raising=False)


@pytest.fixture
def examples(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what `tactile new` writes for drivers, and the folder examples/."""
    write_package("arm", "my_arm", tmp_path)
    write_package("camera", "my_camera", tmp_path)
    shutil.copytree(root / "examples", tmp_path, dirs_exist_ok=True)
    install(tmp_path, monkeypatch)
    return tmp_path


def test_the_page_on_tasks_shows_what_stands_in_the_example(root: Path):
    shown = re.findall(r"^```python\n(.*?)^```", (root / "docs" / "add_a_task.md").read_text(), re.M | re.S)
    files = "".join(path.read_text() for path in sorted((root / "examples" / "my_tasks").glob("*.py")))
    assert len(shown) == 4 and all(text in files for text in shown)


def test_the_task_of_the_docs_runs_and_reports(examples: Path, tmp_path: Path):
    task = load_task(examples / "my_tasks" / "rubbing.yaml", "plane")
    run = run_arms_offline(load_scene("plane"), task, OfflineOptions(fidelity="ideal", seed=1))
    numbers = write_numbers(run, "arm", tmp_path / "report.json")
    assert numbers["succeeded"], numbers["reason"]
    assert numbers["strokes_mm"] == pytest.approx(60.0, abs=1.5)  # two strokes of 20 mm, two of 10 mm


def test_the_shape_and_the_motion_of_the_docs_run(examples: Path):
    folder = examples / "my_tasks"
    scene = load_scene(folder / "swinging_bowl.yaml")
    task = load_task(folder / "stay.yaml", scene.name)
    record = run_arms_offline(scene, task, OfflineOptions(fidelity="ideal", seed=1))["arm"]
    assert record.result["succeeded"], record.result["reason"]
    working = record.working(record.pose.stamp_ns)
    assert np.ptp(record.pose.T_base_sensor[working][:, 2, 3]) == pytest.approx(0.008, abs=0.002)


@pytest.mark.live
def test_the_plug_ins_of_the_docs_keep_their_contracts(examples: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(driver_check, "LISTEN", 0.5)
    for kind, name in (("task", "rubbing"), ("shape", "bowl"), ("body motion", "swing")):
        assert check_plugin(kind, name) == [], name
    for kind, name, moves in (("arm driver", "my_arm", True), ("camera driver", "my_camera", False)):
        scene = examples / name / "cell.yaml"
        assert check_plugin(kind, name, scene=str(scene), moves=moves) == [], name


def test_the_arm_driver_of_the_docs_follows_twists_and_stops(examples: Path):
    scene = load_scene(examples / "my_arm" / "cell.yaml").arms["arm"]
    safe = SafeArm(scene, time.time_ns)
    safe.attach_driver(open_arm(scene, safe.take_state))
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


def test_the_sensor_of_the_docs_follows_a_surface(examples: Path):
    """With its task, on an ideal sensor: a model of its own is what the page makes."""
    scene = load_scene(examples / "my_sensor" / "my_cell.yaml")
    task = load_task(examples / "my_sensor" / "my_task.yaml", scene.name)
    record = run_arms_offline(scene, task, OfflineOptions(fidelity="ideal", seed=1))["arm"]
    assert record.result["succeeded"], record.result["reason"]
