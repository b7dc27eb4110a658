"""Optical paths of a bundle relative to its chief ray, without cancellation.

An eye is 32 mm of optical path, of which float32 keeps 0.002 um. So every leg is
computed as a difference from the chief ray's leg: with e the difference of the two legs
as vectors, |v| - |c| = e.(v + c) / (|v| + |c|), where nothing large cancels.

Points are x, y in the axes of each surface. By Fermat's principle the path does not
change, to first order, when a point slides along its surface: an error of the points
enters squared, and points without gradient still give the exact gradient.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from training.tracer import eye as eyes
from training.tracer.eye import Eye, Shape
from training.tracer.surfaces import sag


def _from_chief(shape: Shape, points: Tensor, chief: Tensor) -> tuple[Tensor, Tensor]:
    """Return ray points minus the chief's (B, 3, R), and the latter (B, 3, 1)."""
    z = sag(shape, points[:, 0], points[:, 1])[0]
    chief_z = sag(shape, chief[:, 0], chief[:, 1])[0]
    there = torch.cat([chief[:, :2], chief_z[:, None]], 1)
    away = torch.stack(
        [points[:, 0] - chief[:, 0], points[:, 1] - chief[:, 1], z - chief_z], 1
    )
    return away, there


def _longer(away: Tensor, chief_leg: Tensor) -> Tensor:
    """Return the length of ``chief_leg + away`` minus that of ``chief_leg``, (B, R)."""
    leg = chief_leg + away
    lengths = leg.square().sum(1).sqrt() + chief_leg.square().sum(1).sqrt()
    return (away * (leg + chief_leg)).sum(1) / lengths


def extra_path(
    eye: Eye, points: Sequence[Tensor], chief_points: Sequence[Tensor], origin: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the path from ``origin`` to the anterior cornea minus the chief ray's.

    Parameters
    ----------
    points : 4 of (B, 2 or more, R), mm
        x, y on the four surfaces, in their axes.
    chief_points : 4 of (B, 2 or more, 1), mm
    origin : (B, 3, 1), mm
        Retinal point, in the axes of the posterior lens.

    Returns
    -------
    path_mm : (B, R)
        Optical path difference.
    away_mm : (B, 3, R)
        Points on the anterior cornea minus the chief ray's.
    """
    placed = [
        _from_chief(shape, ray, chief)
        for shape, ray, chief in zip(eye.shapes, points, chief_points, strict=False)
    ]
    links = ((eye.to_posterior,), (eye.to_stop, eye.to_lens), (eye.to_lens_posterior,))
    path = 0.0
    for i, link in enumerate(links):
        (away, here), (next_away, there) = placed[i], placed[i + 1]
        for step in link:
            here, away = eyes.inward(step, here, away)
        leg = _longer(next_away - away, there - here)
        path = path + eye.indices[:, i + 1 : i + 2] * leg
    away, here = placed[3]
    path = path + eye.indices[:, 4:5] * _longer(-away, origin - here)
    return path, placed[0][0]
