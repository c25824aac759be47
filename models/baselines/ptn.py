"""PTN: one image -> an occupancy grid, supervised by silhouettes.

The perspective transformer samples the grid along the rays of a camera; a pixel's silhouette value is the largest
occupancy on its ray. The published network pre-trains its encoder by rotating objects; here all parts are trained
jointly from the start.

Source: Yan, Yang, Yumer, Guo, Lee, "Perspective transformer nets: Learning single-view 3D object reconstruction without
3D supervision" (NeurIPS 2016).
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from diffpoint import PinholeCamera
from models.baselines.base import Baseline, BaselineConfig, choose_config, initialise_rectified
from models.baselines.voxels import cell_centres, surface_points

_THRESHOLD = 0.5
_RAY_SAMPLES = 32
_GRID_SIZE = 32
# World units: half an object's diagonal of one, plus half a cell. Cells beyond it are not in every camera's view and
# would never be emptied.
_OBJECT_RADIUS = 0.5 + 0.5 / _GRID_SIZE
# From every direction, the cube [-0.5, 0.5]^3 is within this distance of the origin's depth.
_HALF_DIAGONAL = math.sqrt(3) / 2


@dataclasses.dataclass(frozen=True)
class PTNConfig(BaselineConfig):
    """Everything that fixes the network's shape; the grid has 32^3 cells.

    Attributes:
        encoder: channels of the convolutions, each of which halves the image.
        hidden: width of the two fully connected layers after them.
        features: length of the feature vector after these.
        decoder: channels of the 3^3 cells and of the two larger grids before the output.
    """

    encoder: tuple[int, int, int] = (16, 32, 64)
    hidden: int = 256
    features: int = 128
    decoder: tuple[int, int, int] = (64, 32, 16)


PTN_PROFILES = {
    "full": PTNConfig("full", 64, 64, 2048, (64, 128, 256), 1024, 512, (512, 256, 96)),
    "cpu": PTNConfig(),
    "smoke": PTNConfig("smoke", 32, 32, 128, (8, 8, 16), 64, 32, (16, 8, 4)),
}


def build_ptn(profile: str = "cpu", *, config: PTNConfig | None = None) -> SilhouetteReconstruction:
    """Builds the network with freshly drawn weights.

    Args:
        profile: "full" (64 x 64 images, 37.96 million parameters), "cpu" or "smoke".
        config: sizes of your own; `profile` is then ignored.

    Example:
        >>> model = build_ptn("smoke")
        >>> model.occupancy(torch.rand(2, 3, 56, 56)).shape
        torch.Size([2, 32, 32, 32])
    """
    return SilhouetteReconstruction(choose_config("build_ptn", PTN_PROFILES, profile, config))


class SilhouetteReconstruction(Baseline):
    """One image -> occupancies in [0, 1], 0 outside the ball around an object."""

    config: PTNConfig
    inside: Tensor

    def __init__(self, config: PTNConfig) -> None:
        super().__init__()
        self.config = config
        a, b, c = config.encoder
        first, second, third = config.decoder
        seen = c * math.ceil(config.image_height / 8) * math.ceil(config.image_width / 8)
        self.encoder = nn.Sequential(
            *(nn.Conv2d(3, a, 5, 2, 2), nn.ReLU(), nn.Conv2d(a, b, 5, 2, 2), nn.ReLU()),
            *(nn.Conv2d(b, c, 5, 2, 2), nn.ReLU(), nn.Flatten()),
            *(nn.Linear(seen, config.hidden), nn.ReLU(), nn.Linear(config.hidden, config.hidden), nn.ReLU()),
            *(nn.Linear(config.hidden, config.features), nn.ReLU()),
        )
        self.decoder = nn.Sequential(
            *(nn.Linear(config.features, 27 * first), nn.ReLU(), nn.Unflatten(1, (first, 3, 3, 3))),
            *(nn.ConvTranspose3d(first, second, 4), nn.ReLU()),
            *(nn.ConvTranspose3d(second, third, 5, 2), nn.ReLU()),
            nn.ConvTranspose3d(third, 1, 6, 2, 1),
        )
        initialise_rectified(self)
        last = self.decoder[-1]
        assert isinstance(last, nn.ConvTranspose3d)
        assert last.bias is not None
        with torch.no_grad():
            # Before training, all occupancies are near 0.27: cells that no ray crosses stay below the threshold.
            last.weight.mul_(0.1)
            last.bias.fill_(-1.0)
        inside = cell_centres(_GRID_SIZE).norm(dim=1) <= _OBJECT_RADIUS
        self.register_buffer("inside", inside.float().unflatten(0, (_GRID_SIZE,) * 3), persistent=False)

    @property
    def grid_size(self) -> int:
        """Cells along a side of the occupancy grid."""
        return _GRID_SIZE

    def occupancy(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] -> (B, 32, 32, 32) in [0, 1], with gradient."""
        return self.inside * self.decoder(self.encoder(self._prepare(images)))[:, 0].sigmoid()

    def _predict(self, images: Tensor) -> Tensor:
        occupancy = self.occupancy(images.flatten(0, 1))
        points = surface_points(occupancy, self.points, threshold=_THRESHOLD)
        return points.unflatten(0, images.shape[:2])


def silhouettes(occupancy: Tensor, camera: PinholeCamera, *, samples: int = _RAY_SAMPLES) -> Tensor:
    """The perspective transformer: silhouettes of an occupancy grid.

    Every ray is sampled at equal steps of depth within the cube [-0.5, 0.5]^3; outside the grid is empty.

    Args:
        occupancy: (B, G, G, G) in [0, 1], along x, y and z of the world.
        camera: (B, V), with the size of the maps.
        samples: number of samples on each ray.

    Returns:
        (B, V, H, W) in [0, 1], the largest occupancy on the ray, interpolated between cells.

    Gradients: to the cells around each ray's largest sample.

    Example:
        >>> grid = torch.zeros(1, 8, 8, 8)
        >>> grid[:, 2:6, 2:6, 2:6] = 1.0
        >>> camera = PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=8, width=8).expand(1, 1)
        >>> (silhouettes(grid, camera)[0, 0, 3:5] > 0.5).int().tolist()
        [[0, 0, 0, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 0, 0, 0]]
    """
    batch, views = camera.batch_shape
    height, width = camera.height, camera.width
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1).reshape(-1, 3).to(occupancy)
    world_from_cam = camera.cam_from_world.inverse()
    rays = (
        pixels @ (world_from_cam[..., :3, :3] @ camera.K.inverse()).mT
    )  # (B, V, H*W, 3), one unit of depth long
    middle = camera.cam_from_world[..., 2, 3]
    depth = middle[..., None] + torch.linspace(-_HALF_DIAGONAL, _HALF_DIAGONAL, samples).to(occupancy)
    places = camera.position[..., None, None, :] + depth[..., None, None] * rays[:, :, None]
    # grid_sample takes coordinates in the order z, y, x, and the grid's border is at 1.
    grid = 2 * places.flip(-1).reshape(batch, views * samples, height * width, 1, 3)
    found = F.grid_sample(occupancy[:, None], grid, align_corners=False)
    return found.reshape(batch, views, samples, height, width).amax(2)
