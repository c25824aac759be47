"""Differentiable point-cloud rendering and shape distances for PyTorch, fast on a plain CPU."""

import torch as _torch

from diffpoint._bridge import check_pending
from diffpoint._conversions import OpenGLCamera, PyTorch3DCamera
from diffpoint._runtime import RuntimeInfo, configure, runtime_info
from diffpoint.camera import PinholeCamera, PointSets, Projection
from diffpoint.completion import (
    minimal_matching_distance,
    total_mutual_difference,
    unidirectional_hausdorff_distance,
)
from diffpoint.distances import (
    Chamfer,
    FScore,
    Nearest,
    chamfer_distance,
    f_score,
    hausdorff_distance,
    nearest,
)
from diffpoint.losses import (
    FrontSets,
    FrontTerms,
    consistency_loss,
    diversity_loss,
    front_constraint,
    front_sets,
    front_terms,
)
from diffpoint.neighbours import Neighbours, knn
from diffpoint.projection import projection_loss, soft_projection_loss
from diffpoint.reproject import Reprojection, project, reproject, unproject
from diffpoint.sampling import farthest_point_sample
from diffpoint.soft_splat import SoftSplat, soft_splat
from diffpoint.softmatch import approxmatch
from diffpoint.splat import Splat, splat_depth
from diffpoint.transport import Transport, earth_mover_distance
from diffpoint.views import ViewSample, sample_view
from diffpoint.visibility import visible_points

__version__ = "0.1.0"

__all__ = [
    "Chamfer",
    "FScore",
    "FrontSets",
    "FrontTerms",
    "Nearest",
    "Neighbours",
    "OpenGLCamera",
    "PinholeCamera",
    "PointSets",
    "Projection",
    "PyTorch3DCamera",
    "Reprojection",
    "RuntimeInfo",
    "SoftSplat",
    "Splat",
    "Transport",
    "ViewSample",
    "approxmatch",
    "chamfer_distance",
    "check_pending",
    "configure",
    "consistency_loss",
    "diversity_loss",
    "earth_mover_distance",
    "f_score",
    "farthest_point_sample",
    "front_constraint",
    "front_sets",
    "front_terms",
    "hausdorff_distance",
    "knn",
    "minimal_matching_distance",
    "nearest",
    "project",
    "projection_loss",
    "reproject",
    "runtime_info",
    "sample_view",
    "soft_projection_loss",
    "soft_splat",
    "splat_depth",
    "total_mutual_difference",
    "unidirectional_hausdorff_distance",
    "unproject",
    "visible_points",
]

# Like cameras, results may be in files that torch.load reads with weights_only=True.
_classes = [item for item in map(globals().get, __all__) if isinstance(item, type)]
_torch.serialization.add_safe_globals([item for item in _classes if issubclass(item, tuple)])
