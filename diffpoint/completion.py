"""How good, how different and how faithful several completions of a shape are: MMD, TMD and UHD of Wu et al."""

from __future__ import annotations

import torch
from torch import Tensor

from diffpoint import _checks
from diffpoint.distances import chamfer_distance
from diffpoint.losses import Reduction, pairs, reduce_loss

_POINTS_AT_ONCE = 2**22
"""Of the pairs of clouds that the search for the nearest sample holds at a time: some 100 MB."""


def minimal_matching_distance(
    samples: Tensor, references: Tensor, *, squared: bool, reduction: Reduction = "mean"
) -> Tensor:
    """MMD = mean_r min_s CD(sample_s, reference_r): how near each real shape has a generated one (quality).

    Args:
        samples: (*B, S, N, 3) generated clouds, for instance all completions of all inputs; any unit.
        references: (*B, R, M, 3) real clouds, same unit, dtype and leading dimensions.
        squared: of the chamfer distance (CD), which is the sum of both directions' means: True for squared distances
            (unit^2), False for distances (unit).
        reduction: "mean" over the references and all leading dimensions, or "none" for (*B, R).

    Gradients: to `references` and to the sample nearest to each (the first in a tie), as of `chamfer_distance`.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, no sample or reference, an empty cloud, NaN or infinite
            coordinates.

    Source: Achlioptas et al., "Learning representations and generative models for 3D point clouds" (ICML 2018); of
    completions Wu et al., "Multimodal shape completion via conditional GANs" (ECCV 2020), whose code takes squared
    distances; its tables have x 1000.

    Example:
        >>> near, far = torch.zeros(1, 1, 3), torch.ones(1, 1, 3)
        >>> references = torch.tensor([[[0.0, 0, 0.5]], [[0.0, 0, 0.1]]])
        >>> minimal_matching_distance(torch.cat((near, far)), references, squared=False, reduction="none").tolist()
        [1.0, 0.20000000298023224]
    """
    name = "minimal_matching_distance"
    _checks.check_tensor(name, "samples", samples, ("*", "S", "N", 3))
    _checks.check_tensor(name, "references", references, (*samples.shape[:-3], "R", "M", 3))
    _checks.check_same_dtype(name, samples=samples, references=references)
    squared = _checks.check_flag(name, "squared", squared)
    for argument, clouds in (("samples", samples), ("references", references)):
        _checks.check_filled(name, argument, clouds)
        _check_some(name, argument, clouds)
    points = samples.shape[:-2].numel() * max(samples.shape[-2], references.shape[-2])
    at_once = references.detach().split(max(1, _POINTS_AT_ONCE // max(1, points)), -3)
    index = torch.cat([_nearest_sample(samples.detach(), some, squared) for some in at_once], -1)
    chosen = torch.take_along_dim(samples, index[..., None, None], -3)
    matched = chamfer_distance(chosen, references, squared=squared).total
    return reduce_loss(name, matched, reduction)


def _nearest_sample(samples: Tensor, references: Tensor, squared: bool) -> Tensor:
    """(*B, R) index of the sample with the least chamfer distance to each reference; every pair is compared."""
    dims = (*samples.shape[:-3], references.shape[-3], samples.shape[-3])
    every = samples.unsqueeze(-4).expand(*dims, *samples.shape[-2:])
    against = references.unsqueeze(-3).expand(*dims, *references.shape[-2:])
    return chamfer_distance(every, against, squared=squared).total.argmin(-1)


def total_mutual_difference(clouds: Tensor, *, squared: bool, reduction: Reduction = "mean") -> Tensor:
    """TMD = sum_i 1/(K - 1) sum_(j != i) CD(S_i, S_j): how different the K completions of one input are (diversity).

    It grows with K, so that only values of one K can be compared; TMD / K is the mean over all pairs.

    Args:
        clouds: (*B, K, N, 3) K completions of each input, any unit.
        squared: of the chamfer distance (CD), which is the sum of both directions' means: True for squared distances
            (unit^2), False for distances (unit).
        reduction: "mean" over all inputs, or "none" for (*B).

    Gradients: to `clouds`, as of `chamfer_distance`.

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, fewer than two completions, NaN or infinite coordinates.

    Source: Wu et al., "Multimodal shape completion via conditional GANs" (ECCV 2020), with K = 10; its tables have
    x 100. Codes that follow it take squared distances.

    Example:
        >>> total_mutual_difference(torch.tensor([[[0.0, 0, 0]], [[1.0, 0, 0]], [[0.0, 0, 0]]]), squared=False).item()
        4.0
    """
    name = "total_mutual_difference"
    _checks.check_tensor(name, "clouds", clouds, ("*", "K", "N", 3))
    squared = _checks.check_flag(name, "squared", squared)
    _checks.check_filled(name, "clouds", clouds)
    count = clouds.shape[-3]
    first, second = pairs(name, "clouds", count)
    between = chamfer_distance(clouds[..., first, :, :], clouds[..., second, :, :], squared=squared).total
    return reduce_loss(name, between.sum(-1) * (2 / (count - 1)), reduction)


def unidirectional_hausdorff_distance(
    partial: Tensor,
    completions: Tensor,
    *,
    partial_lengths: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """UHD = mean_k max_i min_j |partial_i - completion_kj|: whether the completions keep their input (fidelity).

    Args:
        partial: (*B, N, 3) the observed part of each shape, any unit.
        completions: (*B, K, M, 3) K completions of each, same unit, dtype and leading dimensions.
        partial_lengths: (*B) int64, how many of the N points count; default all.
        reduction: "mean" over all inputs, or "none" for (*B), each a mean over its completions.

    Gradients: to `partial` and `completions`, as of `chamfer_distance` with the reduction "max".

    Raises:
        ValueError, TypeError: wrong shapes, dtypes or devices, no completion, an empty cloud, NaN or infinite
            coordinates.

    Source: Wu et al., "Multimodal shape completion via conditional GANs" (ECCV 2020); its tables have x 100.

    Example:
        >>> partial = torch.zeros(1, 3)
        >>> completions = torch.tensor([[[0.0, 0, 1], [9, 9, 9]], [[3.0, 4, 0], [9, 9, 9]]])
        >>> unidirectional_hausdorff_distance(partial, completions).item()
        3.0
    """
    name = "unidirectional_hausdorff_distance"
    _checks.check_tensor(name, "partial", partial, ("*", "N", 3))
    _checks.check_tensor(name, "completions", completions, (*partial.shape[:-2], "K", "M", 3))
    _checks.check_same_dtype(name, partial=partial, completions=completions)
    lengths = _checks.check_lengths(
        name, "partial_lengths", partial_lengths, tuple(partial.shape[:-2]), partial.shape[-2], partial
    )
    _checks.check_filled(name, "partial", partial, lengths)
    _checks.check_filled(name, "completions", completions)
    _check_some(name, "completions", completions)
    every = partial.unsqueeze(-3).expand(*completions.shape[:-2], *partial.shape[-2:])
    if lengths is not None:
        lengths = lengths.unsqueeze(-1).expand(completions.shape[:-2])
    directed = chamfer_distance(every, completions, squared=False, reduction="max", a_lengths=lengths).a_to_b
    return reduce_loss(name, directed.mean(-1), reduction)


def _check_some(function: str, argument: str, clouds: Tensor) -> None:
    if clouds.shape[-3] == 0:
        raise _checks.fail(function, argument, "hold at least one cloud", str(tuple(clouds.shape)))
