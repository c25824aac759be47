"""Which points of a cloud a camera sees: the paper's z-buffer, and tests that see more and err less."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from diffpoint import _bridge, _checks
from diffpoint._horizon import BIAS, FILTERS, REACH
from diffpoint._runtime import runtime_info
from diffpoint.camera import PinholeCamera, check_views
from diffpoint.splat import splat_depth

Method = Literal["zbuffer", "radius", "pyramid", "cone", "horizon", "hpr"]
METHODS: tuple[Method, ...] = ("zbuffer", "radius", "pyramid", "cone", "horizon", "hpr")

# radius and tolerance of each method, where the caller gives none
_DEFAULTS = {
    "zbuffer": (0.0, 0.0),
    "radius": (2.0, 1.5),
    "pyramid": (4.0, 2.0),
    "cone": (3.0, 0.4),
    "horizon": (REACH, 0.22),
    "hpr": (1.5, 0.0),
}


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
    | zbuffer | it owns a pixel (the paper's) |
    | radius | it lies at most `tolerance` behind the nearest point within `radius` of its pixel |
    | pyramid | it owns a pixel, at most `tolerance` behind the nearest in a block of pixels of side `radius` |
    | cone | it owns a pixel, and at most the share `tolerance` of 8 sectors, as long as `radius`, is closed before it |
    | horizon | its horizons among the points within `radius` say: hidden with probability `tolerance` at most |
    | hpr | it is a corner of the hull of the cloud flipped on a sphere 10^`radius` times as large (needs scipy) |

    Lengths are multiples of the points' spacing in the view, which is estimated from them, so that the defaults hold
    for any N. zbuffer, radius, pyramid and cone also depend on the size of the map; horizon and hpr do not.

    Args:
        points: (B, N, 3) in the world.
        camera: batch shape (), (V,) or (B, V); points outside its frame are not visible.
        method: see the table.
        radius: see the table; default: chosen for the method.
        tolerance: see the table; larger keeps more visible and more hidden points. Default: chosen for the method.
        lengths: (B,) int64, how many of the N points count; default all.

    Returns:
        (B, V, N) bool. The same input gives the same bits.

    Gradients: none; pass the result to `sample_view` for the points with their gradient.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, an unknown method, a negative radius or tolerance, NaN
            or infinite coordinates.
        ImportError: method "hpr" without scipy.

    Source: zbuffer: CVPR 2019 paper, section 3.2; cone: Pintus, Gobbetti, Agus, "Real-time rendering of massive
        unstructured raw point clouds using screen-space operators" (VAST 2011); hpr: Katz, Tal, Basri, "Direct
        visibility of point sets" (SIGGRAPH 2007); horizon: this library's, see docs/visibility.md.

    Example:
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=4.0, height=4, width=4)
        >>> cloud = torch.tensor([[[0.1, -0.1, 0.5], [0.1, -0.1, 0.0]]])
        >>> visible_points(cloud, camera).tolist()
        [[[False, True]]]
    """
    _checks.check_clouds("visible_points", "points", points)
    _checks.check_choice("visible_points", "method", method, tuple(_DEFAULTS))
    for name, value in (("radius", radius), ("tolerance", tolerance)):
        if value is not None and not 0 <= value < math.inf:
            raise _checks.fail("visible_points", name, "be a finite number, at least 0", repr(value))
    batch, count = points.shape[:2]
    lengths = _checks.check_lengths("visible_points", "lengths", lengths, (batch,), count, points)
    views = check_views("visible_points", "camera", camera, points)
    if method == "zbuffer":
        return splat_depth(points.detach(), camera, lengths=lengths).visible
    own_radius, own_tolerance = _DEFAULTS[method]
    return _visible(
        points.detach(),
        _bridge.full_lengths(lengths, batch, count, points),
        views.projection.detach(),
        camera.height,
        camera.width,
        method,
        own_radius if radius is None else float(radius),
        own_tolerance if tolerance is None else float(tolerance),
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
    # Views take turns in the working memory of a few workers: fresh memory for each would cost as much as the work.
    workers = min(shape[0] * shape[1], 4 * runtime_info().threads)
    inputs = points.reshape(-1), lengths, projection.reshape(-1)
    image = points.new_empty(workers * count * 3)
    cells = torch.empty(workers * (8 * count + 32), dtype=torch.int32)
    sizes = workers, shape[1], count, height, width
    if method == "horizon":
        kernel, last = "horizon", _limit(tolerance)
        filters = torch.tensor(FILTERS, dtype=points.dtype).view(-1)
        row = count + 17  # a register's worth of padding, and a place for what is left out
        scratch = (
            torch.empty(workers * count, dtype=torch.int32),
            points.new_empty(cells.shape),
            torch.empty(workers * row, dtype=torch.int32),
            points.new_empty(workers * row * 3),
            filters,
        )
    else:
        depth = points.new_empty(workers * height * width)
        owner = torch.empty(workers * height * width, dtype=torch.int32)
        kernel, last = {"radius": "slab"}.get(method, method), tolerance
        scratch = {
            "radius": (depth,),
            "pyramid": (depth, owner, torch.empty_like(depth)),
            "cone": (depth, owner),
        }[method]
    _bridge.launch(
        "visibility",
        kernel,
        points.dtype,
        *inputs,
        image,
        cells,
        *scratch,
        visible.view(-1),
        *sizes,
        radius,
        last,
    )
    return visible.view(torch.bool)


def _limit(probability: float) -> float:
    """The score of the filters at which a point is hidden with this probability."""
    p = min(max(probability, 1e-6), 1 - 1e-6)
    return math.log(p / (1 - p)) - BIAS


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
