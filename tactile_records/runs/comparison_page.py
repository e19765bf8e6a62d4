"""The page, the picture and the file of a comparison of runs."""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from tactile_base.html_page import Html, element, picture, table, write_page
from tactile_base.whole_file import whole_file
from tactile_records.runs.comparison import (
    LARGER,
    UNTOLD,
    Array,
    ComparedRun,
    Difference,
    Group,
    differences,
    differing_settings,
    groups_of,
)
from tactile_records.runs.figures import BELIEF, ESTIMATE, style
from tactile_records.runs.page import code, shown
from tactile_records.runs.report import report_of

PAGE, NUMBERS = "compare.html", "compare.json"
MOST_PANELS = 12  # of the picture
_CLASSES = {LARGER: "bad", UNTOLD: "open"}
#: What the picture shows where no difference is larger than the spread.
_FIRST = ("depth_rms_mm", "normal_rms_deg", "contact_fraction", "push.error_abs_mm", "latency_ms.p50")


class Comparison:
    """One arm of all runs: groups, and how the further ones differ from the first.

    `untold` are those runs whose record does not hold their settings.
    """

    def __init__(self, arm: str, runs: Sequence[ComparedRun]) -> None:
        self.arm = arm
        self.untold = [run.source for run in runs if not run.settings]
        self.groups = groups_of(runs)
        self.settings = differing_settings([group.runs[0] for group in self.groups])
        self.differences = differences(self.groups)
        self._fields = report_of(runs[0].identity["task"]).fields

    def meaning(self, number: str) -> str:
        """What a number of a report is, in words."""
        found = (text for name, text in self._fields.items() if fnmatch.fnmatchcase(number, name))
        return next(found, "")

    @property
    def larger(self) -> list[Difference]:
        """Those that are larger than the spread."""
        return [found for found in self.differences if found.verdict == LARGER]


def compared(runs: Sequence[ComparedRun]) -> list[Comparison]:
    """Of each arm by itself."""
    arms = dict.fromkeys(run.arm for run in runs)
    return [Comparison(arm, [run for run in runs if run.arm == arm]) for arm in arms]


def spread(values: Array, runs: int) -> str:
    """Mean and deviation of what so many runs say, as far as several of them have it."""
    some = f" ({len(values)} of {runs})" if len(values) < runs else ""
    if len(values) == 1:
        return f"{values[0]:.5g}{some}"
    return f"{values.mean():.5g} \u00b1 {values.std(ddof=1):.3g}{some}"


def write_comparison(found: Sequence[Comparison], folder: Path) -> list[Path]:
    """Write compare.html, compare.json and a picture of each arm; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    content, paths = [element("p", _HOW, class_="quiet")], []
    for one in found:
        content += [element("h2", f"Arm {one.arm}"), _runs(one), element("h3", "What differs in settings")]
        content += [_settings(one), element("h3", "What differs in results"), *_verdict(one)]
        path = folder / f"{one.arm}.png"
        _draw(one, path)
        paths.append(path)
        content += [picture(path, f"numbers of {one.arm} by group"), _numbers(one)]
    with whole_file(folder / NUMBERS) as temporary:
        temporary.write_text(json.dumps({one.arm: _as_json(one) for one in found}, indent=2) + "\n")
    return [write_page(folder / PAGE, "Runs compared", *content), folder / NUMBERS, *paths]


_HOW = (
    "Runs with the same task, scene and settings are one group, whatever their seeds. A number is mean "
    "\u00b1 deviation. A difference is called larger than the spread where runs of one kind would show one "
    "so large by chance, in any number of an arm, in fewer than 5 of 100 such comparisons (Welch's t test, "
    "or the prediction interval of a single run; Holm's correction)."
)


def _runs(one: Comparison) -> Html:
    rows = [
        (group.name, code(run.source), run.identity["scene"], run.identity["task_file"])
        for group in one.groups
        for run in group.runs
    ]
    return table(["group", "run", "scene", "task"], rows)


def _settings(one: Comparison) -> Html:
    if not one.settings:
        return element("p", "Nothing: all of these runs are of one kind.")
    rows = [(code(name), *map(_value, values)) for name, values in one.settings.items()]
    return table(["", *(group.name for group in one.groups)], rows)


def _value(value: Any) -> str:
    return "not told" if value is None else shown(value)


def _verdict(one: Comparison) -> Iterator[Html]:
    if one.untold:
        yield element("p", doubt(one), class_="open")
    if len(one.groups) == 1:
        yield element("p", "There is one group: below is how its runs are spread.")
        return
    yield element("p", summary(one))


def doubt(one: Comparison) -> str:
    """In a sentence, what is not known of an arm's groups; empty if all is."""
    if not one.untold:
        return ""
    listed = ", ".join(one.untold)
    return f"Of {listed} the settings are not recorded, so runs that look alike may not be of one kind."


