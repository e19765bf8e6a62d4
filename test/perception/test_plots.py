"""Figures: what stands at their axes can be read."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from tactile_perception.estimating.plots import draw_predicted_against_actual, log_axis


def texts(axis) -> list[str]:
    axis.figure.canvas.draw()
    return [label.get_text() for label in axis.get_ticklabels() if label.get_text()]


@pytest.mark.parametrize("low, high", [(0.006, 0.03), (0.4, 4.0), (0.41, 0.46), (1e-4, 1e3), (3e-3, 2.0)])
def test_ticks_of_a_logarithmic_axis_are_a_few_plain_numbers(low, high):
    axes = Figure(figsize=(2.5, 4.0)).subplots()
    axes.plot([low, high], [low, high])
    log_axis(axes, "x")
    axes.set_xlim(low, high)
    found = texts(axes.xaxis)
    assert 2 <= len(found) <= 8
    assert all("$" not in text and float(text) > 0.0 for text in found)


def test_a_large_precision_needs_no_power_of_ten_over_its_bar(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    actual = np.random.default_rng(0).normal(size=(50, 6))
    sigma = np.full((50, 6), 1e-3) * np.linspace(1.0, 2.0, 50)[:, np.newaxis]
    draw_predicted_against_actual(tmp_path / "a.png", [("network", actual, actual, sigma)], "test")
    [figure] = figures
    bars = [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]
    assert len(bars) == 6
    for bar in bars:
        assert texts(bar.yaxis)[-1].endswith(("k", "M")) and bar.yaxis.get_offset_text().get_text() == ""
        assert bar.get_ylabel() in ("precision (1/mm²)", "precision (1/rad²)")
