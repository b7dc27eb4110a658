"""Aberrations on axis, on the circle of a measurement, for a batch of eyes.

The counterpart of `estimator.eye.tracing.zernike_of_vectors` on axis: the wavefront of
the chief ray's retinal point on the filled circle of half the pupil diameter, whatever
the stop. Here rays start at the nodes of that circle and are aimed at the retinal
point; their miss has little effect (see `extra_path`).
"""

from typing import Any, cast

import torch
from torch import Tensor

from estimator.optics.units import UM_PER_MM
from estimator.optics.zernike import N_TERMS
from estimator.wavefront.nodes import circle_nodes
from training.tracer import eye as eyes
from training.tracer.eye import Eye, constant, in_chunks
from training.tracer.rays import (
    ORDER_TOLERANCE_MM,
    Axes,
    Chief,
    across,
    broyden,
    extra_path,
    field_axes,
    into_cornea,
    into_lens,
    inverse_2x2,
    solve_chief,
    trace_chief,
)

_ACCEPTED_MM = 1e-4
"""Miss at the retina: its square leaves 4e-7 um, but gradients depend on it
linearly."""

_TOLERANCE_MM = {torch.float64: 1e-7, torch.float32: 1e-5}
"""Aim where gradients are required; float32 reaches 4e-6 of 17 mm."""

_TOLERANCE_WITHOUT_GRADIENT_MM = 2e-5
_STEPS = 10
_FIRST_STEPS, _WARM_STEPS = 5, 2
_DIFFERENCE_COSINE = 1e-3

_Rows = tuple[Tensor, Tensor, Tensor]
_Starts = tuple[Tensor | None, Tensor | None]


