"""Which points of a cloud a camera sees: the paper's z-buffer, and more accurate methods."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint._horizon import FILTERS, REACH, limit_of
from diffpoint._runtime import runtime_info
from diffpoint.camera import PinholeCamera, check_views
from diffpoint.splat import splat_depth

Method = Literal["zbuffer", "horizon", "hpr"]
METHODS: tuple[Method, ...] = get_args(Method)

# radius and tolerance where the caller gives none
_DEFAULTS = {"zbuffer": (0.0, 0.0), "horizon": (REACH, 0.22), "hpr": (1.5, 0.0)}


def visible_points(
    points: Tensor,
    camera: PinholeCamera,
    *,
    method: Method = "zbuffer",
    radius: float | None = None,
    tolerance: float | None = None,
    lengths: Tensor | None = None,
) -> Tensor:
    """Decide which points each view sees; hidden surfaces of a sparse cloud shine through its z-buffer.

    | method | a point is visible if |
    |---|---|
    | zbuffer | it is the nearest point of a pixel, as in the paper |
    | horizon | the points within `radius` of it in the image hide it with a probability of at most `tolerance` |
    | hpr | it is a corner of the hull of the cloud flipped on a sphere 10^`radius` times as large (needs scipy) |

    "horizon" finds the most visible points and lets the fewest hidden ones through (docs/visibility.md). Only "zbuffer"
    depends on the size of the map.

    Args:
        points: (B, N, 3) in the world.
        camera: batch shape (), (V,) or (B, V); points outside its frame are not visible.
        method: see the table.
        radius: of "horizon", in multiples of the points' spacing in the view, which is estimated from them, so that the
            default holds for any N; of "hpr", an exponent. Default: chosen for the method.
        tolerance: of "horizon": larger keeps more visible and more hidden points. Default: 0.22.
        lengths: (B,) int64, how many of the N points count; default all.

    Returns:
        (B, V, N) bool. The same input gives the same bits.

    Gradients: none; pass the result to `sample_view` for the points with their gradient.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an unknown method, a negative radius or tolerance, NaN
            or infinite coordinates.
        ImportError: method "hpr" without scipy.

    Source: zbuffer: CVPR 2019 paper, section 3.2; hpr: Katz, Tal, Basri, "Direct visibility of point sets" (SIGGRAPH
        2007); horizon: this library's, see docs/visibility.md.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> cloud = torch.tensor([[[0.1, -0.1, 0.5], [0.1, -0.1, 0.0]]])
        >>> visible_points(cloud, camera).tolist()
        [[[False, True]]]
    """
    _checks.check_clouds("visible_points", "points", points)
    _checks.check_choice("visible_points", "method", method, METHODS)
    own_radius, own_tolerance = (
        default
        if value is None
        else _checks.check_number(
            "visible_points", name, value, "be a finite number, at least 0", lambda x: 0 <= x < math.inf
        )
        for name, value, default in zip(
            ("radius", "tolerance"), (radius, tolerance), _DEFAULTS[method], strict=True
        )
    )
    batch, count = points.shape[:2]
    lengths = _checks.check_lengths("visible_points", "lengths", lengths, (batch,), count, points)
    views = check_views("visible_points", "camera", camera, points)
    if method == "zbuffer":
        return splat_depth(points.detach(), camera, lengths=lengths).visible
    return _visible(
        points.detach(),
        _bridge.full_lengths(lengths, batch, count, points),
        views.projection.detach(),
        camera.height,
        camera.width,
        method,
        own_radius,
        own_tolerance,
    )


@_bridge.register(
    "visible",
    fake=lambda points, lengths, projection, *_: points.new_empty(
        (*projection.shape[:2], points.shape[1]), dtype=torch.bool
    ),
)
def _visible(
    points: Tensor,
    lengths: Tensor,
    projection: Tensor,
    height: int,
    width: int,
    method: str,
    radius: float,
    tolerance: float,
) -> Tensor:
    count = points.shape[1]
    _checks.check_lengths_range("visible_points", "lengths", lengths, count)
    _checks.check_finite("visible_points", "points", points, lengths)
    shape = (*projection.shape[:2], count)
    if 0 in shape:
        return torch.zeros(shape, dtype=torch.bool)
    if method == "hpr":
        return _on_flipped_hull(points, lengths, projection, height, width, radius)
    visible = torch.empty(shape, dtype=torch.uint8)
    # Views share the memory of a few workers: allocating memory for each view would take as long as the kernel.
    workers = min(shape[0] * shape[1], 4 * runtime_info().threads)
    cells = torch.empty(workers * (8 * count + 32), dtype=torch.int32)
    row = (
        count + 17
    )  # padding of one vector register, and one place that collects the points that are left out
    _bridge.launch(
        "visibility",
        "horizon",
        points.dtype,
        points.reshape(-1),
        lengths,
        projection.reshape(-1),
        points.new_empty(workers * count * 3),
        cells,
        torch.empty(workers * count, dtype=torch.int32),
        points.new_empty(cells.shape),
        torch.empty(workers * row, dtype=torch.int32),
        points.new_empty(workers * row * 3),
        torch.tensor(FILTERS, dtype=points.dtype).view(-1),
        visible.view(-1),
        workers,
        shape[1],
        count,
        height,
        width,
        radius,
        limit_of(tolerance),
    )
    return visible.view(torch.bool)


def _on_flipped_hull(
    points: Tensor, lengths: Tensor, projection: Tensor, height: int, width: int, exponent: float
) -> Tensor:
    try:
        from scipy.spatial import ConvexHull, QhullError
    except ImportError as error:
        raise ImportError(
            "visible_points: method 'hpr' needs scipy's convex hull; pip install scipy, or take method 'horizon'."
        ) from error
    visible = torch.zeros((*projection.shape[:2], points.shape[1]), dtype=torch.bool)
    eyes = -torch.linalg.solve(projection[..., :3].double(), projection[..., 3:].double())[..., 0]
    for b in range(points.shape[0]):
        cloud = points[b].double()
        homogeneous = torch.cat((cloud, torch.ones_like(cloud[:, :1])), dim=1)
        for v in range(projection.shape[1]):
            u, r, depth = (homogeneous @ projection[b, v].double().T).unbind(1)
            framed = (depth > 0) & (u >= 0) & (u < width * depth) & (r >= 0) & (r < height * depth)
            chosen = (framed & (torch.arange(len(cloud)) < lengths[b])).nonzero()[:, 0]
            if len(chosen) < 4:  # no hull in three dimensions: every point is on it
                visible[b, v, chosen] = True
                continue
            way = cloud[chosen] - eyes[b, v]
            far = way.norm(dim=1, keepdim=True)
            flipped = way * (2 * 10**exponent * far.max() / far - 1)
            try:
                corners = ConvexHull(torch.cat((flipped, flipped.new_zeros(1, 3))).numpy()).vertices
            except QhullError:  # all points and the eye in one plane
                corners = ConvexHull(
                    torch.cat((flipped, flipped.new_zeros(1, 3))).numpy(), qhull_options="QJ Qbb Qc"
                ).vertices
            corners = torch.from_numpy(corners).long()
            visible[b, v, chosen[corners[corners < len(chosen)]]] = True
    return visible
