"""The PSFs of one eye and camera, computed when frames first need them.

Plain arrays without GL: engines copy what is new (`PsfStore.added_since`).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.constants import RGB
from filter_service.errors import (
    BuildFailed,
    GridTooLarge,
    NotPrepared,
    OutOfMemory,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.psfs.boxes import pack_reach, unpack_reach
from filter_service.psfs.field_defocus import EyeDefocus
from filter_service.psfs.read_kernels import StoreTables

if TYPE_CHECKING:  # they load numba, and the service gets ready before
    from estimator.profiles.parse import EyeProfile
    from filter_service.psfs.native_psfs import NodeRings
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
        Computes the PSFs; that of `psf_engine` where it is None.
    wavefronts : NodeWavefronts, optional

    Attributes
    ----------
    tables : StoreTables
        For each PSF: whether it is computed, where its kernel lies, how large it is.
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
    ) -> None:
        self.eye, self.spec, self.plan, self.engine = eye, spec, plan, engine
        count = RGB * plan.defocus.values_dpt.size
        if wavefronts is None:
            from filter_service.psfs.node_wavefronts import NodeWavefronts

            wavefronts = NodeWavefronts.of(eye, spec, plan)
        self.wavefronts = wavefronts
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
            blur_px=np.array(plan.blur_px, np.float32),
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
        """Arguments that make an equal store without kernels."""
        return {
            "eye": self.eye,
            "spec": self.spec,
            "plan": self.plan,
            "wavefronts": self.wavefronts,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the parts alone: kernels are computed again on demand."""
        return partial(type(self), **self.parts), ()

    @classmethod
    def of_kernels(
        cls,
        eye: EyeOptics,
        spec: GridSpec,
        plan: CachePlan,
        packed: PackedKernels,
    ) -> Self:
        """Return a store whose kernels (n_psfs,) are given."""
        found = cls(eye, spec, plan)
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
        BuildFailed
            No PSF can be computed for a state of this eye.
        OutOfMemory
            They exceed ``spec.memory_budget_mb`` together.
        """
        from estimator.psf.compute import PsfTooLarge
        from filter_service.psfs.compute_kernels import computed_kernels
        from filter_service.psfs.psf_engine import psf_engine

        self.engine = self.engine or psf_engine()
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
                    *(batch, self.engine, self._rings),
                )
            except PsfTooLarge as error:
                raise GridTooLarge(
                    str(error),
                    field="settings.pupil_range_mm",
                    allowed="a smaller pupil, other objects or fewer pixels per degree",
                ) from error
            except ValueError as error:
                raise BuildFailed(
                    f"no PSFs can be computed for this eye ({error})",
                    field="settings",
                    allowed="ranges, and a camera, that this eye can be seen through",
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

    @cached_property
    def _rings(self) -> NodeRings | None:
        """Rings of the eye's lens at the nodes, tabulated when they are needed."""
        from filter_service.psfs.native_psfs import NodeRings

        rings = self.eye.rings
        return None if rings is None else NodeRings.of(rings, self.wavefronts)

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
        """Evict the least recently used kernels; those of the current frame stay.

        Parameters
        ----------
        max_words : int
            Texels that may stay.
        """
        tables = self.tables
        own = np.flatnonzero(tables.is_computed)
        if not self.spec.settings.chromatic:
            own = own[own % RGB == 0]
        by_use = own[np.argsort(-tables.last_used[own].astype(np.int64), kind="stable")]
        widths, heights = self.box_sizes_of(by_use)
        sizes = widths * heights
        is_kept = np.cumsum(sizes) <= max_words
        is_kept |= tables.last_used[by_use] >= self.frame_number
        if is_kept.all():
            return
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
        """Geometric blur radius (n_psfs,), that of the plan."""
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
