"""The group of processes that share a batch: none by default."""

from __future__ import annotations

from torch import Tensor, nn


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


def gather() -> World:
    """The group of processes that this one was started in."""
    return ALONE
