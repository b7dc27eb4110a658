"""The PSFs of one eye and camera, computed when frames first need them.

The store consists of plain arrays in main memory.  The GL engine copies new kernels to
the GPU (`PsfStore.added_since`).
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.constants import RGB
from filter_service.errors import (
    BuildFailed,
    GridTooLarge,
    OutOfMemory,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan, PlanAxes, PlanNodes
from filter_service.psfs.field_defocus import EyeDefocus
from filter_service.psfs.pack import (
    ComputedPsfs,
    StoreTables,
    pack_reach,
    unpack_reach,
)

if TYPE_CHECKING:
    from estimator.profiles.parse import EyeProfile
    from filter_service.planning.plan import NodePlanner
    from filter_service.psfs.compute_kernels import PsfEngine
    from filter_service.psfs.native_psfs import NodeRings
    from filter_service.psfs.pack import PackedKernels

BYTES_PER_TEXEL = 2
FIRST_TEXELS = 2**22
"""Initial capacity of a store, 8 MB; it grows by doubling."""

KEPT_AFTER_EVICTION = 0.7
"""Share of the memory limit that an eviction keeps.  Kernels are evicted together,
because moving the others costs about 0.1 ms per megabyte."""

StateNode = tuple[int, int]
"""Indices of a plan's nodes of pupil and accommodation."""


def no_psfs(reason: ValueError) -> BuildFailed:
    """Return the error for an eye whose PSFs cannot be computed."""
    return BuildFailed(
        f"the PSFs of this eye cannot be computed: {reason}",
        field="settings",
        allowed="a camera and ranges of pupil, focus and distance that suit this eye",
    )


