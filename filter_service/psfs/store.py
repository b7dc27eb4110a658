"""The PSF cache of one eye and camera, and the layers of one frame.

Plain arrays without GL: the worker fills it, the renderer uploads it.
"""

from bisect import bisect_left
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.eye.focusing import OUT_OF_REACH_DPT
from estimator.field.eye_optics import EyeOptics
from estimator.optics.vergence import ObjectVergence
from filter_service.planning.grid import LAYER_BLUR_RATIO, GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.readable import usable_pupils_mm
from filter_service.psfs.boxes import pack_reach
from filter_service.psfs.field_defocus import EyeDefocus, FieldDefocus
from filter_service.psfs.read_kernels import StateReads, StoreTables


@dataclass(frozen=True)
class PsfStore:
    """Kernels over field, pupil, accommodation, total defocus and channel.

    Node n of ``plan.defocus`` and channel c have PSF 3 n + c.

    Attributes
    ----------
    plan : CachePlan
        Where the nodes are.
    kernels : (n_texels,), uint16
        All kernels, rows downwards, one after the other; in steps of the kernel's peak
        over WEIGHT_MAX, which is finer than half floats and half of what floats take.
    offsets : (n_psfs,)
        Where a kernel starts.
    reach_px : (n_psfs, 4)
        Its columns to the left and right, its rows up and down of the centre.
    radius_px : (n_psfs,)
        It lies within dx² + dy² <= (R + 0.5)².
    blur_px : (n_psfs,)
        Geometric blur radius.
    spread_px : (n_psfs,)
        Radius of the disc with the kernel's sum of squares: how far it really smears,
        which for a bright core in a wide skirt is much less than ``blur_px``.
    peak_ratio : (n_psfs,)
        Largest weight.
    """

    spec: GridSpec
    eye: EyeOptics
    plan: CachePlan
    kernels: NDArray[np.uint16]
    offsets: NDArray[np.int64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    blur_px: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    peak_ratio: NDArray[np.float64]
    methods: dict[str, int] = field(default_factory=dict)
    max_lost_energy_ratio: float = 0.0
    build_ms: float = 0.0

    @cached_property
    def defocus(self) -> EyeDefocus:
        """Defocus of the eye's states at the field nodes."""
        h_deg, v_deg = self.plan.field_nodes_deg
        return EyeDefocus(self.eye, self.spec, h_deg=h_deg, v_deg=v_deg)

    @cached_property
    def tables(self) -> StoreTables:
        """What plans of frames read, copied: a stored file's arrays cannot be written.

        Compiled loops would be compiled once more for those.
        """
        plan, nodes = self.plan, self.plan.defocus
        return StoreTables(
            values_dpt=np.array(nodes.values_dpt, np.float64),
            keys_dpt=np.array(nodes.keys_dpt, np.float64),
            starts=np.array(nodes.starts, np.int64),
            lowest_dpt=nodes.lowest_dpt,
            span_dpt=nodes.span_dpt,
            channel_shift_dpt=np.array(plan.channel_shift_dpt, np.float64, order="C"),
            groups_per_field=plan.pupils_mm.size * plan.accommodations_dpt.size,
            offsets=np.array(self.offsets, np.uint32),
            reach_words=pack_reach(self.reach_px),
            radius_px=np.array(self.radius_px, np.int64),
            blur_px=np.array(self.blur_px, np.float64),
            spread_px=np.array(self.spread_px, np.float64),
            peak_ratio=np.array(self.peak_ratio, np.float64),
        )

    @property
    def psf_count(self) -> int:
        """Number of kernels."""
        return len(self.offsets)

    @property
    def memory_mb(self) -> float:
        """Size of the kernels."""
        return self.kernels.nbytes / 1e6


@dataclass(frozen=True)
class FrameLayers:
    """How an eye in one state reads its cache, and the layers that frames then have.

    Attributes
    ----------
    layer_dpt : (n_layers,)
        Ascending: an object's vergence plus the change of defocus over the field, so
        that at one layer field nodes have the same defocus and are blended at equal
        blur.
    vergence : ObjectVergence
        From distances of objects to vergences.
    field : FieldDefocus
        That change; none in the paper's grids, whose nodes are object distances.
    vergence_range_dpt : (low, high)
        Vergences that the layers are for.
    layer_zero_dpt : (n_fields, 3)
        Total defocus at layer 0 dpt, per field node and channel.
    reads : StateReads
        Cached neighbours of the state.
    max_radius_px : int
        No kernel of these layers is larger.
    """

    layer_dpt: NDArray[np.float64]
    vergence: ObjectVergence
    vergence_range_dpt: tuple[float, float]
    field: FieldDefocus
    layer_zero_dpt: NDArray[np.float64]
    reads: StateReads
    max_radius_px: int
    pupil_diameter_mm: float
    focus_dpt: float
    blur_px_per_dpt: float
    notes: tuple[str, ...]


def frame_layers(
    store: PsfStore,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    object_range_dpt: tuple[float, float] | None = None,
    step_ratio: float = 1.0,
) -> FrameLayers:
    """Plan a frame's layers for a pupil and focus.

    The pupil is clamped to the cache's range and to what was measured, with a note.

    Parameters
    ----------
    object_range_dpt : (low, high), optional
        Distances in the frame; default and limit is the cache's range.
    step_ratio : float
        Steps between layers against the usual.

    References
    ----------
    Csoba & Kunkli 2023, section 6.4 (cached neighbours of pupil and focus) and 6.2.
    """
    # Whoever holds a store need not load numba: the service gets ready before.
    from filter_service.psfs.layer_loops import layer_distances_dpt
    from filter_service.psfs.read_loops import largest_radius_px

    plan, eye = store.plan, store.eye
    pupil_mm, notes = _usable_pupil(store, pupil_diameter_mm)
    accommodation_dpt = eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm)
    reached_dpt = eye.sharpest_dpt(accommodation_dpt, pupil_diameter_mm=pupil_mm)
    is_met = abs(reached_dpt - focus_dpt) <= OUT_OF_REACH_DPT
    if not is_met or pupil_mm != pupil_diameter_mm:
        notes += eye.notes(pupil_diameter_mm=pupil_diameter_mm, focus_dpt=focus_dpt)
    at_infinity_dpt, change = store.defocus.state(
        pupil_diameter_mm=pupil_mm, accommodation_dpt=accommodation_dpt
    )
    layer_zero_dpt = at_infinity_dpt - store.defocus.change_at_nodes_dpt(change)
    corners = tuple(
        (pupil, used, pupil_weight * used_weight)
        for pupil, pupil_weight in _neighbours(plan.pupils_mm, pupil_mm)
        for used, used_weight in _neighbours(plan.accommodations_dpt, accommodation_dpt)
        if pupil_weight * used_weight > 0.0
    )
    notes += _limit_notes(store, corners)
    reads = _state_reads(store, pupil_mm, corners)
    far_dpt, near_dpt = object_range_dpt or store.spec.object_range_dpt
    far_near_dpt = (
        float(eye.vergence.vergence_dpt(far_dpt)),
        float(eye.vergence.vergence_dpt(near_dpt)),
    )
    low_dpt, high_dpt = change.range_dpt
    in_focus_dpt = _in_focus_dpt(store, layer_zero_dpt[plan.axis_node])
    blur_px_per_dpt = store.spec.blur_px_per_dpt(pupil_mm)
    layer_dpt = layer_distances_dpt(
        *(store.tables, reads, layer_zero_dpt),
        (far_near_dpt[0] + low_dpt, far_near_dpt[1] + high_dpt),
        np.append(in_focus_dpt, _plane_ends_dpt(store, change)),
        *(blur_px_per_dpt, LAYER_BLUR_RATIO[store.spec.settings.mode], step_ratio),
    )
    return FrameLayers(
        layer_dpt=layer_dpt,
        vergence=eye.vergence,
        vergence_range_dpt=far_near_dpt,
        field=change,
        layer_zero_dpt=layer_zero_dpt,
        reads=reads,
        max_radius_px=largest_radius_px(
            store.tables, reads, layer_zero_dpt, layer_dpt[0], layer_dpt[-1]
        ),
        pupil_diameter_mm=pupil_mm,
        focus_dpt=reached_dpt,
        blur_px_per_dpt=blur_px_per_dpt,
        notes=notes,
    )