@constant
def _nodes(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return points (2, R) of the unit circle, and projection (R, 28), no piston."""
    rings, _, azimuths, projection = (torch.tensor(a) for a in circle_nodes())
    points = (azimuths[:, None, :] * rings[:, None]).reshape(-1, 2)
    projection[0] = 0.0
    return points.T.to(device, dtype), projection.T.to(device, dtype)


def zernike_of_eyes(
    vectors: Tensor,
    pupil_diameter_mm: Tensor,
    wavelength_nm: Tensor,
    *,
    ray_dtype: torch.dtype | None = None,
    chunk: int | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute coefficients of relaxed or accommodated eyes on axis, object at infinity.

    Parameters
    ----------
    vectors : (B, 45)
        Parameters in table order.
    pupil_diameter_mm, wavelength_nm : (B,)
        Circle and wavelength of each eye.
    ray_dtype : torch.dtype, optional
        Precision of the bundle and of the result; default that of ``vectors``.
    chunk : int, optional
        Eyes traced at a time; default by device.

    Returns
    -------
    zernike_um : (B, 28)
        Piston zero; nan where light does not pass completely (there the compiled
        tracer fits the rest, unless it is too little).
    ok : (B,) bool

    Notes
    -----
    Differentiable once, in all three arguments; rows that are not ok get no gradient.

    Against the compiled tracer (512 eyes of Table 2, pupils of 3 to 6 mm, 450 to
    900 nm) float64 differs by 1e-9 um at most and float32 by 5e-5 um, 5e-6 um in the
    root mean square. Gradients differ from its central differences by 3e-6 of a
    parameter's largest; in float32 by 2e-4 um over the whole range of a parameter.
    """
    dtype = ray_dtype or vectors.dtype
    return in_chunks(
        lambda *part: _zernike(*cast(_Rows, part), dtype),
        (vectors, pupil_diameter_mm, wavelength_nm),
        chunk,
    )


def _zernike(
    vectors: Tensor, pupil_mm: Tensor, wavelength_nm: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    with_gradient = torch.is_grad_enabled()
    with torch.no_grad():
        eye = eyes.pack_eyes(vectors, wavelength_nm)
        zero = torch.zeros_like(eye.indices[:, 0])
        axes = field_axes(zero, zero)
        solved = solve_chief(eye, axes)
        chief = trace_chief(eye, axes, solved)
        points, outward, ok = _aim(
            eye, axes, chief, pupil_mm / 2.0, dtype, with_gradient
        )
    # Only rows that passed go on: a nan would spoil the gradients of the others.
    rows = ok.nonzero()[:, 0]
    axes, solved, points, outward = eyes.mapped(
        lambda t: t[rows], (axes, solved, points, outward)
    )
    eye = eyes.pack_eyes(vectors[rows], wavelength_nm[rows])
    chief = trace_chief(eye, axes, solved)
    wave_um = _wavefront(eye, axes, chief, points, outward, pupil_mm[rows] / 2.0)
    zernike_um = wave_um.new_full((len(ok), N_TERMS), torch.nan)
    projection = _nodes(vectors.device, dtype)[1]
    return zernike_um.index_copy(0, rows, wave_um @ projection), ok


def _plane(eye: Eye, axes: Axes, dtype: torch.dtype) -> tuple[Tensor, ...]:
    """Return the pupil plane's axes in those of the anterior cornea, (B, 3, 1) each."""
    return tuple(torch.bmm(eye.to_cornea.turn, axis).to(dtype) for axis in axes)


def _aim(
    eye: Eye,
    axes: Axes,
    chief: Chief,
    radius_mm: Tensor,
    dtype: torch.dtype,
    with_gradient: bool,
) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Aim rays from the nodes at the retinal point.

    Returns points on the four surfaces, the outward direction in the anterior cornea's
    axes, both (B, 3, R), and ok (B,).
    """
    x_axis, y_axis, source = _plane(eye, axes, dtype)
    frame = across(chief.direction).to(dtype)
    nodes = _nodes(radius_mm.device, dtype)[0] * radius_mm.to(dtype)[:, None, None]
    narrow, light = eyes.mapped(lambda t: t.to(dtype), (eye, chief[:3]))
    last: dict[str, Any]
    last, tolerance = {}, _TOLERANCE_WITHOUT_GRADIENT_MM
    if with_gradient:
        tolerance = _TOLERANCE_MM[dtype]

    def miss_of(
        cosines: Tensor, positions: Tensor, starts: _Starts = (None, None)
    ) -> Tensor:
        p, q = cosines[:, :1], cosines[:, 1:]
        outward = p * x_axis + q * y_axis + (1.0 - p * p - q * q).sqrt() * source
        here = positions[:, :1] * x_axis + positions[:, 1:] * y_axis + light[0][0]
        miss, last["points"], last["legs"] = _to_origin(
            narrow, light, frame, here, -outward, starts
        )
        last["outward"] = outward
        return miss

    def warm(cosines: Tensor) -> Tensor:
        # A bundle's second guess meets the cornea nearly where the first did.
        starts = last["legs"][:2] if "legs" in last else (None, None)
        return miss_of(cosines, nodes, starts)

    h = _DIFFERENCE_COSINE
    corner = nodes.new_tensor([[h, 0.0], [0.0, h]]).expand(len(nodes), 2, 2)
    response = miss_of(corner, torch.zeros_like(corner)) / h
    last.clear()
    _, left = broyden(
        warm,
        torch.zeros_like(nodes),
        inverse_2x2(response),
        tolerance=tolerance,
        n_steps=_STEPS,
    )
    onwards = torch.stack(last["legs"][1:]).amin(0) > -ORDER_TOLERANCE_MM
    ok = chief.ok & ((left < _ACCEPTED_MM) & onwards).all(1)
    return last["points"], last["outward"], ok


def _to_origin(
    eye: Eye,
    light: tuple[tuple[Tensor, ...], Tensor, Tensor],
    frame: Tensor,
    point: Tensor,
    direction: Tensor,
    starts: _Starts,
) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Trace rays (B, 3, R) from the pupil plane to that of the retinal point.

    Returns the miss there (B, 2, R), points on the four surfaces, and the legs.
    """
    steps = _FIRST_STEPS if starts[0] is None else _WARM_STEPS
    _, origin, chief_direction = light
    first, second, direction, reach, gap = into_cornea(
        eye, point, direction, starts, steps
    )
    point, direction = eyes.inward(eye.to_stop, second, direction)
    third, fourth, direction, on, depth = into_lens(eye, point, direction)
    away = origin - fourth
    rest = (away * chief_direction).sum(1) / (direction * chief_direction).sum(1)
    miss = torch.bmm(frame, rest[:, None] * direction - away)
    return miss, (first, second, third, fourth), (reach, gap, on, depth, rest)


def _wavefront(
    eye: Eye,
    axes: Axes,
    chief: Chief,
    points: tuple[Tensor, ...],
    outward: Tensor,
    radius_mm: Tensor,
) -> Tensor:
    """Return W (B, R), um, at the nodes of the circle; differentiable."""
    dtype = outward.dtype
    x_axis, y_axis, _ = _plane(eye, axes, dtype)
    nodes = _nodes(radius_mm.device, dtype)[0] * radius_mm.to(dtype)[:, None, None]
    eye, (chief_points, origin) = eyes.mapped(
        lambda t: t.to(dtype), (eye, (chief.points, chief.origin))
    )
    path_mm, away_mm = extra_path(eye, points, chief_points, origin)
    there_mm = nodes[:, :1] * x_axis + nodes[:, 1:] * y_axis
    last_mm = ((there_mm - away_mm) * outward).sum(1)
    return -UM_PER_MM * (path_mm + eye.indices[:, :1] * last_mm)