class PsfStore:
    """Kernels over field, pupil, accommodation, total defocus and channel.

    The values of a node depend on eye, camera and settings alone.  Its index depends on
    the order in which states are first read.  `fill` computes the kernels.

    Parameters
    ----------
    eye : EyeOptics
    spec : GridSpec
    plan : PlanAxes
        Nodes of all axes but defocus.  `groups_of` plans the defocus nodes of a state
        when it is first read.  A `CachePlan` contains the nodes of all states.
    engine : PsfEngine, optional
        By default from `psf_engine`.

    Attributes
    ----------
    nodes : PlanNodes
        Nodes of the states read so far; a state's groups [v, h] are adjacent.
    tables : StoreTables
        Offset, size and statistics of each kernel, by PSF index.
    frame_number : int
        Number of the current frame; the planner of frames increments it.
    generation : int
        Number of evictions, which move kernels.
    methods : Counter
        Number of computed PSFs by method.
    step_curves : dict
        Cache of `frame_layers`, by state.
    """

    nodes: PlanNodes

    def __init__(
        self,
        eye: EyeOptics,
        spec: GridSpec,
        plan: PlanAxes,
        *,
        engine: PsfEngine | None = None,
    ) -> None:
        self.eye, self.spec, self.plan, self.engine = eye, spec, plan, engine
        self.tables = StoreTables.empty()
        self._first_groups: dict[StateNode, int] = {}
        self._ahead: dict[StateNode, PlanNodes] = {}
        self._sent: set[StateNode] = set()  # by `planned_ahead`
        self.methods: Counter[str] = Counter()
        self.max_lost_energy_ratio = 0.0
        self.build_ms = 0.0
        self.frame_number = 1
        self.generation = 0
        self._words = np.empty(0, np.uint16)
        self._n_words = 0
        self._added: list[NDArray[np.int64]] = []
        self.step_curves: dict[StateNode, NDArray[np.float64]] = {}
        self._rings: tuple[PlanNodes, NodeRings] | None = None
        if isinstance(plan, CachePlan):
            self._add_nodes(self._states, plan.nodes)

    @property
    def parts(self) -> dict[str, Any]:
        """Arguments from which an equal store without kernels is constructed."""
        return {"eye": self.eye, "spec": self.spec, "plan": self.plan}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the parts only; kernels are computed again on demand."""
        return partial(type(self), **self.parts), ()

    @classmethod
    def of_kernels(
        cls,
        eye: EyeOptics,
        spec: GridSpec,
        plan: CachePlan,
        packed: PackedKernels,
    ) -> Self:
        """Return a store with the given kernels (n_psfs,)."""
        found = cls(eye, spec, plan)
        found._append(np.arange(found.psf_count), packed)
        return found

    # Nodes

    @property
    def _states(self) -> list[StateNode]:
        """All states of the plan, in the order of its groups."""
        n_pupils, n_accommodations = self.plan.group_shape[:2]
        return list(product(range(n_pupils), range(n_accommodations)))

    @property
    def fields_count(self) -> int:
        """Number of field nodes, and of groups per state."""
        return len(self.plan.v_deg) * len(self.plan.h_deg)

    def groups_of(self, states: Sequence[StateNode]) -> NDArray[np.int64]:
        """Return the group (n,) of each state's first field node.

        Parameters
        ----------
        states : sequence of (pupil, accommodation)
            Indices of nodes.  States that are read for the first time are planned.

        Raises
        ------
        GridTooLarge
            If a group needs too many PSFs.
        BuildFailed
            If no PSF can be computed for a state of the eye.
        """
        new = [state for state in states if state not in self._first_groups]
        if new:
            with self._client_errors():
                planned = [self._nodes_of(state) for state in new]
            self._add_nodes(new, PlanNodes.joined(planned))
        return np.array([self._first_groups[state] for state in states])

    def _nodes_of(self, state: StateNode) -> PlanNodes:
        """Return the nodes of a state that were planned ahead, or plan them."""
        planned = self._ahead.pop(state, None)
        return self._planner.nodes(*state) if planned is None else planned

    def planned_ahead(
        self, first: Sequence[StateNode]
    ) -> Iterator[tuple[StateNode, PlanNodes]]:
        """Plan states that were not planned yet, for `take` of an equal store.

        The worker process calls this.  In the rendering process, planning a state would
        delay the first frame that reads it by 12 to 30 ms.

        Parameters
        ----------
        first : sequence of StateNode
            States that are planned first, followed by others near them.
        """
        middle, known = np.mean(first, axis=0), {*self._first_groups, *self._sent}
        for state in sorted(
            (state for state in self._states if state not in known),
            key=lambda state: (state not in first, np.hypot(*(state - middle))),
        ):
            self._sent.add(state)
            yield state, self._planner.nodes(*state)

    def is_planned(self, states: Sequence[StateNode]) -> bool:
        """Return whether all states are planned, by this process or the worker."""
        return all(s in self._first_groups or s in self._ahead for s in states)

    def take(self, planned: tuple[StateNode, PlanNodes]) -> None:
        """Keep the nodes of a state that was planned ahead until a frame reads it."""
        state, nodes = planned
        if state not in self._first_groups:
            self._ahead[state] = nodes

    def plan_all(self) -> None:
        """Plan the nodes of all states."""
        self.groups_of(self._states)

    @cached_property
    def _planner(self) -> NodePlanner:
        from filter_service.planning.plan import NodePlanner

        return NodePlanner(self.eye, self.spec, self.plan)

    def _add_nodes(self, states: list[StateNode], new: PlanNodes) -> None:
        if self._first_groups:
            new = PlanNodes.joined([self.nodes, new])
        first = len(self._first_groups) * self.fields_count
        for state in states:
            self._first_groups[state] = first
            first += self.fields_count
        # Frames in progress may still read the old arrays.
        self.nodes, self.tables = new, self.tables.grown(new)

    # Kernels

    def fill(
        self,
        psfs: NDArray[np.int64] | None = None,
        *,
        until_s: float | None = None,
        batch_count: int | None = None,
        between: Callable[[], None] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> NDArray[np.int64]:
        """Compute missing kernels.

        Parameters
        ----------
        psfs : (n,), optional
            PSF indices; by default all.
        until_s : float, optional
            Time of `time.monotonic` at which to stop, after the current batch.
        batch_count : int, optional
            PSFs per batch; by default, and at most, the batch size of the engine.
        between : callable, optional
            Called after each batch but the last.
        progress : callable, optional
            Called with the completed share.

        Returns
        -------
        (n,)
            PSFs that are missing at ``until_s``; otherwise none.

        Raises
        ------
        GridTooLarge
            If a kernel exceeds ``spec.max_blur_radius_px``.
        BuildFailed
            If no PSF can be computed for a state of the eye.
        OutOfMemory
            If the kernels of a frame exceed ``spec.memory_budget_mb``.
        """
        started_s = time.perf_counter()
        if psfs is None:
            self.plan_all()
            psfs = np.arange(self.psf_count)
        psfs = self.not_computed(psfs)
        left = psfs[:0]
        step = self._own_engine().batch_count
        step = min(batch_count or step, step)
        batches = np.array_split(psfs, -(-psfs.size // step) or 1)
        for number, batch in enumerate(batches):
            # `between` may have computed some of them.
            batch = batch[~self.tables.is_computed[batch]]
            if not batch.size:
                continue
            self.add(self.computed(batch))
            if progress is not None:
                progress((number + 1) / len(batches))
            if number + 1 == len(batches):
                break
            if between is not None:
                between()
            if until_s is not None and time.monotonic() > until_s:
                left = psfs[~self.tables.is_computed[psfs]]
                break
        self.build_ms += 1e3 * (time.perf_counter() - started_s)
        return left

    def not_computed(self, psfs: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the distinct PSFs (m,) among others (n,) that `computed` may get."""
        psfs = np.unique(psfs)
        if not self.spec.settings.chromatic:  # channels share kernels
            psfs = RGB * np.unique(psfs // RGB)
        return psfs[~self.tables.is_computed[psfs]]

    def computed(
        self, psfs: NDArray[np.int64], *, thread_count: int | None = None
    ) -> ComputedPsfs:
        """Compute kernels without changing the store, which other threads may use.

        Parameters
        ----------
        psfs : (n,)
            Result of `not_computed`, or a part of it.
        thread_count : int, optional
            Number of threads; by default one for each core.

        Raises
        ------
        GridTooLarge
            If a kernel exceeds ``spec.max_blur_radius_px``.
        BuildFailed
            If no PSF can be computed for a state of the eye.
        """
        from filter_service.psfs.compute_kernels import computed_kernels

        nodes = self.nodes
        with self._client_errors():
            packed, methods = computed_kernels(
                *(self.eye, self.spec, nodes, psfs),
                *(self._own_engine(thread_count), self._node_rings(nodes)),
            )
        return ComputedPsfs(psfs, packed, methods)

    def add(self, found: ComputedPsfs) -> None:
        """Add kernels, except those that were computed meanwhile.

        Raises
        ------
        OutOfMemory
            If the kernels of a frame exceed ``spec.memory_budget_mb``.
        """
        psfs, packed, methods = found
        is_new = ~self.tables.is_computed[psfs]
        if not is_new.all():
            psfs, packed = psfs[is_new], packed.select(np.flatnonzero(is_new))
        self.methods += methods
        if not self.spec.settings.chromatic:
            psfs = psfs + np.arange(RGB)[:, None]
        self._append(psfs, packed)

    def _own_engine(self, thread_count: int | None = None) -> PsfEngine:
        from filter_service.psfs.compute_kernels import psf_engine

        return self.engine or psf_engine(self.spec.settings.pipeline, thread_count)

    def _node_rings(self, nodes: PlanNodes) -> NodeRings | None:
        """Return the rings of the eye's lens, tabulated on first use, or None."""
        from filter_service.psfs.native_psfs import NodeRings

        if self.eye.rings is None:
            return None
        if self._rings is None or self._rings[0] is not nodes:
            widest = self._planner.widest_pupils
            self._rings = nodes, NodeRings.of(self.eye.rings, nodes.wavefronts, widest)
        return self._rings[1]

    @contextmanager
    def _client_errors(self) -> Iterator[None]:
        """Convert errors of the PSF engines and the planner into errors for clients."""
        from estimator.psf.compute import PsfTooLarge

        try:
            yield
        except PsfTooLarge as error:
            raise GridTooLarge(
                str(error),
                field="settings.pupil_range_mm",
                allowed="smaller pupils, other distances or fewer pixels per degree",
            ) from error
        except ValueError as error:
            raise no_psfs(error) from error

    def _append(self, psfs: NDArray[np.int64], packed: PackedKernels) -> None:
        """Add kernels (n,) of PSFs (n,), or of m PSFs that share each (m, n)."""
        tables, count = self.tables, packed.weights.size
        self._reserve(count)
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

    def _reserve(self, count: int) -> None:
        needed = self._n_words + count
        if needed > self._max_words:
            self.evict(int(KEPT_AFTER_EVICTION * self._max_words) - count)
            needed = self._n_words + count
        if needed > self._max_words:
            raise OutOfMemory(
                f"the PSFs of one frame need {BYTES_PER_TEXEL * needed / 1e6:.3g} MB",
                allowed=f"up to {self.spec.memory_budget_mb:g} MB per eye and camera",
            )
        if needed > self._words.size:
            grown = np.empty(max(needed, 2 * self._words.size, FIRST_TEXELS), np.uint16)
            grown[: self._n_words] = self._words[: self._n_words]
            self._words = grown

    @property
    def _max_words(self) -> int:
        return int(self.spec.memory_budget_mb * 1e6 / BYTES_PER_TEXEL)

    def evict(self, max_words: int) -> None:
        """Evict the least recently used kernels, but none of the current frame.

        Parameters
        ----------
        max_words : int
            Largest number of texels to keep.
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
        # Frames in progress may still read the old arrays.
        tables = self.tables = tables._replace(offsets=tables.offsets.copy())
        evicted = by_use[~is_kept]
        if not self.spec.settings.chromatic:
            kept, evicted = (p + np.arange(RGB)[:, None] for p in (kept, evicted))
        tables.is_computed[evicted] = False
        for name in ("offsets", "reach_words", "radius_px", "spread_px", "peak_ratio"):
            getattr(tables, name)[evicted] = 0
        tables.offsets[kept] = first
        self._words, self._n_words = words, int(sizes.sum())
        self._added = [kept.ravel()]
        self.generation += 1

    def box_sizes_of(
        self, psfs: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the widths and heights (n,) of kernels."""
        left, right, up, down = np.moveaxis(
            unpack_reach(self.tables.reach_words[psfs]).astype(np.int64), -1, 0
        )
        return left + right + 1, up + down + 1

    def added_since(self, n_batches: int) -> tuple[int, NDArray[np.int64]]:
        """Return the number of batches, and the PSFs of those after the first n."""
        later = self._added[n_batches:]
        found = np.concatenate(later) if later else np.zeros(0, np.int64)
        return len(self._added), found

    # Data that frames read

    @cached_property
    def defocus(self) -> EyeDefocus:
        """Total defocus of the eye at the field nodes and over the field."""
        h_deg, v_deg = self.plan.field_nodes_deg
        return EyeDefocus(self.eye, self.spec, h_deg=h_deg, v_deg=v_deg)

    @property
    def kernels(self) -> NDArray[np.uint16]:
        """All computed kernels (n_texels,), concatenated, with rows from top to bottom.

        Weights are in steps of the kernel's peak over `WEIGHT_MAX`.  These steps are
        finer than the steps of half-precision floats.
        """
        return self._words[: self._n_words]

    @property
    def words(self) -> NDArray[np.uint16]:
        """Buffer of the kernels (>= n_texels,), which is replaced when it grows."""
        return self._words

    @property
    def offsets(self) -> NDArray[np.int64]:
        """Start of each kernel (n_psfs,)."""
        return self.tables.offsets.astype(np.int64)

    @property
    def reach_px(self) -> NDArray[np.int64]:
        """Reaches left, right, up and down (n_psfs, 4)."""
        return unpack_reach(self.tables.reach_words).astype(np.int64)

    @property
    def radius_px(self) -> NDArray[np.int32]:
        """Radius R (n_psfs,): each kernel lies within dx² + dy² <= (R + 0.5)²."""
        return self.tables.radius_px

    @property
    def blur_px(self) -> NDArray[np.float32]:
        """Geometric blur radius (n_psfs,), as planned."""
        return self.tables.blur_px

    @property
    def spread_px(self) -> NDArray[np.float32]:
        """Radius (n_psfs,) of the uniform disc with the kernel's sum of squares.

        It measures the effective blur.  For a kernel with a bright core and a wide
        skirt, it is much smaller than ``blur_px``.
        """
        return self.tables.spread_px

    @property
    def peak_ratio(self) -> NDArray[np.float32]:
        """Largest weight (n_psfs,)."""
        return self.tables.peak_ratio

    @property
    def psf_count(self) -> int:
        """Number of planned nodes times channels, computed or not."""
        return int(self.tables.offsets.size)

    @property
    def computed_count(self) -> int:
        """Number of computed PSFs."""
        return int(np.count_nonzero(self.tables.is_computed))

    @property
    def memory_mb(self) -> float:
        """Memory of the kernels."""
        return self.kernels.nbytes / 1e6

    @property
    def tables_mb(self) -> float:
        """Memory of the tables and nodes, including nodes that were planned ahead."""
        planned = [*self._ahead.values()]
        if self._first_groups:
            planned.append(self.nodes)
        arrays: list[NDArray[np.generic]] = [
            *self.tables,
            *(a for nodes in planned for a in nodes.arrays),
        ]
        return sum(array.nbytes for array in arrays) / 1e6


def build_psf_store(
    eye: EyeOptics | EyeProfile,
    spec: GridSpec,
    *,
    plan: CachePlan | None = None,
    engine: PsfEngine | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> PsfStore:
    """Compute every PSF that frames of a spec can read.

    Parameters
    ----------
    eye : EyeOptics or EyeProfile
        A profile is used as a measured wavefront.
    plan : CachePlan, optional
        Nodes; by default from `planning.plan.plan_cache`.
    engine : PsfEngine
    progress : callable, optional
        Called with a fraction 0..1 and a stage.

    Raises
    ------
    GridTooLarge
        If a kernel exceeds ``spec.max_blur_radius_px``.
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
