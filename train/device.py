"""Where networks are computed: the device, and the processes that share a batch.

The device is the CPU or an NVIDIA GPU. It belongs to where a command runs, not to a recipe.

The processes are a single one, or those that torchrun has started. All draw the same random numbers and take equal
parts of every batch, so that the mean of their gradients is the gradient of one process on the whole batch. The means
are computed here and not by a wrapper around the networks, because the critic's penalty differentiates twice and the
generator is called in parts.
"""

from __future__ import annotations

import atexit
import functools
import os
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

import diffpoint
from train.errors import UserError

if TYPE_CHECKING:
    from lightning_fabric import Fabric

CPU = torch.device("cpu")

_CHOICES = ("auto", "cpu", "cuda")
_ENVIRONMENT = "DIFFPOINT_DEVICE"
_SHARE_OF_MEMORY = 0.4
"""Of a GPU's free memory, for the views of one split of the data: the rest is left to other splits and the step."""


def use_device(wanted: str = "auto") -> torch.device:
    """The device that a command names, with torch set up for it; see `prepare`.

    Args:
        wanted: "cpu"; "cuda", a GPU; or "auto", which is what the environment variable DIFFPOINT_DEVICE says, else a
            GPU if torch finds one. Of several processes that torchrun has started, each takes the GPU of its
            LOCAL_RANK.

    Raises:
        UserError: there is no such device; says what is missing.

    Example:
        >>> use_device("cpu")
        device(type='cpu')
    """
    chosen = os.environ.get(_ENVIRONMENT, "auto") if wanted == "auto" else wanted
    if chosen not in _CHOICES:
        name = _ENVIRONMENT if wanted == "auto" else "--device"
        raise UserError(f"{name} must be one of {', '.join(_CHOICES)}; got {chosen!r}")
    if chosen == "cpu" or (chosen == "auto" and not torch.cuda.is_available()):
        return CPU
    if torch.version.cuda is None and torch.version.hip is None:
        raise UserError(
            f"--device cuda needs a torch that is built for GPUs, and torch {torch.__version__} is built for the CPU "
            "alone: install another (https://pytorch.org/get-started), or use --device cpu"
        )
    count, rank = torch.cuda.device_count(), int(os.environ.get("LOCAL_RANK", "0"))
    if count == 0 or not torch.cuda.is_available():
        hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
        raise UserError(
            f"--device cuda: torch {torch.__version__} is built for CUDA {torch.version.cuda}, but finds no GPU. "
            "`nvidia-smi` must list one, and its driver must be new enough for this CUDA"
            + ("" if hidden is None else f"; CUDA_VISIBLE_DEVICES is {hidden!r}")
            + "; or use --device cpu"
        )
    if rank >= count:
        raise UserError(
            f"process {rank} of this machine has no GPU: there {'is' if count == 1 else 'are'} {count}. Start at most "
            f"that many processes (torchrun --nproc_per_node {count}), or use --device cpu"
        )
    device = torch.device("cuda", rank)
    prepare(device)
    return device


def prepare(device: torch.device) -> None:
    """Sets torch up for a device; nothing for the CPU.

    On a GPU the same inputs shall give the same bits, so that an interrupted training can continue to the same bits:
    cuDNN chooses its algorithms without timing them, and torch takes the deterministic one of an operation's
    implementations, or warns where there is none. Float32 means float32: TF32 is off, outside networks that ask for it.
    """
    if device.type != "cuda":
        return
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read when cuBLAS starts
    torch.cuda.set_device(device)
    torch.backends.cudnn.benchmark = False
    torch.backends.cudnn.deterministic = True
    torch.use_deterministic_algorithms(True, warn_only=True)
    # A help for debugging, which writes all new memory.
    torch.utils.deterministic.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False


def describe(device: torch.device) -> str:
    """A device's name for people.

    Example:
        >>> describe(CPU)
        'cpu'
    """
    if device.type != "cuda":
        return str(device)
    about = torch.cuda.get_device_properties(device)
    return f"{device} ({about.name}, {about.total_memory / 2**30:.0f} GiB)"


def moved(values: Tensor, device: torch.device) -> Tensor:
    """Values on a device. A copy from the CPU goes through pinned memory, so that the caller does not wait for it."""
    if device.type == "cpu" or not values.is_cpu:
        return values.to(device)
    return values.contiguous().pin_memory().to(device, non_blocking=True)


def room_for_views(device: torch.device) -> float:
    """Bytes that the views of a split may take on a device."""
    if device.type != "cuda":
        return float("inf")
    free, _ = torch.cuda.mem_get_info(device)
    return _SHARE_OF_MEMORY * free


# --- the processes that share a batch


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
    # Threads of the connection that are still there when the interpreter ends abort the process, now and then.
    atexit.register(_disconnect)
    return Group(fabric)


def _disconnect() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
