"""The paper's renderer and its predecessor's on the processor: splats from textures.

What is compared is how PSFs are laid out and interpolated: every source is splat near
to far as in the dense reference, by its rule of coverage or by the paper's alpha.
Tiles and merging only save time, so they are left out, and `tap_count` says how many
samples the layout reads.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.nodes import bracket_axis
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.dense_reference import DepthSums, depth_step_dpt
from tests.benchmarks.layered_baselines import Filtered, Stopwatch
from tests.benchmarks.paper_layout import (
    BYTES_PER_TEXEL,
    DYNAMIC,
    ON_AXIS,
    QUALITY,
    PaperGrid,
    PaperTexture,
    kept_texture,
)
from tests.benchmarks.resized_psfs import full_radius_px, resized
from tests.benchmarks.view_sources import EyeState, Sources, linear_color, view_sources

PREDECESSOR_TAPS = 6
ON_AXIS_TAPS = 1
OFF_AXIS_TAPS = 4

DYNAMIC_PUPILS_MM = np.arange(2.0, 7.0)
DYNAMIC_FOCI_DPT = 0.125 + np.arange(5.0)


def predecessor(view: RgbdView, state: EyeState) -> Filtered:
    """Stack of every PSF at every blur radius: six samples a chromatic value.

    Each channel has its own blur radius, interpolated over distance, and reads the two
    neighbouring distances there; the texture unit blends two whole radii.

    References
    ----------
    Csoba & Kunkli 2023, 6.1, on its predecessor (reference 49 there): N_d (R + 1)
    layers, Table 6.
    """
    watch = Stopwatch()
    cut = ON_AXIS.precomputed(state)
    radius = full_radius_px(cut.radius_px) + 1
    kernels, starts = resized(
        cut, np.zeros(cut.sides.size), np.full(cut.sides.size, radius)
    )
    radii_px = cut.radius_px.reshape(-1, 3)
    stack = _padded_stack(kernels, starts, radius)
    prepare_ms = watch.lap_ms()
    sources = view_sources(view, state.spec)
    lower, upper, part = bracket_axis(ON_AXIS.distance_dpt, sources.distance_dpt)
    part = part[:, None]
    own_px = (1.0 - part) * radii_px[lower] + part * radii_px[upper]
    whole = np.minimum(own_px.astype(np.int64), radius - 1)
    above = own_px - whole
    layers, weights = [], []
    for node, share in ((lower, 1.0 - part), (upper, part)):
        for step, scale in ((0, 1.0 - above), (1, above)):
            layers.append(node[:, None] * (radius + 1) + whole + step)
            weights.append(share * scale)
    color, evaluations = splat_sources(
        view,
        state,
        sources,
        stack,
        np.stack(layers, axis=-1),
        np.stack(weights, axis=-1),
        np.ceil(own_px.max(axis=1) - 1e-9),
    )
    return Filtered(
        color=color,
        prepare_ms=prepare_ms,
        render_ms=watch.lap_ms(),
        memory_mb=len(stack) * stack.shape[2] ** 2 * BYTES_PER_TEXEL / 1e6,
        psf_count=cut.sides.size,
        tap_count=PREDECESSOR_TAPS * evaluations,
    )


def paper_on_axis(
    view: RgbdView, state: EyeState, *, rule: str = "coverage"
) -> Filtered:
    """Layers by distance with transitional ones between: one sample (Eq. 8, 6.1-6.2).

    33 distances; pupil and focus are the frame's, not between nodes.  By the rule
    "paper", a weight is an opacity.

    References
    ----------
    Csoba & Kunkli 2023, sections 6.1 and 6.2.
    """
    return _from_texture(view, state, ON_AXIS, ON_AXIS_TAPS, rule)


def paper_quality(
    view: RgbdView, state: EyeState, *, grid: PaperGrid = QUALITY
) -> Filtered:
    """Blocks of layers by direction, 31 x 21 x 9 and transitional ones: four samples.

    References
    ----------
    Csoba & Kunkli 2023, section 6.3 (Eqs. 9 to 13, s = 1, p = 1/2) and 7.2.2.
    """
    return _from_texture(view, state, grid, OFF_AXIS_TAPS)


def paper_dynamic(
    view: RgbdView, state: EyeState, *, grid: PaperGrid = DYNAMIC
) -> Filtered:
    """Blocks of 23 x 13 x 9 PSFs without transitional layers, blended over the state.

    Textures of the two neighbouring pupils (2 to 6 mm) and foci (0.125 to 4.125 dpt)
    are blended texel by texel; the memory is that of all 25 and of the blend.

    References
    ----------
    Csoba & Kunkli 2023, sections 6.4 and 7.2.2.
    """
    corners, prepare_ms = [], 0.0
    for pupil_mm, pupil_share in _ends(DYNAMIC_PUPILS_MM, state.pupil_diameter_mm):
        for focus_dpt, focus_share in _ends(DYNAMIC_FOCI_DPT, state.focus_dpt):
            if pupil_share * focus_share > 0.0:
                at = replace(state, pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt)
                texture, build_ms = kept_texture(at, grid)
                prepare_ms += build_ms
                corners.append((pupil_share * focus_share, texture))
    side = max(texture.weights.shape[2] for _, texture in corners)
    first = corners[0][1]
    watch = Stopwatch()
    blended = np.zeros((*first.weights.shape[:2], side, side), np.float32)
    for share, texture in corners:
        edge = (side - texture.weights.shape[2]) // 2
        inner = slice(edge, side - edge)
        blended[:, :, inner, inner] += np.float32(share) * texture.weights
    radius_px = np.max([texture.radius_px for _, texture in corners], axis=0)
    texture = replace(first, weights=blended, radius_px=radius_px)
    states = DYNAMIC_PUPILS_MM.size * DYNAMIC_FOCI_DPT.size
    color, evaluations = _splat_texture(view, state, texture)
    return Filtered(
        color=color,
        prepare_ms=prepare_ms,
        render_ms=watch.lap_ms(),
        memory_mb=(states + 1) * texture.memory_mb,
        psf_count=states * texture.psf_count,
        tap_count=OFF_AXIS_TAPS * evaluations,
    )


def _from_texture(view, state, grid, taps, rule="coverage") -> Filtered:
    texture, prepare_ms = kept_texture(state, grid)
    watch = Stopwatch()
    color, evaluations = _splat_texture(view, state, texture, rule)
    return Filtered(
        color=color,
        prepare_ms=prepare_ms,
        render_ms=watch.lap_ms(),
        memory_mb=texture.memory_mb,
        psf_count=texture.psf_count,
        tap_count=taps * evaluations,
    )


def _ends(nodes: NDArray, value: float) -> list[tuple[float, float]]:
    lower, upper, share = bracket_axis(nodes, value)
    ends = [(float(nodes[lower]), 1.0 - float(share))]
    return [*ends, (float(nodes[upper]), float(share))] if share > 0.0 else ends


def _splat_texture(
    view: RgbdView, state: EyeState, texture: PaperTexture, rule: str = "coverage"
) -> tuple[NDArray, int]:
    """Splat every pixel with two layers of each of the blocks around its direction."""
    sources = view_sources(view, state.spec)
    ends = [
        axis.position(values)
        for axis, values in (
            (texture.v, sources.v_deg),
            (texture.h, sources.h_deg),
            (texture.distance, sources.distance_dpt),
        )
    ]
    counts = (texture.v.count, texture.h.count, texture.distance.count)
    layers, weights = [], []
    for corner in np.ndindex(2, 2, 2):
        index = [
            np.minimum(lower + step, count - 1)
            for (lower, _), step, count in zip(ends, corner, counts, strict=True)
        ]
        share = 1.0
        for (_, part), step in zip(ends, corner, strict=True):
            share = share * (part if step else 1.0 - part)
        if np.any(share > 0.0):
            layers.append(np.ravel_multi_index(index, counts))
            weights.append(share)
    layers, weights = np.stack(layers, axis=-1), np.stack(weights, axis=-1)
    used_px = np.where(weights > 0.0, texture.radius_px[layers], 0.0)
    return splat_sources(
        view,
        state,
        sources,
        texture.weights,
        np.repeat(layers[:, None], 3, axis=1),
        np.repeat(weights[:, None], 3, axis=1),
        np.ceil(used_px.max(axis=1) - 1e-9),
        rule,
    )


def splat_sources(
    view: RgbdView,
    state: EyeState,
    sources: Sources,
    texture: NDArray,
    layers: NDArray,
    weights: NDArray,
    radius_px: NDArray,
    rule: str = "coverage",
) -> tuple[NDArray, int]:
    """Splat sources near to far; image, and how many PSF values were made."""
    height, width, full = view.height_px, view.width_px, texture.shape[2] // 2
    sums = DepthSums((height, width), rule, depth_step_dpt(state))
    radius_px = np.minimum(radius_px.astype(np.int64), full)
    weights = weights.astype(np.float32)
    channels = np.arange(3)[:, None]
    evaluations = 0
    for n in sources.near_first():
        row, column = divmod(n, width)
        r = radius_px[n]
        inner = slice(full - r, full + r + 1)
        used = weights[n].any(axis=0)
        psfs = texture[layers[n][:, used], channels, inner, inner]
        kernel = np.einsum("ct,ctyx->cyx", weights[n][:, used], psfs)
        sums.add(row, column, sources.distance_dpt[n], sources.color[n], kernel)
        n_rows = min(height, row + r + 1) - max(0, row - r)
        evaluations += n_rows * (min(width, column + r + 1) - max(0, column - r))
    return sums.picture(linear_color(view)), int(evaluations)


def _padded_stack(flat, starts, radius) -> NDArray[np.float32]:
    """Texture [distance * (R + 1) + radius, channel] of all PSFs at all radii."""
    n_distances = starts.size // 3
    stack = np.zeros((n_distances * (radius + 1), 3, 2 * radius + 1, 2 * radius + 1))
    stack = stack.astype(np.float32)
    for p, start in enumerate(starts):
        for r in range(radius + 1):
            side = 2 * r + 1
            inner = slice(radius - r, radius + r + 1)
            stack[p // 3 * (radius + 1) + r, p % 3, inner, inner] = flat[
                start : start + side * side
            ].reshape(side, side)
            start += side * side
    return stack
