"""The PSFs of one eye and camera, computed when frames first need them.

Plain arrays without GL: engines copy what is new (`PsfStore.added_since`).
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from estimator.eye.focusing import OUT_OF_REACH_DPT
from estimator.field.eye_optics import EyeOptics
from estimator.optics.vergence import ObjectVergence
from filter_service.constants import RGB
from filter_service.errors import GridTooLarge, NotPrepared, OutOfMemory
from filter_service.planning.grid import LAYER_BLUR_RATIO, GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.readable import usable_pupils_mm
from filter_service.psfs.boxes import pack_reach, unpack_reach
from filter_service.psfs.field_defocus import EyeDefocus, FieldDefocus
from filter_service.psfs.read_kernels import StateReads, StoreTables

if TYPE_CHECKING:  # they load numba, and the service gets ready before
    from estimator.profiles.parse import EyeProfile
    from filter_service.psfs.node_wavefronts import NodeWavefronts
    from filter_service.psfs.pack import PackedKernels
    from filter_service.psfs.psf_engine import PsfEngine

BYTES_PER_TEXEL = 2
FIRST_TEXELS = 2**22
"""Of a new store: 8 MB; it grows by doubling."""

KEPT_AFTER_EVICTION = 0.7
"""Of the limit: the least recently used kernels beyond it are evicted together, as
moving the others together costs about 0.1 ms a megabyte."""


class PsfStore:
    """Kernels over field, pupil, accommodation, total defocus and channel.

    Node n of ``plan.defocus`` and channel c have PSF 3 n + c.  Nodes depend on eye,
    camera and settings alone; their kernels are computed by `fill`.

    Parameters
    ----------
    eye : EyeOptics
    spec : GridSpec
    plan : CachePlan
        Where the nodes are.
    engine : PsfEngine, optional
        Computes the PSFs; the processor where it is None.
    wavefronts : NodeWavefronts, optional
    blur_px : (n_psfs,), optional
        As `node_blur_px` gives it.

    Attributes
    ----------
    tables : StoreTables
        Per PSF: where it lies, how large it is.  Zeros where it is not computed.
    is_computed : (n_psfs,), bool
    last_used : (n_psfs,), uint32
        Number of the frame that read it last.
    frame_number : int
        Of the frame that is being planned; whoever plans one increments it.
    generation : int
        Incremented by evictions: every kernel may lie elsewhere since.
    methods : Counter
        PSFs by the method that computed the larger share of each.
    """

    def __init__(
        self,
        eye: EyeOptics,
        spec: GridSpec,
        plan: CachePlan,
        *,
        engine: PsfEngine | None = None,
        wavefronts: NodeWavefronts | None = None,
        blur_px: NDArray[np.float32] | None = None,
    ) -> None:
        self.eye, self.spec, self.plan, self.engine = eye, spec, plan, engine
        count = RGB * plan.defocus.values_dpt.size
        if wavefronts is None:
            from filter_service.psfs.node_wavefronts import NodeWavefronts

            wavefronts = NodeWavefronts.of(eye, spec, plan)
        self.wavefronts = wavefronts
        if blur_px is None:
            from filter_service.psfs.node_blur import node_blur_px

            blur_px = node_blur_px(eye, spec, plan, self.wavefronts)
        self.tables = StoreTables(
            values_dpt=np.array(plan.defocus.values_dpt, np.float64),
            keys_dpt=np.array(plan.defocus.keys_dpt, np.float64),
            starts=np.array(plan.defocus.starts, np.int64),
            lowest_dpt=plan.defocus.lowest_dpt,
            span_dpt=plan.defocus.span_dpt,
            channel_shift_dpt=np.array(plan.channel_shift_dpt, np.float64, order="C"),
            groups_per_field=plan.pupils_mm.size * plan.accommodations_dpt.size,
            offsets=np.zeros(count, np.uint32),
            reach_words=np.zeros(count, np.uint32),
            radius_px=np.zeros(count, np.int32),
            blur_px=np.array(blur_px, np.float32),
            spread_px=np.zeros(count, np.float32),
            peak_ratio=np.zeros(count, np.float32),
            is_computed=np.zeros(count, np.bool_),
            last_used=np.zeros(count, np.uint32),
        )
        self.methods: Counter[str] = Counter()
        self.max_lost_energy_ratio = 0.0
        self.build_ms = 0.0
        self.frame_number = 1
        self.generation = 0
        self._words = np.empty(0, np.uint16)
        self._n_words = 0
        self._added: list[NDArray[np.int64]] = []

    @property
    def parts(self) -> dict[str, Any]:
        """Arguments that make the store anew, without kernels."""
        return {
            "eye": self.eye,
            "spec": self.spec,
            "plan": self.plan,
            "wavefronts": self.wavefronts,
            "blur_px": self.tables.blur_px,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process without kernels."""
        return partial(type(self), **self.parts), ()

    @classmethod
    def of_kernels(
        cls,
        eye: EyeOptics,
        spec: GridSpec,
        plan: CachePlan,
        packed: PackedKernels,
        blur_px: NDArray[np.float64],
    ) -> Self:
        """Return a store whose kernels (n_psfs,) are given."""
        found = cls(eye, spec, plan, blur_px=blur_px.astype(np.float32))
        found._append(np.arange(found.psf_count), packed)
        return found

    # Kernels

    def fill(
        self,
        psfs: NDArray[np.int64] | None = None,
        *,
        until_s: float | None = None,
        batch_count: int | None = None,
        between: Callable[[], None] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> None:
        """Compute the kernels of PSFs that have none.

        Parameters
        ----------
        psfs : (n,), optional
            Numbers; all of them where it is None.
        until_s : float, optional
            Time of `time.monotonic` at which to stop, after the batch in hand.
        batch_count : int, optional
            PSFs computed between two looks at the time; the engine's where it is None.
        between : callable, optional
            Called after each batch but the last.
        progress : callable, optional
            Called with the share that is done.

        Raises
        ------
        NotPrepared
            Some are left at ``until_s``.
        GridTooLarge
            A kernel exceeds ``spec.max_blur_radius_px``; the message has the numbers.
        OutOfMemory
            They exceed ``spec.memory_budget_mb`` together.
        """
        from estimator.psf.compute import PsfTooLarge
        from filter_service.psfs.compute_kernels import computed_kernels
        from filter_service.psfs.psf_engine import CPU

        self.engine = self.engine or CPU
        started_s = time.perf_counter()
        psfs = np.arange(self.psf_count) if psfs is None else np.unique(psfs)
        if not self.spec.settings.chromatic:  # channels share kernels
            psfs = RGB * np.unique(psfs // RGB)
        psfs = psfs[~self.tables.is_computed[psfs]]
        step = batch_count or self.engine.batch_count
        batches = np.array_split(psfs, -(-psfs.size // step) or 1)
        for number, batch in enumerate(batches):
            batch = batch[~self.tables.is_computed[batch]]  # a frame between may have
            if not batch.size:
                continue
            try:
                packed, methods = computed_kernels(
                    *(self.eye, self.spec, self.plan, self.wavefronts),
                    *(batch, self.engine),
                )
            except PsfTooLarge as error:
                raise GridTooLarge(
                    str(error),
                    field="settings.pupil_range_mm",
                    allowed="a smaller pupil, other objects or fewer pixels per degree",
                ) from error
            self.methods += methods
            if not self.spec.settings.chromatic:
                batch = batch + np.arange(RGB)[:, None]
            self._append(batch, packed)
            if progress is not None:
                progress((number + 1) / len(batches))
            if number + 1 == len(batches):
                break
            if between is not None:
                between()
            if until_s is not None and time.monotonic() > until_s:
                raise NotPrepared
        self.build_ms += 1e3 * (time.perf_counter() - started_s)

    def _append(self, psfs: NDArray[np.int64], packed: PackedKernels) -> None:
        """Add kernels (n,) of PSFs (n,), or of several that share each (m, n)."""
        tables, count = self.tables, packed.weights.size
        self._make_room(count)
        self._words[self._n_words : self._n_words + count] = packed.weights
        tables.offsets[psfs] = packed.offsets + self._n_words
        tables.reach_words[psfs] = pack_reach(packed.reach_px)
        tables.radius_px[psfs] = packed.radius_px
        tables.spread_px[psfs] = packed.spread_px
        tables.peak_ratio[psfs] = packed.peak_ratio
        tables.is_computed[psfs] = True
        self._n_words += count
        self._added.append(psfs.ravel())
        lost = float(packed.lost_energy_ratio.max(initial=0.0))
        self.max_lost_energy_ratio = max(self.max_lost_energy_ratio, lost)

    def _make_room(self, count: int) -> None:
        needed = self._n_words + count
        if needed > self._max_words:
            self.evict(int(KEPT_AFTER_EVICTION * self._max_words) - count)
            needed = self._n_words + count
        if needed > self._max_words:
            raise OutOfMemory(
                f"the PSFs of one frame take {BYTES_PER_TEXEL * needed / 1e6:.3g} MB",
                allowed=f"{self.spec.memory_budget_mb:g} MB for one eye and camera",
            )
        if needed > self._words.size:
            grown = np.empty(max(needed, 2 * self._words.size, FIRST_TEXELS), np.uint16)
            grown[: self._n_words] = self._words[: self._n_words]
            self._words = grown

    @property
    def _max_words(self) -> int:
        return int(self.spec.memory_budget_mb * 1e6 / BYTES_PER_TEXEL)

    def evict(self, max_words: int) -> None:
        """Evict the kernels used longest ago; those of the current frame stay."""
        tables = self.tables
        own = np.flatnonzero(tables.is_computed)
        if not self.spec.settings.chromatic:
            own = own[own % RGB == 0]
        by_use = own[np.argsort(-tables.last_used[own].astype(np.int64), kind="stable")]
        widths, heights = self.box_sizes_of(by_use)
        sizes = widths * heights
        is_kept = np.cumsum(sizes) <= max_words
        is_kept |= tables.last_used[by_use] >= self.frame_number
        kept = np.sort(by_use[is_kept])
        widths, heights = self.box_sizes_of(kept)
        sizes = widths * heights
        first = np.cumsum(sizes) - sizes
        words = np.empty(max(int(sizes.sum()), FIRST_TEXELS), np.uint16)
        for psf, size, to in zip(
            kept.tolist(), sizes.tolist(), first.tolist(), strict=True
        ):
            start = int(tables.offsets[psf])
            words[to : to + size] = self._words[start : start + size]
        # Frames that were begun may still read the old arrays.
        tables = self.tables = tables._replace(offsets=tables.offsets.copy())
        gone = by_use[~is_kept]
        if not self.spec.settings.chromatic:
            kept, gone = (p + np.arange(RGB)[:, None] for p in (kept, gone))
        tables.is_computed[gone] = False
        for name in ("offsets", "reach_words", "radius_px", "spread_px", "peak_ratio"):
            getattr(tables, name)[gone] = 0
        tables.offsets[kept] = first
        self._words, self._n_words = words, int(sizes.sum())
        self._added = [kept.ravel()]
        self.generation += 1

    def box_sizes_of(self, psfs: NDArray[np.int64]) -> tuple[NDArray, NDArray]:
        """Widths and heights (n,) of kernels."""
        left, right, up, down = np.moveaxis(
            unpack_reach(self.tables.reach_words[psfs]).astype(np.int64), -1, 0
        )
        return left + right + 1, up + down + 1

    def added_since(self, n_batches: int) -> tuple[int, NDArray[np.int64]]:
        """Return the number of batches there are, and PSFs of those after some."""
        later = self._added[n_batches:]
        found = np.concatenate(later) if later else np.zeros(0, np.int64)
        return len(self._added), found

    # What frames read

    @cached_property
    def defocus(self) -> EyeDefocus:
        """Defocus of the eye's states at the field nodes."""
        h_deg, v_deg = self.plan.field_nodes_deg
        return EyeDefocus(self.eye, self.spec, h_deg=h_deg, v_deg=v_deg)

    @property
    def kernels(self) -> NDArray[np.uint16]:
        """All computed kernels (n_texels,), rows downwards, one after the other.

        In steps of the kernel's peak over WEIGHT_MAX, which is finer than half floats
        and half of what floats take.
        """
        return self._words[: self._n_words]

    @property
    def words(self) -> NDArray[np.uint16]:
        """Memory of the kernels (>= n_texels,); replaced when it grows."""
        return self._words

    @property
    def offsets(self) -> NDArray[np.int64]:
        """Where each kernel (n_psfs,) starts."""
        return self.tables.offsets.astype(np.int64)

    @property
    def reach_px(self) -> NDArray[np.int64]:
        """Columns to the left and right, rows up and down (n_psfs, 4) of centers."""
        return unpack_reach(self.tables.reach_words).astype(np.int64)

    @property
    def radius_px(self) -> NDArray[np.int32]:
        """Each kernel (n_psfs,) lies within dx² + dy² <= (R + 0.5)²."""
        return self.tables.radius_px

    @property
    def blur_px(self) -> NDArray[np.float32]:
        """Geometric blur radius (n_psfs,), see `node_blur_px`."""
        return self.tables.blur_px

    @property
    def spread_px(self) -> NDArray[np.float32]:
        """Radius (n_psfs,) of the disc with the kernel's sum of squares.

        How far it really smears: for a bright core in a wide skirt much less than
        ``blur_px``.
        """
        return self.tables.spread_px

    @property
    def peak_ratio(self) -> NDArray[np.float32]:
        """Largest weight (n_psfs,)."""
        return self.tables.peak_ratio

    @property
    def psf_count(self) -> int:
        """Number of nodes times channels, computed or not."""
        return int(self.tables.offsets.size)

    @property
    def computed_count(self) -> int:
        """Number of PSFs that are computed."""
        return int(np.count_nonzero(self.tables.is_computed))

    @property
    def memory_mb(self) -> float:
        """Size of the kernels."""
        return self.kernels.nbytes / 1e6

    @property
    def tables_mb(self) -> float:
        """Size of what is known of each node."""
        return sum(a.nbytes for a in self.tables if isinstance(a, np.ndarray)) / 1e6


def build_psf_store(
    eye: EyeOptics | EyeProfile,
    spec: GridSpec,
    *,
    plan: CachePlan | None = None,
    engine: PsfEngine | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> PsfStore:
    """Compute every PSF that frames of this camera, pupil and focus range can need.

    Parameters
    ----------
    eye : EyeOptics or EyeProfile
        A profile is used as the measured wavefront.
    plan : CachePlan, optional
        Nodes other than those that `planning.plan.plan_cache` chooses.
    engine : PsfEngine
    progress : callable, optional
        Called with a fraction 0..1 and a stage.

    Raises
    ------
    GridTooLarge
        A kernel exceeds ``spec.max_blur_radius_px``; the message has the numbers.
    filter_service.planning.plan.PlanTooLarge
    """
    from estimator.profiles.measured_wavefront import MeasuredWavefront
    from estimator.profiles.parse import EyeProfile
    from filter_service.planning.plan import plan_cache

    if isinstance(eye, EyeProfile):
        eye = MeasuredWavefront.from_profile(eye)
    store = PsfStore(eye, spec, plan or plan_cache(eye, spec), engine=engine)
    store.fill(progress=None if progress is None else lambda f: progress(f, "psfs"))
    return store


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
    layer_blur_px : (n_layers,)
        Largest geometric blur radius over field and channels.
    edge_reach_px : float
        How much farther than rays a kernel reaches: the diffraction at the pupil's edge
        that ``spec.kept_energy_ratio`` keeps.
    """

    layer_dpt: NDArray[np.float64]
    vergence: ObjectVergence
    vergence_range_dpt: tuple[float, float]
    field: FieldDefocus
    layer_zero_dpt: NDArray[np.float64]
    reads: StateReads
    layer_blur_px: NDArray[np.float64]
    edge_reach_px: float
    pupil_diameter_mm: float
    focus_dpt: float
    blur_px_per_dpt: float
    notes: tuple[str, ...]

    def reach_px(self, low_dpt: float, high_dpt: float, *, max_px: int) -> int:
        """Bound how far light of objects between two distances is spread, px."""
        low, high = (float(self.vergence.vergence_dpt(d)) for d in (low_dpt, high_dpt))
        change_low, change_high = self.field.range_dpt
        first, last = np.searchsorted(
            self.layer_dpt, [low + change_low, high + change_high]
        )
        within = slice(max(first - 1, 0), last + 1)
        blur_px = float(self.layer_blur_px[within].max(initial=0.0))
        return min(int(np.ceil(blur_px + self.edge_reach_px)), max_px)


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
    from filter_service.psfs.read_loops import layer_blur_px

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
        layer_blur_px=layer_blur_px(store.tables, reads, layer_zero_dpt, layer_dpt).max(
            axis=1
        ),
        edge_reach_px=_edge_reach_px(store.spec, pupil_mm),
        pupil_diameter_mm=pupil_mm,
        focus_dpt=reached_dpt,
        blur_px_per_dpt=blur_px_per_dpt,
        notes=notes,
    )


def _edge_reach_px(spec: GridSpec, pupil_mm: float) -> float:
    """Distance beyond the rays that holds all but the light that kernels may drop.

    A circular pupil of diameter D sends 2 lambda / (pi² D r) of its light farther than
    r from the spot's edge.
    """
    if not spec.settings.diffraction:
        return 1.0  # a pixel that a ray lands in
    wavelength_um = float(spec.channel_wavelengths_nm.max()) / 1e3
    lost = max(1.0 - spec.kept_energy_ratio, 1e-6)
    reach_mrad = 2.0 * wavelength_um / (np.pi**2 * pupil_mm * lost)
    return reach_mrad / min(spec.pixel_pitch_mrad)


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
