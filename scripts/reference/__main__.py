"""Write what the code knows as pages of the documentation: python scripts/reference [FOLDER].

Settings, parameters of nodes, topics, messages, commands, plug-ins, numbers of reports and the faults are
described once, in the code or in docs/faults.csv. It runs on what `make` has installed (. scripts/env.sh);
FOLDER is docs/reference by default.
"""

from __future__ import annotations

import csv
import inspect
import os
import sys
from pathlib import Path

import yaml
from graph import launch_page, messages_page, nodes_page, topics_page
from settings import scene_page, settings_page, tasks_page
from text import code, first_sentences, ours, table

from tactile_base.config_paths import config_folder
from tactile_bringup.cli import command_line
from tactile_bringup.commands.completion import parsers
from tactile_bringup.plugin_check import REGISTRIES
from tactile_records.runs import metrics

ROOT = Path(__file__).parents[2]
PLUGINS = """# Plug-ins

Another package adds names by entry points of the group; `tactile plugins` lists what is installed.
"""
REPORT = """# Numbers of reports

`report.json` of `tactile simulate`, `demo` and `report`. What cannot be computed, for want of a truth for
instance, is `null`.

## Every task in contact

"""
FAULTS = """# Faults

What goes wrong, what is done about it, and what the user reads. Each row is shown by the test that it names.
"Simulated" stands for the simulated cell; tests of libraries drive the same objects as the nodes. The rows of
Universal Robots and Franka arms are their drivers against doubles of the controllers, at 50 mm/s: time and
distance to rest are the doubles', as measured once; the tests hold them below 0.2 s and 10 mm. Franka's
double brakes with 10 m/s^2 in a reflex; how a real arm brakes is not known here.
"""


def packaged_page() -> str:
    """The files under config/ that commands take by name."""
    tasks = {path.stem: yaml.safe_load(path.read_text()) for path in files("tasks")}
    rows = []
    for path in files("scenes"):
        scene = yaml.safe_load(path.read_text())
        goals = [name for name, task in tasks.items() if scene.get("goals_of", path.stem) in task["scenes"]]
        arms = ", ".join(f"{name}: {arm.get('driver', 'sim')}" for name, arm in scene["arms"].items())
        rows.append((code(path.stem), scene.get("description", ""), arms, ", ".join(map(code, goals))))
    text = "# Packaged scenes, tasks and controllers\n\n## Scenes\n\n"
    text += table("`--scene` | what it is | arms: driver | tasks with goals on it", rows)
    rows = [(code(path.stem), comment(path), roles(tasks[path.stem])) for path in files("tasks")]
    text += "\n## Tasks\n\n" + table("task file | what it is | role: task, controller file", rows)
    for folder in ("controllers", "filters", "arms", "sensors", "experiments"):
        rows = [(code(path.stem), comment(path)) for path in files(folder)]
        text += f"\n## {folder.capitalize()}\n\n" + table("file | what it is", rows)
    return text


def files(folder: str) -> list[Path]:
    """The YAML files of a folder of config/."""
    return sorted((config_folder() / folder).glob("*.yaml"))


def comment(path: Path) -> str:
    """The first sentence of the comment at the beginning of a file."""
    lines = []
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    return " ".join(lines).partition(". ")[0].rstrip(".")


def roles(task: dict[str, dict[str, dict[str, str]]]) -> str:
    """Who does what in a task file."""
    return "; ".join(
        f"{name}: {', '.join(code(role[key]) for key in ('task', 'controller') if key in role)}"
        for name, role in task["roles"].items()
    )


def commands_page() -> str:
    """The help of every command."""
    os.environ["COLUMNS"] = "110"  # the width of the help, on every machine

    helps = (
        f"\n## {each.prog}\n\n```text\n{each.format_help().strip()}\n```\n"
        for each in parsers(command_line())
    )
    return "# Commands\n" + "".join(helps)


def plugins_page() -> str:
    """Every registry: names, where they lie, and what an entry has to offer."""
    text = PLUGINS
    for registry in REGISTRIES:
        text += f"\n## {registry.kind.capitalize()}\n\nGroup `{registry.group}`.\n"
        if made := registry.contract.made_from:
            calls = [f"`({', '.join(made)})`"]
            calls += [f"`{name}({', '.join(takes)})`" for name, takes in registry.contract.methods.items()]
            text += f"It is called, and has methods that are called, with: {', '.join(calls)}.\n"
        places = {entry.name: entry.place for entry in registry.entries()}
        rows = [
            (code(name), code(places[name]), first_sentences(item) if inspect.isclass(item) else "")
            for name, item in ours(registry).items()
        ]
        text += "\n" + table("name | where it lies | what it is", rows)
    return text


def report_page() -> str:
    """Every number of report.json."""
    common = [(code(k), meaning) for k, meaning in metrics.REPORT_FIELDS.items()]
    text = REPORT + table("name | meaning", common)
    for name, report in ours(next(r for r in REGISTRIES if r.kind == "report")).items():
        rows = [(code(k), meaning) for k, meaning in report.fields.items() if k not in metrics.REPORT_FIELDS]
        if rows:
            text += f"\n## {name}\n\n" + table("name | meaning", rows)
    return text


def faults_page() -> str:
    """The faults by subject, each with the test that shows it."""
    text, section = FAULTS, ""
    with (ROOT / "docs/faults.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["section"] != section:
                section = row["section"]
                text += f"\n## {section}\n\n" + table(
                    "fault | injected | response | within | message | test", []
                )
            test, _, name = row["test"].partition("::")
            values = [row[key] for key in ("fault", "injected", "response", "within", "message")]
            text += f"| {' | '.join(values)} | `{name}` ({test}) |\n"
    return text


PAGES = {
    "commands.md": commands_page,
    "launch.md": launch_page,
    "scene.md": scene_page,
    "tasks.md": tasks_page,
    "settings.md": settings_page,
    "packaged.md": packaged_page,
    "nodes.md": nodes_page,
    "topics.md": topics_page,
    "messages.md": messages_page,
    "plugins.md": plugins_page,
    "report.md": report_page,
    "faults.md": faults_page,
}


def main() -> None:
    """Write all pages."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs/reference"
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        (folder / name).write_text(page())


if __name__ == "__main__":
    main()
