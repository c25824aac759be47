"""The processes that share a batch: a single one, or those that torchrun has started.

All processes draw the same random numbers and take equal parts of every batch, so that the mean of their gradients is
the gradient of one process on the whole batch. The means are computed here and not by a wrapper around the networks,
because the critic's penalty differentiates twice and the generator is called in parts.
"""

from __future__ import annotations

import functools
import os
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

import diffpoint
from train.device import CPU, prepare
from train.errors import UserError

if TYPE_CHECKING:
    from lightning_fabric import Fabric


class World:
    """A single process: collectives are no-ops, and its shard of a batch is the whole batch.

    Args:
        device: on which this process trains.
    """

    rank, size = 0, 1

    def __init__(self, device: torch.device = CPU) -> None:
        self.device = device

    @property
    def is_main(self) -> bool:
        """Is this the one process that writes files?"""
        return self.rank == 0

    def shard(self, values: Tensor, dim: int = 0) -> Tensor:
        """This process's equal part of a batch that all processes drew identically."""
        part = values.shape[dim] // self.size
        return values.narrow(dim, self.rank * part, part)

    def average_gradients(self, network: nn.Module) -> None:
        """Replaces every process's gradients by the mean over all processes."""

    def sum(self, values: Tensor) -> Tensor:
        """All-reduce: the sum over the processes' tensors."""
        return values

    def mean(self, values: Tensor) -> Tensor:
        """All-reduce: the mean over the processes' tensors."""
        return self.sum(values) / self.size

    def any(self, flag: bool) -> bool:
        """Is `flag` true in any process?"""
        return flag

    def barrier(self) -> None:
        """Waits until all processes have reached this call."""


SINGLE = World()


class Group(World):
    """Processes connected by Lightning Fabric."""

    def __init__(self, fabric: Fabric) -> None:
        super().__init__(fabric.device)
        self._fabric = fabric
        self.rank, self.size = fabric.global_rank, fabric.world_size
        # Flags of the programs must not wait for what their GPUs have in the queue.
        self._programs = torch.distributed.new_group(backend="gloo") if self.device != CPU else None

    def average_gradients(self, network: nn.Module) -> None:
        """One message for all gradients. A parameter without a gradient has none in every process."""
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        mean = self.mean(torch.cat([gradient.reshape(-1) for gradient in gradients]))
        for gradient, part in zip(gradients, mean.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))

    def sum(self, values: Tensor) -> Tensor:
        """All-reduce: the sum over the processes' tensors."""
        total = self._fabric.all_reduce(values.clone(), reduce_op="sum")
        assert isinstance(total, Tensor)
        return total

    def any(self, flag: bool) -> bool:
        """Is `flag` true in any process?"""
        flags = torch.tensor(float(flag))
        torch.distributed.all_reduce(flags, group=self._programs)
        return bool(flags > 0)

    def barrier(self) -> None:
        """Waits until all processes have reached this call."""
        self._fabric.barrier()


@functools.cache
def connect(device: torch.device = CPU) -> World:
    """Connects the processes that torchrun started; every one of them must call it, with its own device of one type.

    The cores of a machine are divided among its processes, for torch and for the kernels.

    Raises:
        UserError: there are several processes, and Lightning Fabric is not installed.
    """
    prepare(device)
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return SINGLE if device == CPU else World(device)
    try:
        from lightning_fabric import Fabric  # a single process does not need it
    except ImportError:
        raise UserError(
            "more than one process needs Lightning Fabric: pip install lightning-fabric"
        ) from None
    here, machines = (int(os.environ.get(name, "1")) for name in ("LOCAL_WORLD_SIZE", "GROUP_WORLD_SIZE"))
    threads = max(1, diffpoint.runtime_info().threads // here)
    torch.set_num_threads(threads)
    diffpoint.configure(threads=threads)
    # It connects GPUs through nccl, CPUs through gloo, and gives each process the GPU of its LOCAL_RANK.
    fabric = Fabric(accelerator=device.type, strategy="ddp", devices=here, num_nodes=machines)
    fabric.launch()
    return Group(fabric)
