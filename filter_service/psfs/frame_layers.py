"""Interpolation of PSFs for one state of an eye, and the layers of a frame."""

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.focusing import OUT_OF_REACH_DPT
from estimator.note import Note
from estimator.optics.vergence import ObjectVergence
from filter_service.constants import MERGE_MIN_SPREAD_PX
from filter_service.native import loops
from filter_service.planning.grid import (
    BASE_OBJECT_STEP_DPT,
    GREEN,
    LAYER_BLUR_RATIO,
    LAYER_GAP_STEPS,
    MIN_BLUR_STEP_PX,
    GridSpec,
)
from filter_service.planning.nodes import PlanAxes, usable_pupils_mm
from filter_service.psfs.field_defocus import FieldDefocus
from filter_service.psfs.pack import StateReads, StoreTables, layer_blur_px
from filter_service.psfs.store import PsfStore, StateNode
from filter_service.view_state import State

CURVE_MARGIN_DPT = 1.0
"""Range of a step curve beyond the layers of its node, for states between nodes."""

LAYER_SPACING = 0.97
"""Distance between layers in steps of the curves, which are interpolated: whole steps
of them are 1.02 to 1.03 blur steps (means of the largest, six eyes)."""

ROUNDING_DPT = 1e-9
"""Rounding error of total defocus."""

USUAL_LAYERS = 256
"""Layers of a frame that take one call of the C library; more take a second one."""


@dataclass(frozen=True)
class BlurLimits:
    """Object distances of a state whose blur fits in the largest kernel.

    Attributes
    ----------
    radius_px : int
        Radius of the largest kernel.
    low_dpt, high_dpt : (n_fields,)
        Limits of object vergence per field node.  Kernels of objects beyond them are
        those of the limit; if the first limit exceeds the second, all objects are
        beyond.
    """

    radius_px: int
    low_dpt: NDArray[np.float64]
    high_dpt: NDArray[np.float64]


@dataclass(frozen=True)
class FrameLayers:
    """Layers of the frames of one state of an eye, and the PSFs that they read.

    Attributes
    ----------
    layer_dpt : (n_layers,)
        Object vergence plus the change of defocus over the field, ascending.  All field
        nodes thus have the same defocus in a layer and are blended at equal blur.
    vergence : ObjectVergence
        Conversion from object distances to vergences.
    field : FieldDefocus
        Change of defocus over the field; none in the paper's grids, whose nodes are
        object distances.
    vergence_range_dpt : (low, high)
        Object vergences that the layers cover.
    layer_zero_dpt : (n_fields, 3)
        Total defocus at layer 0 dpt, per field node and channel.
    reads : StateReads
        Neighboring nodes of the state.
    tables : StoreTables
        Nodes of the cache.
    edge_reach_px : float
        Distance to which kernels extend beyond the rays: diffraction at the pupil's
        edge that ``spec.kept_energy_ratio`` keeps.
    state : State
        Pupil and focus that are reached; the gaze is not theirs.
    merge_spread_px : float
        Smallest spread of kernels that merged squares may use.
    limits : BlurLimits or None
        Distances whose blur fits in the largest kernel; None if it always fits.
    """

    layer_dpt: NDArray[np.float64]
    vergence: ObjectVergence
    vergence_range_dpt: tuple[float, float]
    field: FieldDefocus
    layer_zero_dpt: NDArray[np.float64]
    reads: StateReads
    tables: StoreTables
    edge_reach_px: float
    state: State
    blur_px_per_dpt: float
    notes: tuple[str, ...]
    merge_spread_px: float = MERGE_MIN_SPREAD_PX
    limits: BlurLimits | None = None

    @cached_property
    def layer_blur_px(self) -> NDArray[np.float64]:
        """Largest geometric blur radius (n_layers,) over field and channels."""
        blur_px = layer_blur_px(
            self.tables, self.reads, self.layer_zero_dpt, self.layer_dpt
        )
        largest_px: NDArray[np.float64] = blur_px.max(axis=0)
        return largest_px

    def reach_px(self, low_dpt: float, high_dpt: float, *, max_px: int) -> int:
        """Return an upper limit of the blur, px, of objects in a range."""
        low, high = (float(self.vergence.vergence_dpt(d)) for d in (low_dpt, high_dpt))
        change_low, change_high = self.field.range_dpt
        first, last = np.searchsorted(
            self.layer_dpt, [low + change_low, high + change_high]
        )
        within = slice(max(first - 1, 0), last + 1)
        blur_px = float(self.layer_blur_px[within].max(initial=0.0))
        return min(int(np.ceil(blur_px + self.edge_reach_px)), max_px)

    def limit_notes(
        self, fields: NDArray[np.int64], low_dpt: float, high_dpt: float
    ) -> tuple[str, ...]:
        """Return a note if the blur of a frame exceeds the largest kernel.

        Parameters
        ----------
        fields : (n, m)
            Field nodes that the frame reads.
        low_dpt, high_dpt : float
            Object distances in the frame.
        """
        if self.limits is None:
            return ()
        limits, used = self.limits, np.unique(fields)
        far_dpt, near_dpt = np.clip(
            self.vergence.vergence_dpt(np.array([low_dpt, high_dpt])),
            *self.vergence_range_dpt,
        )
        is_within = (
            far_dpt >= limits.low_dpt[used].max() - ROUNDING_DPT
            and near_dpt <= limits.high_dpt[used].min() + ROUNDING_DPT
        )
        if is_within:
            return ()
        note = Note(
            "blur_limited",
            "in part of the field, blur exceeds the largest kernel and is limited to a "
            f"radius of {limits.radius_px} px",
            radius_px=limits.radius_px,
        )
        return (note,)


