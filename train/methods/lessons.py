"""The losses of the methods that the paper compares itself with, each a function of a network and what it is given.

Distances between clouds are means x100, as everywhere in the tables.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from diffpoint import PinholeCamera, chamfer_distance, earth_mover_distance, projection_loss
from models import Generator
from models.baselines import (
    RecurrentReconstruction,
    SilhouetteReconstruction,
    StructureGenerator,
    pixel_centres,
    silhouettes,
)
from train.config import StageConfig
from train.data.batches import Batch, Targets
from train.methods.losses import TRANSPORT_TOLERANCE, arrange_scenes, front_loss
from train.methods.targets import fixed_depth, solid_cells

_PROJECTIONS = 5

# How far above the least a transport may be that only says which of several clouds is nearest. It is 2 % above in the
# mean, where the clouds of five codes differ by 30 %, and takes half the time.
_CHOICE_TOLERANCE = 0.2


class Given(NamedTuple):
    """What a lesson is about.

    Attributes:
        batch: B shapes with V views each, of which the network sees the images.
        truth: everything known of the same shapes.
        codes: (R, B*V, code_dim) from N(0, 1).
        stage: the stage's settings.
        step: number of this step within the stage.
    """

    batch: Batch
    truth: Targets
    codes: Tensor
    stage: StageConfig
    step: int


Lesson = Callable[[Any, Given], dict[str, Tensor]]
"""(network, given) -> scalars for the log, of which "loss" is to be lowered."""


def whole_clouds(network: Generator, given: Given) -> dict[str, Tensor]:
    """PSGN: each image's cloud against all of the true surface."""
    clouds = network(given.batch.images.flatten(0, 1), given.codes[:1])
    return {"loss": _cloud_distances(clouds, given).mean()}


def best_whole_cloud(network: Generator, given: Given) -> dict[str, Tensor]:
    """Minimum over n: of the clouds of R codes, the one nearest to the true surface learns."""
    return _best_of(network, given, _cloud_distances)


def best_front(network: Generator, given: Given) -> dict[str, Tensor]:
    """Minimum over n of the front constraint."""
    return _best_of(network, given, _front_distances)


def fixed_views(network: StructureGenerator, given: Given) -> dict[str, Tensor]:
    """Lin et al., first phase: what the eight fixed cameras see; sums over the pixels of an image.

    Depth is compared where there is something to see, by the truth's word: empty pixels have no depth.
    """
    structure = network.structure(given.batch.images.flatten(0, 1))
    true = _for_each_image(fixed_depth(given.truth.points, network.config.map_size), given)
    filled = true.isfinite()
    place = (structure.pixels - pixel_centres(network.config.map_size)).abs().sum()
    depth = (structure.depth - true.where(filled, structure.depth.detach())).abs().sum()
    mask = F.binary_cross_entropy_with_logits(structure.logits, filled.float(), reduction="sum")
    terms = {"place": place, "depth": depth, "mask": mask}
    terms = {name: value / len(true) for name, value in terms.items()}
    return {"loss": sum(terms.values(), torch.zeros(())), **terms}


def projections(network: StructureGenerator, given: Given) -> dict[str, Tensor]:
    """Lin et al., second phase: the fused cloud's depth maps and masks before five cameras, other ones at each step."""
    structure = network.structure(given.batch.images.flatten(0, 1))
    points, logits = network.fuse(structure), structure.logits.flatten(1)
    views = _some_views(given, _PROJECTIONS)
    depth = _for_each_image(given.truth.depth[:, views], given)
    # Per pixel of the foreground in both terms, as their sums have it.
    mask_weight = 1 / depth.isfinite().float().mean().item()
    loss = projection_loss(
        points, _camera(given, views), depth, logits=logits, mask_weight=mask_weight, upsample=network.config.upsample
    )  # fmt: skip
    return {"loss": loss, "kept_share": (logits > 0).float().mean()}


