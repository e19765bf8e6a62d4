"""Where the batches of a training run come from: images in memory, or a stream of shards."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import islice
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile_perception.datasets.layout import DatasetError
from tactile_perception.datasets.shards import IMAGE, ShardedFolder
from tactile_perception.estimating.image import Image
from tactile_perception.training.processes import Processes

T = TypeVar("T")
R = TypeVar("R")
Rows = NDArray[np.int64]
#: Samples in memory where data are streamed: to validate and calibrate on, and for what is fitted once.
SAMPLED = 20_000
_MIXED = 16  # groups of rows
_AHEAD = 4  # batches


class Feed(Protocol):
    """Training samples; `labels` (N, K) are those of all, in mm, rad and N."""

    labels: NDArray[np.float64]

    def steps(self, batch_size: int, processes: Processes) -> int:
        """Batches in a pass over the samples."""

    def batches(
        self, batch_size: int, rng: np.random.Generator, processes: Processes
    ) -> Iterator[tuple[Rows, Image]]:
        """A pass: this process's share of each batch, as rows of `labels` and images.

        `rng` is in the same state in all processes.
        """


class MemoryFeed:
    """All images in memory, each pass in an order of its own."""

    def __init__(self, images: Image, labels: NDArray[np.float64]) -> None:
        self.labels, self._images = labels, images

    def steps(self, batch_size: int, processes: Processes) -> int:
        # A last batch of one sample would leave batch normalization without a variance.
        return max(1, len(self._images) // batch_size)

    def batches(
        self, batch_size: int, rng: np.random.Generator, processes: Processes
    ) -> Iterator[tuple[Rows, Image]]:
        order = rng.permutation(len(self._images))
        for step in range(self.steps(batch_size, processes)):
            batch = order[step * batch_size : (step + 1) * batch_size]
            own = batch[processes.rank :: processes.count]
            yield own, self._images[own]


class ShardFeed:
    """Images read from shards as they are needed; each process reads groups of its own, and mixes some."""

    def __init__(self, source: ShardedFolder, rows: Rows, labels: NDArray[np.float64]) -> None:
        """`rows` (N,) of the data set, ascending, are the samples; images get the size that `source` has."""
        self.labels, self._source, self._rows = labels, source, rows
        ends = np.searchsorted(rows, [group.stop for group in source.groups])
        self._slices = list(zip([0, *ends[:-1]], ends, strict=True))
        self._preprocessor = source.preprocessor_of_thread()

    def steps(self, batch_size: int, processes: Processes) -> int:
        """What the process with the fewest and smallest groups has, so that none waits for another."""
        count = len(self._slices) // processes.count
        if count == 0:
            raise DatasetError(
                f"{self._source.folder}: has {len(self._slices)} groups of samples, fewer than "
                f"{processes.count} processes: `tactile data shard --group` makes smaller ones"
            )
        fewest = sum(sorted(int(stop - start) for start, stop in self._slices)[:count])
        return max(1, fewest // processes.share(batch_size, len(self.labels)))

    def batches(
        self, batch_size: int, rng: np.random.Generator, processes: Processes
    ) -> Iterator[tuple[Rows, Image]]:
        groups = rng.permutation(len(self._slices))[processes.rank :: processes.count]
        mixing = np.random.default_rng([int(rng.integers(2**62)), processes.rank])
        with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(os.cpu_count()) as pool:
            stored = _ahead(reader, self._stored, groups.tolist(), _MIXED)
            share = processes.share(batch_size, len(self.labels))
            batches = islice(_mixed(stored, share, mixing), self.steps(batch_size, processes))
            yield from _ahead(pool, self._images, batches, _AHEAD)

    def _stored(self, group: int) -> list[tuple[int, bytes]]:
        """Samples of a group: rows of `labels`, and images as they are stored."""
        images, first = self._source.groups[group].column(IMAGE), self._source.groups[group].start
        samples = range(*self._slices[group])
        return [(sample, images[int(self._rows[sample]) - first].as_py()) for sample in samples]

    def _images(self, batch: list[tuple[int, bytes]]) -> tuple[Rows, Image]:
        source, preprocessor = self._source, self._preprocessor()
        images = [source.resized(int(self._rows[sample]), preprocessor, data) for sample, data in batch]
        return np.array([sample for sample, _ in batch]), np.stack(images)


def spread_rows(source: ShardedFolder, rows: Rows, most: int | None = None) -> Rows:
    """Up to `most` of the rows (SAMPLED), those of some groups at random, so that few need to be read."""
    most = SAMPLED if most is None else most
    if len(rows) <= most:
        return rows
    order = np.random.default_rng(0).permutation(len(source.groups))
    chosen, count = [], 0
    for number in order:
        group = source.groups[number]
        own = rows[np.searchsorted(rows, group.start) : np.searchsorted(rows, group.stop)]
        chosen.append(own[: most - count])
        count += len(chosen[-1])
    return np.sort(np.concatenate(chosen))


def _mixed(
    groups: Iterable[list[tuple[int, bytes]]], share: int, rng: np.random.Generator
) -> Iterator[list[tuple[int, bytes]]]:
    """Batches of `share` samples, each from `_MIXED` groups at random; the last may lack some."""
    waiting: list[tuple[int, bytes]] = []
    groups = iter(groups)
    while some := [sample for group in islice(groups, _MIXED) for sample in group]:
        waiting += [some[k] for k in rng.permutation(len(some))]
        while len(waiting) >= share:
            yield waiting[:share]
            del waiting[:share]
    if waiting:
        yield waiting


def _ahead(pool: Executor, work: Callable[[T], R], items: Iterable[T], count: int) -> Iterator[R]:
    """Results in order, of up to `count` items at a time more than were asked for."""
    waiting: deque = deque()
    for item in items:
        waiting.append(pool.submit(work, item))
        if len(waiting) > count:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
