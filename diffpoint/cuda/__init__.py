"""The operators on CUDA tensors, as Triton kernels. Nothing here is imported before an operator meets a CUDA tensor.

Each module holds kernels and, under the names of operators, the functions that launch them: they take and return what
the operator of `torch.ops.diffpoint` does, on the device of their arguments.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable

_MODULES = {
    "nearest": ("nearest", "nearest_backward", "nearest_both", "nearest_both_backward", "shares_within"),
    "splat": ("splat", "splat_backward"),
    "sampling": ("farthest_point_sample",),
    "softmatch": ("approxmatch",),
    "transport": ("earth_mover_distance", "earth_mover_distance_backward"),
    "soft_splat": ("soft_splat", "soft_splat_backward"),
    "visibility": ("visible",),
    "views": ("sample_view", "sample_view_backward"),
    "reproject": (
        "project",
        "project_backward",
        "unproject",
        "unproject_backward",
        "reproject",
        "reproject_backward",
    ),
}
_MODULE_OF = {operator: module for module, operators in _MODULES.items() for operator in operators}


@functools.cache
def kernel_of(operator: str) -> Callable | None:
    """The function that runs an operator on CUDA tensors; None if it has no kernel.

    Raises:
        ImportError: triton is missing.
    """
    module = _MODULE_OF.get(operator)
    return None if module is None else getattr(importlib.import_module(f"diffpoint.cuda.{module}"), operator)
