"""The group of processes that share a batch: one alone, or those that torchrun has started.

All of them draw the same random numbers and take equal parts of every batch; then the mean of their gradients is
the gradient of one process on the whole. The means are taken by hand and not in a wrapper around the networks,
because the critic's penalty differentiates twice and the generator is called by parts.
"""

from __future__ import annotations

import functools
import os
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

import diffpoint
from train.errors import UserError

if TYPE_CHECKING:
    from lightning_fabric import Fabric


class World:
    """One process, which needs nobody. Its share of anything is all of it."""

    rank, size = 0, 1

    @property
    def writes(self) -> bool:
        """Does this process write files? One of the group does."""
        return self.rank == 0

    def share(self, values: Tensor, dim: int = 0) -> Tensor:
        """This process's equal part of what the whole group drew alike."""
        part = values.shape[dim] // self.size
        return values.narrow(dim, self.rank * part, part)

    def average_gradients(self, network: nn.Module) -> None:
        """Makes every process's gradients the mean over all of them."""

    def sum(self, values: Tensor) -> Tensor:
        """The sum of every process's tensor, on all of them."""
        return values

    def mean(self, values: Tensor) -> Tensor:
        """The mean of every process's tensor, on all of them."""
        return self.sum(values) / self.size

    def any(self, flag: bool) -> bool:
        """Is it true in any process?"""
        return flag

    def wait(self) -> None:
        """Until all have come here."""


ALONE = World()


class Group(World):
    """The processes that Lightning Fabric has connected."""

    def __init__(self, fabric: Fabric) -> None:
        self._fabric = fabric
        self.rank, self.size = fabric.global_rank, fabric.world_size

    def average_gradients(self, network: nn.Module) -> None:
        """One message for all gradients; a parameter without one is left out everywhere alike."""
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        mean = self.mean(torch.cat([gradient.reshape(-1) for gradient in gradients]))
        for gradient, part in zip(gradients, mean.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))

    def sum(self, values: Tensor) -> Tensor:
        """The sum of every process's tensor, on all of them."""
        total = self._fabric.all_reduce(values.clone(), reduce_op="sum")
        assert isinstance(total, Tensor)
        return total

    def any(self, flag: bool) -> bool:
        """Is it true in any process?"""
        return bool(self.sum(torch.tensor(float(flag))) > 0)

    def wait(self) -> None:
        """Until all have come here."""
        self._fabric.barrier()


@functools.cache
def gather() -> World:
    """The group of processes that torchrun started this one in; every one of them must call it.

    The cores of a machine are divided among its processes, for torch and for the kernels.

    Raises:
        UserError: there is a group, and Lightning Fabric is not installed.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return ALONE
    try:
        from lightning_fabric import Fabric  # not needed, and not paid for, by one process
    except ImportError:
        raise UserError(
            "more than one process needs Lightning Fabric: pip install lightning-fabric"
        ) from None
    here, machines = (int(os.environ.get(name, "1")) for name in ("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE"))
    threads = max(1, diffpoint.runtime_info().threads // here)
    torch.set_num_threads(threads)
    diffpoint.configure(threads=threads)
    fabric = Fabric(accelerator="cpu", strategy="ddp", devices=here, num_nodes=machines)
    fabric.launch()
    return Group(fabric)
