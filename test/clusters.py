"""Dask schedulers with workers on this machine."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def local_cluster(processes: bool = False, workers: int = 1, threads: int = 2) -> Iterator[str]:
    """The address of a scheduler whose workers are threads of this process, or processes."""
    distributed = pytest.importorskip("distributed", reason="needs Dask (the extra 'cluster')")
    with distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=threads,
        processes=processes,
        dashboard_address=None,
        protocol="tcp",
    ) as local:
        yield local.scheduler_address
