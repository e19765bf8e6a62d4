"""The processes that train one network together, started by torchrun; or this one alone.

    torchrun --standalone --nproc-per-node 4 --no-python tactile train DATA --out RUN

Each takes its share of every batch, gradients are averaged (PyTorch DDP), and the first does what is done
once: it validates, writes the run folder and reports.
"""

from __future__ import annotations

import os
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import distributed, nn

from tactile_base.settings import SettingError

T = TypeVar("T")
#: That the others wait for the first, which validates and exports.
_PATIENCE = timedelta(hours=2)


class Processes:
    """Rank of this process, and how many there are; use as a context.

    Attributes
    ----------
    device : where this process computes
    """

    def __init__(self) -> None:
        self.rank, self.count = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        local = int(os.environ.get("LOCAL_RANK", 0))
        self.device = torch.device("cuda", local) if torch.cuda.is_available() else torch.device("cpu")

    def __enter__(self) -> Processes:
        if self.count > 1:
            backend = "gloo" if self.device.type == "cpu" else "nccl"
            distributed.init_process_group(backend, timeout=_PATIENCE)
        return self

    def __exit__(self, *exception: object) -> None:
        if self.count > 1:
            distributed.destroy_process_group()

    @property
    def first(self) -> bool:
        return self.rank == 0

    def share(self, batch_size: int, samples: int) -> int:
        """Samples that each process takes of a batch; `SettingError` where that is no fair share."""
        if self.count == 1:
            return batch_size
        share, rest = divmod(batch_size, self.count)
        if rest or share < 2 or samples < batch_size:
            raise SettingError(
                f"training.batch_size = {batch_size}: is the batch of all {self.count} processes, which take "
                f"the same part of it, two samples at least, and of {samples} samples not more than these: "
                f"give --set training.batch_size={16 * self.count}, or start fewer processes"
            )
        return share

    def told(self, value: T) -> T:
        """The first process's value, in all of them."""
        if self.count == 1:
            return value
        values: list[Any] = [value]
        distributed.broadcast_object_list(values, device=self.device)
        result: T = values[0]
        return result

    def mean(self, value: float) -> float:
        """Of all processes."""
        if self.count == 1:
            return value
        total = torch.tensor(value, dtype=torch.float64, device=self.device)
        distributed.all_reduce(total)
        return total.item() / self.count

    def joined(self, module: nn.Module, partly_used: bool) -> nn.Module:
        """A module whose gradients are those of all processes.

        `partly_used`: there are steps in which a parameter has no part.
        """
        if self.count == 1:
            return module
        devices = None if self.device.type == "cpu" else [self.device]
        return nn.parallel.DistributedDataParallel(
            module, device_ids=devices, find_unused_parameters=partly_used
        )
