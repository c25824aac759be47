"""The filters of the horizon test, as `python -m benchmarks.visibility_fit` fits them."""

from __future__ import annotations

import math

CELL, DEEP = 2.5, 1.5
"""Cells have this side, in spacings of the points; a point is enclosed if on two of the four lines through its cell the
cells on both sides are this much nearer."""
REACH = 4.5
"""Radius of the horizons that the filters read, in spacings of the points."""
BIAS = -2.905
"""Score + BIAS is the logarithm of the odds that a point is hidden."""
FILTERS: tuple[tuple[float, ...], ...] = (
    (-2.560, -4.308, 0.900, 0.291, -0.761, -2.814, -0.460, 0.669, 0.422, -2.254, 0.125),
    (1.024, -1.317, 1.252, 0.604, 1.138, -1.517, 0.849, 0.020, 1.029, -0.680, -0.599),
    (0.310, 3.153, 1.097, 0.096, 0.058, 1.120, 2.785, 0.897, -1.048, -2.476, -0.227),
    (0.013, 0.041, 4.296, 0.004, 0.022, 0.006, 4.322, 0.012, -0.020, 3.445, 0.209),
    (-0.073, -0.098, -2.617, -1.171, -2.384, -0.136, -0.054, 0.023, -5.606, -1.276, 5.023),
    (-1.582, -1.751, 0.241, -1.405, 0.297, -2.299, -2.604, 0.611, -0.683, 1.107, 0.773),
    (1.207, -0.142, -2.689, 2.468, -0.065, 0.948, -0.707, -0.031, 0.121, 2.093, 0.080),
    (-0.357, -0.207, 0.093, 0.343, -1.714, 1.148, 2.075, -2.925, -1.880, -3.035, 0.581),
)
"""Per filter: 8 weights, one for each sector; a bias; the weights of its mean and its maximum over 8 rotations."""


def limit_of(probability: float) -> float:
    """The score of the filters at which a point is hidden with the given probability."""
    p = min(max(probability, 1e-6), 1 - 1e-6)
    return math.log(p / (1 - p)) - BIAS
