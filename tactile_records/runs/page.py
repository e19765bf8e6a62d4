"""The page of a run: report.html, one file that shows what report.json and the pictures say, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tactile_base.html_page import Html, element, picture, table, write_page
from tactile_base.stamps import SECOND_NS
from tactile_records.runs.euler_poses import COMPONENT_NAMES
from tactile_records.runs.record import Event, RunRecord
from tactile_records.runs.report import Run, places, report_of
from tactile_records.runs.settings_given import Given, differing

NAME = "report.html"
MOST_EVENTS = 200  # of an arm
LOUD = ("diagnostics", "warning", "stop", "arm", "refused")  # kinds of events that were no part of the plan
_ORIGIN = ("command", "time", "version", "libraries", "machine")


def write_report_page(run: Run, values: Mapping[str, dict[str, Any]], folder: Path) -> Path:
    """Write the page of all arms beside their numbers and pictures, which are there already."""
    first = next(iter(run.values()))
    content: list[Html] = [element("p", _what(first), class_="quiet"), *_ends(values)]
    content += [element("h2", "Summary"), _summary(run, values)]
    for arm, place in places(run, folder).items():
        record, suffix = run[arm], f" of {arm}" if len(run) > 1 else ""
        content += [element("h2", f"Pictures{suffix}"), *_pictures(record, place)]
        content += [element("h2", f"Belief against the truth{suffix}"), *_contact(values[arm])]
        content += [element("h2", f"Settings{suffix}"), *_settings(record)]
        content += [element("h2", f"Events{suffix}"), *_events(record)]
    content += [element("h2", "How it was made"), *origin_table(first.origin)]
    return write_page(folder / NAME, f"{first.task_file or first.task} on {first.scene}", *content)


def _what(record: RunRecord) -> str:
    how = "simulated in one process, without ROS" if record.source == "offline" else "ROS nodes"
    return f"{how}, seed {record.seed}"


def _ends(values: Mapping[str, dict[str, Any]]) -> Iterator[Html]:
    for arm, numbers in values.items():
        name = f"{arm}: " if len(values) > 1 else ""
        if numbers["succeeded"]:
            yield element("p", f"{name}The task was done.", class_="good")
        else:
            yield element(
                "p", f"{name}The task failed: {numbers['reason'] or 'nobody said why'}", class_="bad"
            )
        for text in (*numbers["complaints"], numbers["bag_problem"]):
            if text:
                yield element("p", f"{name}{text}", class_="open")


def _summary(run: Run, values: Mapping[str, dict[str, Any]]) -> Html:
    rows = []
    for arm, numbers in values.items():
        for name, value, wanted in report_of(run[arm].task).summary(numbers):
            met = is_met(value, wanted)
            mark = "" if met is None else element("span", "yes" if met else "no", class_=_CLASS[met])
            rows.append((f"{arm}: {name}" if len(run) > 1 else name, value, wanted, mark))
    return table(["", "measured", "wanted", "met"], rows, numbers=(1, 2))


_CLASS = {True: "good", False: "bad"}


def is_met(value: str, wanted: str) -> bool | None:
    """Whether a value of a summary is what is wanted of it; None where nothing is, or nothing is known."""
    bound, limit = wanted.startswith("<="), _number(wanted.removeprefix("<="))
    found = _number(value)
    if not wanted or wanted == "as set" or value == "unknown":
        return None
    if found is None or limit is None:
        return value == wanted
    return found <= limit if bound else found == limit


def _number(text: str) -> float | None:
    try:
        return float(text.split()[0])
    except (ValueError, IndexError):
        return None


def _pictures(record: RunRecord, place: Path) -> Iterator[Html]:
    there = [place / name for name in report_of(record.task).pictures if (place / name).exists()]
    for path in there:
        yield picture(path, f"{path.stem.replace('_', ' ')} of {record.arm}")
    if not there:
        yield element("p", "There are none: the run did not come that far.", class_="quiet")


def _contact(numbers: Mapping[str, Any]) -> Iterator[Html]:
    contact = numbers.get("contact") or {}
    if not any(found["rms"] is not None for found in contact.values()):
        yield element("p", "Nobody knows the truth of this run, so beliefs have nothing to be held against.")
        return
    rows = [
        (label, f"{found['bias']:+.3f}", f"{found['rms']:.3f}", unit, f"{100 * found['in_2_sigma']:.0f} %")
        for (name, (label, unit)) in COMPONENT_NAMES.items()
        if (found := contact[name])["rms"] is not None
    ]
    columns = ["component", "mean error", "RMS error", "unit", "within 2 sigma"]
    yield table(columns, rows, numbers=(1, 2, 4))
    yield element(
        "p",
        "Over the task's own phase. The components are those of the Euler contact pose: depth z points into "
        "the surface and is positive in contact. Files that speak of rho and phi mean the inverse pose, "
        "whose rho_z is about the negative depth. An honest filter has 95 % within 2 sigma.",
        class_="quiet",
    )


def _settings(record: RunRecord) -> Iterator[Html]:
    if not record.settings:
        yield element("p", "This record does not say what the nodes were given.", class_="quiet")
        return
    rows = [
        (code(given.node), code(given.name), shown(given.value), _default(given))
        for given in differing(record)
    ]
    if rows:
        yield table(["node", "setting", "value", "default"], rows)
    else:
        yield element("p", "All are the defaults.")


def _default(given: Given) -> str:
    return "" if given.default is None else shown(given.default)


def _events(record: RunRecord) -> Iterator[Html]:
    for kind, count in record.result.get("refused", {}).items():
        yield element("p", f"Perception refused {count} times: {kind}", class_="open")
    if not record.events:
        yield element("p", "None are in this record.", class_="quiet")
        return
    start_ns, last = record.events[0].stamp_ns, record.events[-MOST_EVENTS:]
    if len(last) < len(record.events):
        counts = Counter(event.kind for event in record.events[: -len(last)])
        listed = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        yield element(
            "p", f"The first {len(record.events) - len(last)} are left out: {listed}.", class_="quiet"
        )
    rows = [_event_row(event, start_ns) for event in last]
    loud = sum(event.kind in LOUD for event in last)
    shut = element("summary", f"{len(last)} events, {loud} of them warnings, refusals or news of the arm")
    yield element("details", shut, table(["time [s]", "", ""], rows, numbers=(0,)))


def _event_row(event: Event, start_ns: int) -> Sequence[Any]:
    kind = element("span", event.kind, class_="open" if event.kind in LOUD else "quiet")
    return f"{(event.stamp_ns - start_ns) / SECOND_NS:.2f}", kind, event.text


def origin_table(origin: Mapping[str, str]) -> Iterator[Html]:
    """Command line, versions and machine, as `tactile_base.origin` has them."""
    if not origin:
        yield element("p", "This record does not say by which command, versions and machine it was made.")
        return
    names = (*_ORIGIN, *(name for name in origin if name not in _ORIGIN))
    yield table(["", ""], [(name, code(origin[name])) for name in names if name in origin])


def code(text: Any) -> Html:
    """As one types it."""
    return element("code", text)


def shown(value: Any) -> str:
    """A setting's value; numbers with as many digits as say something."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(shown, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