def frame_layers(
    store: PsfStore,
    state: State,
    *,
    object_range_dpt: tuple[float, float] | None = None,
    step_ratio: float = 1.0,
    merge_spread_px: float = MERGE_MIN_SPREAD_PX,
) -> FrameLayers:
    """Plan the layers of a frame for the pupil and focus of a state.

    The pupil is clamped to the cache's range and the measured pupil, with a note.

    Parameters
    ----------
    object_range_dpt : (low, high), optional
        Object distances in the frame; by default the range of the cache.
    step_ratio : float
        Steps between layers relative to the default.
    merge_spread_px : float
        As in `FrameLayers`.

    References
    ----------
    Csoba & Kunkli 2023, section 6.4 (cached neighbors of pupil and focus) and 6.2.
    """
    plan, eye = store.plan, store.eye
    pupil_mm, notes = _usable_pupil(store, state.pupil_diameter_mm)
    accommodation_dpt = eye.accommodation_dpt(
        state.focus_dpt, pupil_diameter_mm=pupil_mm
    )
    reached_dpt = eye.sharpest_dpt(accommodation_dpt, pupil_diameter_mm=pupil_mm)
    is_met = abs(reached_dpt - state.focus_dpt) <= OUT_OF_REACH_DPT
    if not is_met or pupil_mm != state.pupil_diameter_mm:
        notes += eye.notes(
            pupil_diameter_mm=state.pupil_diameter_mm, focus_dpt=state.focus_dpt
        )
    layer_zero_dpt, change = _layer_zero_dpt(store, pupil_mm, accommodation_dpt)
    corners = _corners(plan, pupil_mm, accommodation_dpt)
    reads = _state_reads(store, pupil_mm, corners)
    far_dpt, near_dpt = object_range_dpt or store.spec.object_range_dpt
    far_near_dpt = (
        float(eye.vergence.vergence_dpt(far_dpt)),
        float(eye.vergence.vergence_dpt(near_dpt)),
    )
    low_dpt, high_dpt = change.range_dpt
    axis_zero_dpt = layer_zero_dpt[plan.axis_node]
    layer_dpt = _layer_distances_dpt(
        [_step_curve(store, *corner[:2]) for corner in corners],
        *(reads, float(axis_zero_dpt[GREEN])),
        (far_near_dpt[0] + low_dpt, far_near_dpt[1] + high_dpt),
        *(_plane_ends_dpt(store, change), _in_focus_dpt(store, axis_zero_dpt)),
        LAYER_SPACING * step_ratio,
    )
    return FrameLayers(
        layer_dpt=layer_dpt,
        vergence=eye.vergence,
        vergence_range_dpt=far_near_dpt,
        field=change,
        layer_zero_dpt=layer_zero_dpt,
        reads=reads,
        tables=store.tables,
        edge_reach_px=edge_reach_px(store.spec, pupil_mm),
        state=State(pupil_mm, float(reached_dpt)),
        blur_px_per_dpt=store.spec.blur_px_per_dpt(pupil_mm),
        notes=notes,
        merge_spread_px=merge_spread_px,
        limits=blur_limits(store, reads, layer_zero_dpt, change),
    )


