"""A Dask cluster as a client of its scheduler, with errors that say what to do."""

from __future__ import annotations

from typing import Any


class ClusterError(ValueError):
    """A cluster that cannot be used."""


def cluster_client(scheduler: str) -> Any:
    """The `distributed.Client` of a scheduler's address; a context that ends the connection.

    Raises `ClusterError` if Dask is not installed or the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        if error.name not in ("distributed", "dask"):
            raise
        raise ClusterError("--scheduler needs Dask: pip install distributed") from error
    try:
        return Client(scheduler, timeout=10)
    except (OSError, ValueError, TypeError) as error:
        raise ClusterError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error
