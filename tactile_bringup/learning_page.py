"""The page at the end of `tactile sensor learn`: how good the network is, what more contacts would give."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_base import html_page as html
from tactile_base.origin import origin
from tactile_bringup.learning import JUDGING, UNITS, Judged, Promise, evaluated, with_more
from tactile_perception.estimating.contact_model import ContactModel
from tactile_perception.estimating.plots import draw_predicted_against_actual, log_axis, plot_grid
from tactile_perception.evaluation.evaluate import EvaluationData, ModelResult
from tactile_records.runs.page import origin_table

Array = NDArray[np.float64]

EXAMPLES = 8
DPI = 110


def write(folder: Path, found: Sequence[Judged], best: Judged, run: Path, promise: Promise) -> list[Path]:
    """Write `report.html` with its pictures; `best` is the round whose network, of `run`, is taken."""
    data, result, estimator = evaluated(run, folder / JUDGING)
    pictures = [folder / name for name in ("errors.png", "predicted.png", "examples.png")]
    _draw_errors(pictures[0], found, promise)
    predictions = result.best.predictions
    sigma = None if predictions.cov is None else predictions.sigma
    rows = [("network", data.targets, predictions.mean, sigma)]
    title = f"{len(data)} contacts that were held back"
    draw_predicted_against_actual(pictures[1], rows, title, result.names, result.units)
    _draw_examples(pictures[2], data, result)
    kept = promise.kept_by(best)
    verdict = f"The promise of {promise} is {'kept' if kept else 'not kept'}"
    why = "" if kept else ", by the upper ends of the bands" if len(promise.errors) else ""
    content = [
        html.element("p", f"{verdict}{why}: {best.line()}.", class_="good" if kept else "bad"),
        _table(found, promise),
        html.element("p", _more(found)),
        html.picture(pictures[0], "Errors by the number of contacts"),
        html.element("h2", "On contacts that no network has learnt from"),
        html.picture(pictures[1], "Predicted against actual"),
        html.picture(pictures[2], "Examples"),
        html.element("h2", "The model"),
        html.table(["", ""], _facts(estimator.path, best)),
        html.element("h2", "How it was made"),
        *origin_table(origin()),
    ]
    return [html.write_page(folder / "report.html", "A network for this sensor", *content), *pictures]


def _table(found: Sequence[Judged], promise: Promise) -> html.Html:
    """A row a round."""
    names = list(found[-1].errors)
    heads = [f"{name} ({UNITS[name]})" for name in names]
    rows = []
    for judged in found:
        cells = ["{:.3g} ({:.3g} to {:.3g})".format(*judged.errors[name]) for name in names]
        shares = ["" if part is None else f"{part:.1%}" for part in (judged.coverage, judged.foreign)]
        rows.append([judged.contacts, judged.held_back, *cells, *shares])
    wanted = [f"{promise.errors[name]:g}" if name in promise.errors else "" for name in names]
    rows.append(["promised", "", *wanted, "95 %", ""])
    columns = ["contacts", "held back", *heads, "within 95 %", "foreign"]
    return html.table(columns, rows, range(len(columns)))


def _more(found: Sequence[Judged]) -> str:
    """What twice as many contacts would give."""
    twice = 2 * found[-1].contacts
    expected = {name: with_more(found, name, twice) for name in found[-1].errors}
    if not all(np.isfinite(value) for value in expected.values()):
        return "What more contacts would give is told from the second round on."
    words = (f"{name} {value:.2g} {UNITS[name]}" for name, value in expected.items())
    return f"If errors go on falling as from round to round, {twice} contacts would give {', '.join(words)}."


def _facts(model: Path, best: Judged) -> list[tuple[str, str]]:
    """What its user should know."""
    foreign = "not told" if best.foreign is None else f"{best.foreign:.1%} of the images held back"
    return [
        ("file", str(model)),
        ("errors", "mean absolute errors, with 95 % bootstrap bands, of the contact pose"),
        ("foreign", f"{foreign} are beyond the limit from which on an image is not believed"),
    ]


def _draw_errors(path: Path, found: Sequence[Judged], promise: Promise) -> None:
    names = list(found[-1].errors)
    figure, grid = plot_grid(1, len(names), 2.8)
    contacts = [judged.contacts for judged in found]
    for name, axes in zip(names, grid[0], strict=True):
        value, low, high = np.array([judged.errors[name] for judged in found]).T
        axes.errorbar(contacts, value, [value - low, high - value], fmt="o-", capsize=3, markersize=4)
        if name in promise.errors:
            axes.axhline(promise.errors[name], color="tab:green", linestyle="--", linewidth=1)
            axes.set_title(f"{name}; promised {promise.errors[name]:g} {UNITS[name]}", fontsize=10)
        else:
            axes.set_title(name, fontsize=10)
        axes.set(xlabel="contacts", ylabel=f"mean absolute error ({UNITS[name]})")
        for which in "xy":
            log_axis(axes, which)
    figure.savefig(path, dpi=DPI)


def _draw_examples(path: Path, data: EvaluationData, result: ModelResult) -> None:
    """Images as the network sees them, evenly over depth, each with its label and what the network says."""
    order = np.argsort(data.euler_mm_deg[:, 2])
    chosen = order[np.linspace(0, len(order) - 1, min(EXAMPLES, len(order))).round().astype(int)]
    (images,) = data.images.values()
    mean = np.zeros((len(data), data.model.size))
    mean[:, list(data.compared)] = result.best.predictions.mean
    said, told = data.model.euler(mean), data.model
    figure = Figure(figsize=(2.2 * 4, 2.75 * -(-len(chosen) // 4)), layout="constrained")
    grid = figure.subplots(-(-len(chosen) // 4), 4, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    for axes, row in zip(grid, chosen, strict=False):
        image = images[row]
        axes.imshow(image if image.ndim == 2 else image[:, :, ::-1], cmap="gray", vmin=0, vmax=255)
        axes.set_title(f"{_words(data.euler_mm_deg[row], told)}\nsays {_words(said[row], told)}", fontsize=8)
    figure.savefig(path, dpi=DPI)


def _words(euler: Array, model: ContactModel) -> str:
    """What matters most of a contact (6,), mm and deg: depth and tilt, or depth, offset and direction."""
    if model.directed:
        return "{2:.1f} mm, {1:.1f} mm, {5:.0f} deg".format(*euler)
    return "{2:.1f} mm, {3:.0f}, {4:.0f} deg".format(*euler)
