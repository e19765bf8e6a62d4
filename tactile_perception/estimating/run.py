"""Runs a source of images through the estimator and, where poses are known, through the SE(3) filter."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.whole_file import write_csv
from tactile_filter.bayes_filter import Belief, ContactFilter, FilterSettings
from tactile_filter.force import ForceFilter
from tactile_filter.smoother import smooth
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.contact_model import POSE, SURFACE, ContactModel
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import EULER_COLUMNS
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.sources import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Series:
    """Means and standard deviations over the frames, (N, K) each, in mm, rad and N; NaN: none."""

    mean: Array
    sigma: Array


@dataclass
class EstimateTable:
    """One row a frame.

    Attributes
    ----------
    model : what the network tells, K quantities: xi_sf for a surface
    labels : (N, K) in mm, rad and N; NaN where a frame has no label
    network, filtered : estimates without and with the filter (or smoother)
    failures : frames on which the network gave no Gaussian, with what it said
    """

    model: ContactModel = SURFACE
    names: list[str] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    label_rows: list[Array] = field(default_factory=list)
    network_rows: list[tuple[Array, Array]] = field(default_factory=list)
    filtered_rows: list[tuple[Array, Array]] = field(default_factory=list)
    stage_seconds: list[tuple[float, float, float]] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def labels(self) -> Array:
        return np.array(self.label_rows).reshape(-1, self.model.size)

    @property
    def network(self) -> Series:
        return _series(self.network_rows, self.model.size)

    @property
    def filtered(self) -> Series:
        return _series(self.filtered_rows, self.model.size)

    @property
    def has_labels(self) -> bool:
        return bool(np.isfinite(self.labels).any())

    @property
    def has_filter(self) -> bool:
        return bool(np.isfinite(self.filtered.mean).any())

    @property
    def series(self) -> dict[str, Series]:
        """What there is to show, by name."""
        return {"network": self.network} | ({"with filter": self.filtered} if self.has_filter else {})

    def mean_absolute_error(self, series: Series) -> Array:
        """MAE (K,) in mm, rad and N over the frames that have both; NaN without labels."""
        errors = np.abs(self.model.error(series.mean, self.labels))
        count = np.isfinite(errors).sum(axis=0)
        return np.where(count > 0, np.nansum(errors, axis=0) / np.maximum(count, 1), np.nan)

    def write_csv(self, path: Path) -> None:
        """Write it as a table: labels, estimates and sigmas, and X_fs as Euler pose in mm and degrees."""
        kinds = ("label", "network", "filtered", "network_sigma", "filtered_sigma")
        header = [f"{kind}_{column}" for kind in kinds for column in self.model.columns]
        header += [f"{kind}_{column}" for kind in ("network", "filtered") for column in EULER_COLUMNS]
        rows = []
        for index, name in enumerate(self.names):
            network, filtered = self.network_rows[index], self.filtered_rows[index]
            values = [self.label_rows[index], network[0], filtered[0], network[1], filtered[1]]
            values += [self._euler(network[0]), self._euler(filtered[0])]
            texts = ["" if np.isnan(value) else f"{value:.6g}" for value in np.concatenate(values)]
            rows.append([name, self.stamps_ns[index], *texts])
        write_csv(path, ["name", "stamp_ns", *header], rows)

    def _euler(self, mean: Array) -> Array:
        return self.model.euler(mean[None])[0] if np.isfinite(mean[:POSE]).all() else np.full(POSE, np.nan)


def run_estimates(
    estimator: Estimator,
    frames: Iterable[Frame],
    contact_filter: ContactFilter | None,
    progress: Callable[[int], None] | None = None,
    smoothed: bool = False,
) -> EstimateTable:
    """Estimate every frame; filter those that come with a pose.

    With `smoothed`, what the filter believes is smoothed in the end: it then knows what came later. A frame
    on which the network fails is kept with NaN and named in `failures`; an image of the wrong size or type
    raises `ImageError`, for then all of them are wrong.
    """
    model = estimator.metadata.contact_model
    table = EstimateTable(model)
    perceive, force_filter = Perceiver(estimator), ForceFilter()
    nothing = np.full((2, model.size), np.nan)
    steps: list[tuple[int, Belief, Array]] = []  # row, belief, pose of the sensor
    for frame in frames:
        table.names.append(frame.name)
        table.stamps_ns.append(frame.stamp_ns)
        table.label_rows.append(nothing[0] if frame.label is None else frame.label_for(model))
        network = filtered = (nothing[0], nothing[1])
        percept = perceive(frame.image, frame.processed)
        if percept.estimate is None:
            table.failures.append(f"{frame.name}: {percept.fault}")
        else:
            network = model.row(percept.estimate, percept.force)
            times = estimator.times
            table.stage_seconds.append((times.preprocess, times.infer, times.convert))
            if contact_filter is not None and frame.T_base_sensor is not None:
                belief = contact_filter.step(frame.stamp_ns, percept.estimate, frame.T_base_sensor)
                steps.append((len(table) - 1, belief, frame.T_base_sensor))
                if percept.force is not None:
                    force_filter.step(frame.stamp_ns, percept.force)
                filtered = model.row(PoseGaussian(belief.mean, belief.cov), force_filter.belief)
        table.network_rows.append(network)
        table.filtered_rows.append(filtered)
        if progress is not None:
            progress(len(table))
    if smoothed and contact_filter is not None:
        _smooth(table, steps, contact_filter.settings)
    return table


def _smooth(table: EstimateTable, steps: list[tuple[int, Belief, Array]], settings: FilterSettings) -> None:
    beliefs = smooth([belief for _, belief, _ in steps], [pose for _, _, pose in steps], settings)
    for (row, _, _), belief in zip(steps, beliefs, strict=True):
        if belief.valid:
            mean, sigma = table.model.row(PoseGaussian(belief.mean, belief.cov), None)
            for smoothed, filtered in zip((mean, sigma), table.filtered_rows[row], strict=True):
                filtered[:POSE] = smoothed[:POSE]  # of the force it knows nothing


def _series(rows: list[tuple[Array, Array]], size: int) -> Series:
    return Series(*np.array(rows).reshape(-1, 2, size).swapaxes(0, 1))