def blur_limits(
    store: PsfStore,
    reads: StateReads,
    layer_zero_dpt: NDArray[np.float64],
    change: FieldDefocus,
) -> BlurLimits | None:
    """Return the object distances of a state whose blur fits in the largest kernel.

    Returns None if the nodes of the state end at no limit.  The parameters are those
    of `FrameLayers`.
    """
    nodes, defocus = store.nodes, store.nodes.defocus
    groups = reads.groups[:, None] + np.arange(store.fields_count)
    is_limited = nodes.is_limited[groups]
    if not is_limited.any():
        return None
    at_infinity_dpt = layer_zero_dpt + store.defocus.change_at_nodes_dpt(change)
    ends = defocus.starts[groups], defocus.starts[groups + 1] - 1
    low_dpt, high_dpt = (
        (defocus.values_dpt[end][..., None] + nodes.channel_shift_dpt[groups])
        / reads.scales[:, None, None]
        - at_infinity_dpt
        for end in ends
    )
    is_shrunk = nodes.shrink_ratio[groups] != 1.0
    lows_dpt = np.where(is_shrunk, np.inf, low_dpt.max(axis=-1))
    highs_dpt = np.where(is_shrunk, -np.inf, high_dpt.min(axis=-1))
    return BlurLimits(
        store.spec.max_blur_radius_px,
        np.where(is_limited, lows_dpt, -np.inf).max(axis=0),
        np.where(is_limited, highs_dpt, np.inf).min(axis=0),
    )


def state_nodes(store: PsfStore, state: State) -> tuple[StateNode, ...]:
    """Return the nodes of pupil and accommodation that frames of a state read."""
    pupil_mm, _ = _usable_pupil(store, state.pupil_diameter_mm)
    accommodation_dpt = store.eye.accommodation_dpt(
        state.focus_dpt, pupil_diameter_mm=pupil_mm
    )
    corners = _corners(store.plan, pupil_mm, accommodation_dpt)
    return tuple(corner[:2] for corner in corners)


def _layer_zero_dpt(
    store: PsfStore, pupil_mm: float, accommodation_dpt: float
) -> tuple[NDArray[np.float64], FieldDefocus]:
    """Return the total defocus at layer 0 dpt, and its change over the field."""
    at_infinity_dpt, change = store.defocus.state(
        pupil_diameter_mm=pupil_mm, accommodation_dpt=accommodation_dpt
    )
    return at_infinity_dpt - store.defocus.change_at_nodes_dpt(change), change


def _step_curve(store: PsfStore, pupil: int, accommodation: int) -> NDArray[np.float64]:
    """Return the step curve (2, n) of a node of pupil and accommodation, cached.

    Its rows are total defocus on the axis and the number of layers from the first focus
    of green light to there.  States between the nodes interpolate it, so that no frame
    reads the blur of all nodes: that would take 0.1 to 0.3 ms.
    """
    found = store.step_curves.get((pupil, accommodation))
    if found is not None:
        return found
    plan, spec = store.plan, store.spec
    pupil_mm = float(plan.pupils_mm[pupil])
    zero_dpt, change = _layer_zero_dpt(
        store, pupil_mm, float(plan.accommodations_dpt[accommodation])
    )
    far_dpt, near_dpt = (
        float(store.eye.vergence.vergence_dpt(end)) for end in spec.object_range_dpt
    )
    low_dpt, high_dpt = change.range_dpt
    regular = np.arange(
        far_dpt + low_dpt - CURVE_MARGIN_DPT,
        near_dpt + high_dpt + CURVE_MARGIN_DPT + BASE_OBJECT_STEP_DPT,
        BASE_OBJECT_STEP_DPT,
    )
    axis_zero_dpt = zero_dpt[plan.axis_node]
    in_focus_dpt = _in_focus_dpt(store, axis_zero_dpt)
    is_inside = (in_focus_dpt > regular[0]) & (in_focus_dpt < regular[-1])
    at_dpt = np.unique(np.append(regular, in_focus_dpt[is_inside]))
    reads = _state_reads(store, pupil_mm, ((pupil, accommodation, 1.0),))
    blur_ratio = LAYER_BLUR_RATIO[spec.settings.mode]
    steps = np.empty((4, at_dpt.size))
    loops().call(
        "step_curve",
        *(store.tables.record(), reads.record()),
        *(np.ascontiguousarray(zero_dpt), at_dpt, steps, len(zero_dpt), at_dpt.size),
        *(blur_ratio, MIN_BLUR_STEP_PX, LAYER_GAP_STEPS * blur_ratio),
        *(max(spec.blur_px_per_dpt(pupil_mm), 1e-12), BASE_OBJECT_STEP_DPT),
    )
    green_nm = float(spec.channel_wavelengths_nm[GREEN])
    first_focus_dpt = _foci_dpt(store, green_nm)[0] - axis_zero_dpt[GREEN]
    from_focus = steps[0] - np.interp(first_focus_dpt, at_dpt, steps[0])
    found = np.stack([at_dpt + axis_zero_dpt[GREEN], from_focus])
    store.step_curves[pupil, accommodation] = found
    return found