def _plane_ends_dpt(store: PsfStore, change: FieldDefocus) -> NDArray[np.float64]:
    """Return where layers of several planes end: in the gaps are no PSFs."""
    ranges_dpt = store.spec.object_ranges_dpt
    if len(ranges_dpt) == 1:
        return np.zeros(0)
    vergences_dpt = store.eye.vergence.vergence_dpt(np.array(ranges_dpt))
    return (vergences_dpt + change.range_dpt).ravel()


def _limit_notes(store: PsfStore, corners: tuple) -> tuple[str, ...]:
    if not store.plan.has_limits:
        return ()
    limited = store.plan.is_limited.reshape(store.plan.group_shape)
    if not any(limited[:, :, pupil, used].any() for pupil, used, _ in corners):
        return ()
    return (
        f"blur beyond {store.spec.max_blur_radius_px} px, in part of the field, is "
        "drawn as that",
    )


def _usable_pupil(store: PsfStore, pupil_diameter_mm: float) -> tuple[float, tuple]:
    usable_mm = store.eye.usable_pupil_mm(pupil_diameter_mm)
    low_mm, high_mm = store.plan.pupils_mm[0], store.plan.pupils_mm[-1]
    if low_mm == high_mm:  # one node for a range
        low_mm, high_mm = usable_pupils_mm(store.eye, store.spec)
    clamped_mm = float(np.clip(usable_mm, low_mm, high_mm))
    if abs(clamped_mm - usable_mm) <= 1e-9:
        return clamped_mm, ()
    note = (
        f"pupil {pupil_diameter_mm:g} mm is outside the prepared "
        f"{low_mm:.3g} to {high_mm:.3g} mm: {clamped_mm:.3g} mm used"
    )
    return clamped_mm, (note,)


