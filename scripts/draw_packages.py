#!/usr/bin/env python3
"""Draw which package imports which, and how large each is.

    scripts/draw_packages.py [--root FOLDER] [--out FILE]

A package stands above all that it imports. Of its imports only those are drawn that no other one implies.
Packages and files that import each other in a circle are told, with exit code 1.
"""

from __future__ import annotations

import argparse
import ast
import functools
import statistics
import sys
from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

Graph = Mapping[str, set[str]]
ROOT = Path(__file__).resolve().parents[1]
SOURCES = {".py", ".c", ".h"}
WIDTH, NARROWEST, GAP = 16.0, 1.7, 0.3  # of all lines, of a box, between boxes


def modules_of(root: Path) -> dict[str, Path]:
    """Name -> file of all Python modules of the packages below a folder."""
    folders = [path.parent for path in sorted(root.glob("tactile_*/__init__.py"))]
    files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    dotted = {".".join(path.relative_to(root).with_suffix("").parts): path for path in files}
    return {name.removesuffix(".__init__"): path for name, path in dotted.items()}


def imported(path: Path, modules: Mapping[str, Path]) -> set[str]:
    """Those of the modules that a file imports, wherever in it and what for."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            named = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
            found |= named or {node.module} & modules.keys()
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & modules.keys()
    return found


def in_circles(graph: Graph) -> set[str]:
    """Those that import themselves by way of others, and what lies between two of them."""
    left = {name: needs - {name} for name, needs in graph.items()}
    while ends := [n for n, needs in left.items() if not needs & left.keys()] or list(
        left.keys() - set().union(*left.values())
    ):
        for name in ends:
            del left[name]
    return set(left)


def package_graph(modules: Mapping[str, Path], graph: Graph) -> dict[str, set[str]]:
    """Package -> the packages that its files import."""
    packages: dict[str, set[str]] = {name.split(".")[0]: set() for name in modules}
    for name, needs in graph.items():
        own = name.split(".")[0]
        packages[own] |= {need.split(".")[0] for need in needs} - {own}
    return packages


def lines_of(package: Path) -> int:
    """Lines of Python and C."""
    files = (path for path in package.rglob("*") if path.suffix in SOURCES)
    return sum(len(path.read_text().splitlines()) for path in files)


def draw(packages: Graph, lines: Mapping[str, int], out: Path) -> None:
    """The picture: one row for each level, boxes as wide as packages are large."""

    @functools.cache
    def level(name: str) -> int:
        return 1 + max(map(level, packages[name]), default=-1)

    @functools.cache
    def below(name: str) -> frozenset[str]:
        return frozenset().union(*({need} | below(need) for need in packages[name]))

    total, box = sum(lines.values()), {}
    figure, axes = plt.subplots(figsize=(11, 1.1 * (1 + max(map(level, packages)))), layout="constrained")
    for y in range(1 + max(map(level, packages))):
        # what stands on the same packages stands side by side
        row = [name for name in packages if level(name) == y]
        row.sort(key=lambda name: statistics.fmean([box[need][0] for need in packages[name]] or [0.0]))
        widths = [max(NARROWEST, WIDTH * lines[name] / total) for name in row]
        x = -(sum(widths) + GAP * (len(row) - 1)) / 2
        for name, width in zip(row, widths, strict=True):
            box[name] = (x + width / 2, float(y))
            axes.add_patch(plt.Rectangle((x, y - 0.27), width, 0.54, fc="#dbe7f3", ec="#33566f"))
            label = f"{name.removeprefix('tactile_')}\n{lines[name]:,} lines, {lines[name] / total:.0%}"
            axes.text(x + width / 2, y, label, ha="center", va="center", fontsize=9)
            x += width + GAP
    for name, needs in packages.items():
        implied = frozenset().union(*(below(need) for need in needs))
        for need in needs - implied:
            (x0, y0), (x1, y1) = box[name], box[need]
            ends = {"xy": (x1, y1 + 0.28), "xytext": (x0, y0 - 0.28)}
            axes.annotate("", **ends, arrowprops={"arrowstyle": "->", "color": "#33566f", "lw": 1.0})
    axes.autoscale()
    axes.margins(0.02)
    axes.axis("off")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


def main() -> int:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="a source tree (default: this one)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs/images/packages.png", help="the picture")
    arguments = parser.parse_args()
    modules = modules_of(arguments.root)
    graph = {name: imported(path, modules) for name, path in modules.items()}
    packages = package_graph(modules, graph)
    circles = in_circles(packages) or in_circles(graph)
    if circles:
        print(f"in a circle, or between two: {', '.join(sorted(circles))}", file=sys.stderr)
    if not in_circles(packages):
        draw(packages, {name: lines_of(arguments.root / name) for name in packages}, arguments.out)
        print(arguments.out)
    return 1 if circles else 0


if __name__ == "__main__":
    sys.exit(main())