def summary(one: Comparison) -> str:
    """In a sentence, what can be said of an arm's numbers."""
    if all(found.verdict == UNTOLD for found in one.differences):
        return (
            "Nothing can be said of what is more than chance: no group has several runs that differ. Repeat "
            "each with other seeds (--seed), and compare all of them."
        )
    larger = len({found.number for found in one.larger})
    count = len({found.number for found in one.differences})
    return f"{larger} of {count} numbers differ by more than the spread."


def _numbers(one: Comparison) -> Html:
    first, *others = one.groups
    by_place = {(found.number, found.group): found for found in one.differences}
    rows = []
    for number in _all_numbers(one):
        cells: list[Any] = [code(number), _spread_or_nothing(first, number)]
        for group in others:
            cells.append(_spread_or_nothing(group, number))
            cells.append(_cell(by_place.get((number, group.name))))
        rows.append([*cells, one.meaning(number)])
    heads = [head for group in others for head in (group.name, f"{group.name} against {first.name}")]
    return table(["", first.name, *heads, "what it is"], rows, numbers=range(1, 2 + len(heads)))


def _all_numbers(one: Comparison) -> list[str]:
    """Those that differ by more than the spread first."""
    every = dict.fromkeys(name for group in one.groups for run in group.runs for name in run.numbers)
    return list(dict.fromkeys([*(found.number for found in one.larger), *every]))


def _spread_or_nothing(group: Group, number: str) -> str:
    values = group.values(number)
    return spread(values, len(group.runs)) if len(values) else "none"


def _cell(found: Difference | None) -> Html | str:
    if found is None:
        return ""
    text = f"{found.size:+.3g}, {found.verdict}"
    return element("span", text, class_=_CLASSES.get(found.verdict, "quiet"), title=found.why)


def _as_json(one: Comparison) -> dict[str, Any]:
    return {
        "groups": {
            group.name: {
                "runs": [run.source for run in group.runs],
                "numbers": {n: v.tolist() for n in _all_numbers(one) if len(v := group.values(n))},
            }
            for group in one.groups
        },
        "settings": {
            name: {group.name: value for group, value in zip(one.groups, values, strict=True)}
            for name, values in one.settings.items()
        },
        "differences": [
            {"number": d.number, "group": d.group, "size": d.size, "verdict": d.verdict, "why": d.why}
            for d in one.differences
        ],
    }


def _draw(one: Comparison, path: Path) -> None:
    """A panel for each number that differs, else the first ones: runs as dots, mean and deviation as bars."""
    numbers = list(dict.fromkeys(found.number for found in one.larger))[:MOST_PANELS]
    numbers = numbers or [name for name in _FIRST if name in _all_numbers(one)] or _all_numbers(one)[:3]
    columns = min(4, len(numbers))
    lines = -(-len(numbers) // columns)
    with style():
        size = (3.2 * columns, 2.6 * lines + 0.4)
        figure, panels = plt.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained")
        for axes, number in zip(panels.flat, numbers, strict=False):
            _draw_number(axes, one, number)
        for axes in panels.flat[len(numbers) :]:
            axes.set_visible(False)
        figure.supxlabel("group; a dot is a run, a bar mean \u00b1 standard deviation", fontsize=9)
        figure.savefig(path, dpi=110)
        plt.close(figure)


def _draw_number(axes: Any, one: Comparison, number: str) -> None:
    for place, group in enumerate(one.groups):
        values = group.values(number)
        axes.plot(np.full(len(values), place), values, "o", color=ESTIMATE, ms=4, alpha=0.7)
        if len(values) > 1:
            bar = {"fmt": "_", "color": BELIEF, "ms": 14, "capsize": 4}
            axes.errorbar(place + 0.15, values.mean(), values.std(ddof=1), **bar)
    axes.set_xticks(range(len(one.groups)), [group.name for group in one.groups])
    axes.set_xlim(-0.5, len(one.groups) - 0.5)
    axes.set_title(number, fontsize=9)