def filled_cells(network: RecurrentReconstruction, given: Given) -> dict[str, Tensor]:
    """3D-R2N2: each cell's cross entropy, after one to V images; how many, every step draws for its whole batch."""
    images = given.batch.images
    dice = torch.Generator().manual_seed(given.step)
    count = 1 + int(torch.randint(images.shape[1], (), generator=dice))
    logits = network.logits(images[:, :count])
    cells = solid_cells(given.truth, network.grid_size)
    shared = ((logits[:, 1] > logits[:, 0]) & cells).sum((1, 2, 3))
    either = ((logits[:, 1] > logits[:, 0]) | cells).sum((1, 2, 3))
    return {"loss": F.cross_entropy(logits, cells.long()), "overlap": (shared / either.clamp(min=1)).mean()}


def outlines(network: SilhouetteReconstruction, given: Given) -> dict[str, Tensor]:
    """PTN: half the squared error of the silhouettes, summed over pixels, before all cameras that the data have."""
    occupancy = network.occupancy(given.batch.images.flatten(0, 1))
    views = torch.arange(given.truth.depth.shape[1])
    seen = silhouettes(occupancy, _camera(given, views))
    true = _for_each_image(given.truth.depth, given).isfinite().float()
    return {"loss": 0.5 * (seen - true).square().sum((2, 3)).mean(), "filled_share": occupancy.mean()}


def _best_of(
    network: Generator, given: Given, distances: Callable[[Tensor, Given, float], Tensor]
) -> dict[str, Tensor]:
    """The clouds of R codes are compared without a graph; then the best of each image is made again, and learns."""
    images = given.batch.images.flatten(0, 1)
    with torch.no_grad():
        all_distances = distances(network(images, given.codes), given, _CHOICE_TOLERANCE)  # (R, B*V)
    best = all_distances.argmin(0)
    codes = given.codes[best, torch.arange(len(best))][None]
    loss = distances(network(images, codes), given, TRANSPORT_TOLERANCE).mean()
    return {"loss": loss, "mean_of_all": all_distances.mean()}


def _cloud_distances(clouds: Tensor, given: Given, tolerance: float = TRANSPORT_TOLERANCE) -> Tensor:
    """(R, B*V, N, 3) clouds -> (R, B*V) distances to the true surfaces, x100; transports within `tolerance`."""
    true = _for_each_image(given.truth.points, given)
    if given.stage.front == "chamfer":
        both = chamfer_distance(clouds, true.expand(len(clouds), *true.shape), squared=False)
        return 100 * (both.a_to_b + both.b_to_a)
    # An assignment needs as many true points; which, changes with the step.
    every = max(1, true.shape[1] // clouds.shape[2])
    thin = true[:, given.step % every :: every][:, : clouds.shape[2]]
    thin = thin.expand(len(clouds), *thin.shape).contiguous()
    return 100 * earth_mover_distance(clouds, thin, tolerance=tolerance).cost


def _front_distances(clouds: Tensor, given: Given, tolerance: float) -> Tensor:
    """(R, B*V, N, 3) clouds -> (R, B*V) front constraints, in the paper's unit; transports within `tolerance`."""
    scene = arrange_scenes(clouds, given.batch.camera, given.batch.depth, joined_views=False)
    return front_loss(scene, given.stage.front, tolerance=tolerance).each.view(clouds.shape[:2])


def _for_each_image(values: Tensor, given: Given) -> Tensor:
    """(B, ...) of shapes -> (B*V, ...), once for each of their images."""
    return values.repeat_interleave(given.batch.images.shape[1], dim=0)


def _camera(given: Given, views: Tensor) -> PinholeCamera:
    """(B*V, K): K of the true cameras of each shape, before each of its images' predictions."""
    camera = given.truth.camera
    K, pose = (_for_each_image(matrix[:, views], given) for matrix in (camera.K, camera.cam_from_world))
    return PinholeCamera(K, pose, camera.height, camera.width)


def _some_views(given: Given, count: int) -> Tensor:
    """Numbers of up to `count` views, drawn anew at each step."""
    dice = torch.Generator().manual_seed(given.step)
    return torch.randperm(given.truth.depth.shape[1], generator=dice)[:count]
