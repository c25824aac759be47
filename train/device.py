"""Where networks are computed: on the CPU, or on an NVIDIA GPU. It belongs to where a command runs, not to a recipe."""

from __future__ import annotations

import os

import torch
from torch import Tensor

from train.errors import UserError

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