def _layer_distances_dpt(
    curves: list[NDArray[np.float64]],
    reads: StateReads,
    zero_dpt: float,
    range_dpt: tuple[float, float],
    ends_dpt: NDArray[np.float64],
    in_focus_dpt: NDArray[np.float64],
    step_ratio: float,
) -> NDArray[np.float64]:
    """Return the vergences (n_layers,) of a frame's layers over a range, ascending.

    They lie at whole numbers of steps from the vergence in focus, and at the ends of
    the range.  Equal parts of the range would all move when their number changes: by up
    to 6e-3 of white, at 0.3 % of the pupil.

    Parameters
    ----------
    curves : list of (2, n)
        Step curve of each node around the state; see `_step_curve`.
    zero_dpt : float
        Total defocus of the eye at 0 dpt.
    ends_dpt : (n,)
        More vergences that are layers if they are in the range: ends of planes.
    in_focus_dpt : (n,)
        Vergences at which some channel is in focus: the blur is monotonic between them.

    References
    ----------
    Csoba & Kunkli 2023, Eq. 8: L = ceil(|R(k+1) - R(k)|) - 1 transitional layers, here
    with steps proportional to R, and none where R is constant.
    """
    low_dpt, high_dpt = range_dpt
    given_dpt = np.concatenate([[low_dpt, high_dpt], ends_dpt, in_focus_dpt])
    given_dpt = given_dpt[(given_dpt >= low_dpt) & (given_dpt <= high_dpt)]
    regular = np.arange(low_dpt, high_dpt, BASE_OBJECT_STEP_DPT)
    at_dpt = np.unique(np.append(regular, given_dpt))
    if at_dpt.size == 1:
        return at_dpt
    starts = np.array([0, *accumulate(curve.shape[1] for curve in curves)])
    steps = np.empty(at_dpt.size)
    is_inside = (ends_dpt > low_dpt) & (ends_dpt < high_dpt)
    ends = np.unique(np.searchsorted(at_dpt, [low_dpt, *ends_dpt[is_inside], high_dpt]))
    arguments = (
        *(np.concatenate(curves, axis=1), starts, reads.scales, reads.weights),
        *(at_dpt, steps, len(curves), at_dpt.size, zero_dpt, step_ratio),
        *(ends, ends.size),
    )
    found_dpt = np.empty(USUAL_LAYERS)
    count = loops().call("layers_of_state", *arguments, found_dpt, found_dpt.size)
    if count > found_dpt.size:
        found_dpt = np.empty(count)
        loops().call("layers_of_state", *arguments, found_dpt, count)
    return found_dpt[:count]


def edge_reach_px(spec: GridSpec, pupil_mm: float) -> float:
    """Return the distance from the rays beyond which kernels may drop the light.

    A circular pupil of diameter D sends 2 lambda / (pi² D r) of its light farther than
    r from the spot's edge.
    """
    if not spec.settings.diffraction:
        return 1.0  # the pixel that a ray lands in
    wavelength_um = float(spec.channel_wavelengths_nm.max()) / 1e3
    lost = max(1.0 - spec.kept_energy_ratio, 1e-6)
    reach_mrad = 2.0 * wavelength_um / (np.pi**2 * pupil_mm * lost)
    return reach_mrad / min(spec.pixel_pitch_mrad)


