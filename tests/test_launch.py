"""Kernels called past Taichi's own call: the same results, and its own call wherever the arguments do not fit."""

import pytest
import torch

import diffpoint as dp
from diffpoint._runtime import RUNTIME

CAMERA = dp.PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=6, width=7)


def arguments(count: int) -> tuple:
    points = torch.rand(2 * count * 3, generator=torch.Generator().manual_seed(0)) - 0.5
    projection = CAMERA.projection.expand(2, 3, 4).reshape(-1)
    outputs = torch.zeros(2 * count * 2), torch.zeros(2 * count), torch.zeros(2)
    return points, projection, *outputs, 1, count, 1


def test_the_first_call_and_later_ones_agree_with_taichis():
    dp.project(torch.zeros(1, 1, 3), CAMERA)  # starts the kernels
    call = RUNTIME.call("reproject", "project", "f32")
    for count in (5, 40, 0):
        ours, theirs = arguments(count), arguments(count)
        call(RUNTIME.current_program(), ours)
        RUNTIME.kernel("reproject", "f32").project(*theirs)
        for x, y in zip(ours, theirs, strict=True):
            assert torch.equal(torch.as_tensor(x), torch.as_tensor(y))
    if RUNTIME.backend().__name__ == "taichi":
        assert call.program is RUNTIME.current_program(), "Taichi's own call was used throughout"


def test_arguments_of_another_type_are_left_to_taichi():
    dp.project(torch.zeros(1, 1, 3), CAMERA)
    call = RUNTIME.call("reproject", "project", "f32")
    call(RUNTIME.current_program(), arguments(5))
    points, *others = arguments(5)
    for wrong in (points.double(), points.view(-1, 3), points[::2]):
        with pytest.raises(Exception, match=r"(?i)dtype|dimension|contiguous"):
            call(RUNTIME.current_program(), (wrong, *others))
    call(RUNTIME.current_program(), arguments(5))