def _neighbours(nodes: NDArray, value: float) -> list[tuple[int, float]]:
    """Return the nodes on both sides of a value and their weights.

    As `bracket_axis` has them, in plain numbers: that costs a tenth.
    """
    axis = nodes.tolist()
    upper = min(bisect_left(axis, value), len(axis) - 1)
    lower = max(upper - 1, 0)
    upper = min(lower + 1, len(axis) - 1)
    span = axis[upper] - axis[lower] or 1.0
    share = min(max((value - axis[lower]) / span, 0.0), 1.0)
    return [(lower, 1.0 - share), (upper, share)]


def _in_focus_dpt(
    store: PsfStore, at_infinity_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Vergences at which some channel is sharp; at several foci, where an eye has."""
    if store.eye.rings is None:
        return -at_infinity_dpt
    channels_nm = store.spec.channel_wavelengths_nm.tolist()
    return np.concatenate(
        [
            store.eye.rings.main_dpt(nm) - zero_dpt
            for nm, zero_dpt in zip(channels_nm, at_infinity_dpt, strict=True)
        ]
    )


def _state_reads(store: PsfStore, pupil_mm: float, corners: tuple) -> StateReads:
    plan = store.plan
    n_used = plan.accommodations_dpt.size
    scales = np.array([pupil_mm / plan.pupils_mm[pupil] for pupil, _, _ in corners])
    if store.eye.rings is not None:  # foci stay where they are in any pupil
        scales = np.ones(len(corners))
    return StateReads(
        groups=np.array([pupil * n_used + used for pupil, used, _ in corners]),
        scales=scales,
        weights=np.array([weight for _, _, weight in corners]),
    )