def _plane_ends_dpt(store: PsfStore, change: FieldDefocus) -> NDArray[np.float64]:
    """Return the ends of the layers of several planes; the gaps have no PSFs."""
    ranges_dpt = store.spec.object_ranges_dpt
    if len(ranges_dpt) == 1:
        return np.zeros(0)
    vergences_dpt = store.eye.vergence.vergence_dpt(np.array(ranges_dpt))
    return (vergences_dpt + change.range_dpt).ravel()


def _usable_pupil(
    store: PsfStore, pupil_diameter_mm: float
) -> tuple[float, tuple[str, ...]]:
    usable_mm = store.eye.usable_pupil_mm(pupil_diameter_mm)
    low_mm, high_mm = store.plan.pupils_mm[0], store.plan.pupils_mm[-1]
    if low_mm == high_mm:  # a single node, for a range of pupils
        low_mm, high_mm = usable_pupils_mm(store.eye, store.spec)
    clamped_mm = float(np.clip(usable_mm, low_mm, high_mm))
    if abs(clamped_mm - usable_mm) <= 1e-9:
        return clamped_mm, ()
    note = Note(
        "pupil_not_prepared",
        f"pupil_diameter_mm {pupil_diameter_mm:g} is outside the prepared range of "
        f"{low_mm:.3g} to {high_mm:.3g} mm; using {clamped_mm:.3g} mm",
        pupil_diameter_mm=pupil_diameter_mm,
        low_mm=low_mm,
        high_mm=high_mm,
        used_mm=clamped_mm,
    )
    return clamped_mm, (note,)


def _corners(
    plan: PlanAxes, pupil_mm: float, accommodation_dpt: float
) -> tuple[tuple[int, int, float], ...]:
    """Return nodes of pupil and accommodation around a state, with their weights.

    They are the corners of a triangle as in `planning.nodes.triangle`, computed with
    scalars in a tenth of the time.
    """
    pupil, next_pupil, part = _bracket(plan.pupils_mm, pupil_mm)
    accommodation, next_accommodation, other_part = _bracket(
        plan.accommodations_dpt, accommodation_dpt
    )
    low, high = min(part, other_part), max(part, other_part)
    between = (
        (next_pupil, accommodation)
        if part >= other_part
        else (pupil, next_accommodation)
    )
    corners = (
        (pupil, accommodation, 1.0 - high),
        (*between, high - low),
        (next_pupil, next_accommodation, low),
    )
    return tuple(corner for corner in corners if corner[-1] > 0.0)


def _bracket(nodes: NDArray[Any], value: float) -> tuple[int, int, float]:
    """Return the nodes on both sides of a value and the share of the upper one."""
    axis = nodes.tolist()
    upper = min(bisect_left(axis, value), len(axis) - 1)
    lower = max(upper - 1, 0)
    upper = min(lower + 1, len(axis) - 1)
    span = axis[upper] - axis[lower] or 1.0
    return lower, upper, min(max((value - axis[lower]) / span, 0.0), 1.0)


def _in_focus_dpt(
    store: PsfStore, at_infinity_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the vergences at which some channel is sharp, for all foci of the eye."""
    channels_nm = store.spec.channel_wavelengths_nm.tolist()
    return np.concatenate(
        [
            _foci_dpt(store, nm) - zero_dpt
            for nm, zero_dpt in zip(channels_nm, at_infinity_dpt, strict=True)
        ]
    )


def _foci_dpt(store: PsfStore, wavelength_nm: float) -> NDArray[np.float64]:
    """Return the total defocus (n,) of each focus; colors may have several numbers."""
    rings = store.eye.rings
    return np.zeros(1) if rings is None else rings.main_dpt(wavelength_nm)


def _state_reads(
    store: PsfStore, pupil_mm: float, corners: tuple[Any, ...]
) -> StateReads:
    plan = store.plan
    scales = np.array([pupil_mm / plan.pupils_mm[pupil] for pupil, _, _ in corners])
    if store.eye.rings is not None:  # foci are the same in any pupil
        scales = np.ones(len(corners))
    return StateReads(
        groups=store.groups_of([corner[:2] for corner in corners]),
        scales=scales,
        weights=np.array([weight for _, _, weight in corners]),
    )
