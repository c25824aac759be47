"""The compiler of the kernels, under the name that their sources use."""

from diffpoint._backend import import_backend

ti = import_backend()

__all__ = ["ti"]
