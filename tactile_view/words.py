"""What is known of a cell in words, as HTML: nothing that comes from a message is taken for markup."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

import numpy as np

from tactile_base.process_limits import OVERLOADED
from tactile_base.stamps import SECOND_NS
from tactile_geometry import se3
from tactile_records.runs.euler_poses import (
    COMPONENTS,
    UNIT_NAMES,
    UNITS,
    euler_poses,
    euler_sigmas,
    inverses,
)
from tactile_records.runs.events import MODES
from tactile_records.runs.from_bag import STAGES
from tactile_records.runs.record import GaussianSeries
from tactile_sim.skin_force import SkinModel, largest_shear
from tactile_view.cell_state import ArmState, CellState
from tactile_view.repeats import repeats

LATEST = 12  # events
#: What nodes say of a machine that has no time left for them; and how long ago (s) it is told at most.
OVERLOAD_SIGNS = OVERLOADED, "cannot hold", "held up", "came too fast", "known to be lost"
LATELY = 5.0
BOX = "<div style='font-size:0.85em;line-height:1.5;padding:0 0.5em'>{}</div>"


def set_html(handle: Any, content: str) -> None:
    """Give an element new content, if that is news: each one goes to all pages."""
    content = BOX.format(content)
    if handle.content != content:
        handle.content = content


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts; the first column stands to the left, the others to the right."""

    def line(cells: Iterable[str], tag: str) -> str:
        sides = ("left", *("right",) * 10)
        marked = (
            f"<{tag} style='text-align:{side};padding:0 0.6em'>{escape(cell)}</{tag}>"
            for cell, side in zip(cells, sides, strict=False)
        )
        return f"<tr>{''.join(marked)}</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"


def estimate_in_words(state: ArmState) -> str:
    """What the network says of the last image: whether there is contact, and the pose with its deviations."""
    row, presence = state.newest("estimate"), state.newest("presence")
    contact = ""
    if presence is not None:
        contact = f"<b>{'contact' if presence['in_contact'] else 'no contact'}</b>"
    if row is None:
        return contact or "no estimate yet"
    series = GaussianSeries(np.array([row["stamp_ns"]]), row["mean"][None], row["cov"][None])
    values, sigmas = euler_poses(inverses(series.mean))[0] * UNITS, euler_sigmas(series)[0] * UNITS
    rows = (
        (name, f"{value:+.2f}", f"± {2 * sigma:.2f}", unit)
        for name, value, sigma, unit in zip(COMPONENTS, values, sigmas, UNIT_NAMES, strict=True)
    )
    return contact + table(("network", "", "2σ", ""), rows)


def latency_in_words(state: ArmState) -> str:
    """Time from the exposure to what each stage gave, of the last frames, and how many it has dropped."""
    rows = []
    for stage in sorted(state.latency, key=lambda name: (*STAGES, name).index(name)):
        p50, p99 = np.percentile([1e3 * seconds for _, seconds in state.latency[stage]], [50, 99])
        rows.append((stage, f"{p50:.1f}", f"{p99:.1f}", str(state.dropped.get(stage, 0))))
    return table(("from the exposure to", "p50 ms", "p99 ms", "dropped"), rows) if rows else ""


def state_in_words(state: ArmState, skin: SkinModel | None = None) -> str:
    """Task, phase and progress, what it waits for, what limits it, who commands the arm, faults, and touch.

    `skin` is that of a simulated sensor.
    """
    task, arm, contact = state.controller, state.status, state.newest("belief")
    presence = state.newest("presence")
    lines = [] if task is None else _task_lines(task)
    if arm is not None:
        mode = MODES[arm.mode] if arm.mode < len(MODES) else str(arm.mode)
        color = "#c01c1c" if arm.mode >= MODES.index("fault") else "inherit"
        why = f": {escape(arm.reason)}" if arm.reason else ""
        lines.append(f"arm <b style='color:{color}'>{mode}</b>{why}")
        said = (
            ("commanded by", arm.owner), ("limited by", arm.limited_by), ("refused", arm.refused),
            ("remark", arm.remark),
        )  # fmt: skip
        lines += [f"{what} {escape(text)}" for what, text in said if text]
    if presence is not None and not presence["in_contact"]:
        lines.append("no contact")
    elif contact is not None:
        euler = se3.euler_from_pose(se3.inverse(contact["mean"])) * UNITS
        shear = math.hypot(euler[0], euler[1])
        limit = None if skin is None else largest_shear(skin, 1e-3 * euler[2])
        lines.append(f"depth {euler[2]:.2f} mm, shear {shear:.2f} mm and {euler[5]:+.1f} deg")
        known = "is not known" if limit is None else f"is {1e3 * limit:.2f} mm, of the simulated one"
        lines.append(f"shear at which the skin slides {known}")
    return "<br>".join(lines) or "nothing heard yet"


def other_in_words(state: ArmState) -> str:
    """What an arm does that is not looked at, in a line."""
    task, arm = state.controller, state.status
    mode = "" if arm is None or arm.mode >= len(MODES) else f", arm {MODES[arm.mode]}"
    return f"{escape(state.name)}: {'; '.join(_task_lines(task)) if task is not None else 'no task'}{mode}"


def _task_lines(task: Any) -> list[str]:
    progress = "" if math.isnan(task.progress) else f", {100 * task.progress:.0f} %"
    goal = f" <i>{escape(task.goal_name)}</i>" if task.goal_name else ""
    lines = [f"<b>{escape(task.task)}</b>{goal}: {escape(task.phase)}{progress}"]
    return [*lines, f"because {escape(task.reason)}"] if task.reason else lines


def troubles_in_words(state: CellState, remarks: Mapping[str, str] | None = None) -> str:
    """What nodes complain about, what of their messages could not be read, and remarks of arms, by name."""
    told = {**state.trouble, **(remarks or {})}
    lines = [f"<b>{escape(node)}</b> {escape(text)}" for node, text in sorted(told.items())]
    lines += [f"{count} messages on {escape(topic)} are none" for topic, count in state.refused.items()]
    return "<br>".join(lines) or "no node complains"


def overload_in_words(state: CellState) -> str:
    """Which nodes say now, or said lately, that the machine is too slow for them; empty without any."""
    since_ns = state.now_ns - LATELY * SECOND_NS
    told = [event.text for event in state.events if event.stamp_ns >= since_ns]
    told += [f"{node}: {text}" for node, text in state.trouble.items()]
    names = {
        text.partition(": ")[0].replace("/", ".").lstrip(".")
        for text in told
        if any(sign in text for sign in OVERLOAD_SIGNS)
    }
    if not names:
        return ""
    who = escape(", ".join(sorted(names)))
    advice = "end what else runs (<code>top</code>), or use --priority 20 or a lower --rate"
    return f"<b style='color:#c01c1c'>overloaded</b>: {who} had too little time; {advice}"


def events_in_words(state: CellState) -> str:
    """The latest events, newest first, with their age."""
    lines = []
    for event in sorted(repeats(state.events), key=lambda event: event.last_ns)[-LATEST:][::-1]:
        ago = max(0.0, (state.now_ns - event.last_ns) / SECOND_NS)
        lines.append(f"{ago:.1f} s ago, {escape(event.words)}")
    return "<br>".join(lines) or "nothing yet"
