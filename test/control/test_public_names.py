"""The names that docs/add_a_task.md calls public are there, and enough for the tasks of another package."""

import ast
import importlib
import re
from pathlib import Path

import pytest

LISTED = re.compile(r"^\| `(\w+)` \| (.+) \| (.+) \|$", re.M)
OTHERS = ("tapping.py", "circle.py")


@pytest.fixture(scope="module")
def root(pytestconfig: pytest.Config) -> Path:
    return pytestconfig.rootpath


@pytest.fixture(scope="module")
def public(root: Path) -> dict[str, tuple[list[str], list[str]]]:
    """By module, its names and those of its objects."""
    page = (root / "docs" / "add_a_task.md").read_text()
    rows = LISTED.findall(page[page.index("**Public names.**") :])
    return {
        f"tactile_control.{module}": (re.findall(r"\w+", names), re.findall(r"\w+", members))
        for module, names, members in rows
    }


def test_every_public_name_is_there(public):
    assert len(public) == 5
    for module, (names, members) in public.items():
        found = [
            getattr(importlib.import_module(module), name) for name in names
        ]  # AttributeError: it is gone
        made = Path(importlib.import_module(module).__file__).read_text()
        for member in members:
            inside = any(
                hasattr(item, member) or member in getattr(item, "__annotations__", {}) for item in found
            )
            assert inside or re.search(rf"self\.{member}\b.* = ", made), f"{module}: {member}"


@pytest.mark.parametrize("file", OTHERS)
def test_tasks_of_another_package_use_public_names_alone(root, public, file):
    tree = ast.parse((root / "test" / "other_package" / file).read_text())
    nodes = list(ast.walk(tree))
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module.startswith("tactile_control"):
            assert {name.name for name in node.names} <= set(public[node.module][0]), node.module
    own = {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
    own |= {
        target.id
        for node in nodes
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    members = {member for _, listed in public.values() for member in listed}
    tasks = [node for node in nodes if isinstance(node, ast.ClassDef) and is_task(node)]
    for node in (inner for task in tasks for inner in ast.walk(task)):
        if isinstance(node, ast.Attribute) and of_task(node.value):
            assert node.attr in members | own, f"{file}: {ast.unparse(node)}"


def is_task(node):
    return any(isinstance(base, ast.Name) and base.id in ("ContactTask", "Servo") for base in node.bases)


def of_task(node):
    return ast.unparse(node) in ("self", "self.task")


def test_tapping_is_one_short_file(root):
    assert len((root / "test" / "other_package" / "tapping.py").read_text().splitlines()) < 80
