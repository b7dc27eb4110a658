"""PSF stores of engines, with data that only depends on pupil, focus and gaze."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import wavefront_polynomial
from estimator.psf.pupil import pupil_frames
from estimator.psf.survey import survey_pupils
from estimator.psf.tables import N_EDGE
from filter_service.constants import RGB
from filter_service.errors import OutOfMemory
from filter_service.planning.node_wavefronts import apodization
from filter_service.psfs.exact_store import ExactStore
from filter_service.psfs.field_defocus import FieldAxes
from filter_service.psfs.frame_layers import FrameLayers, frame_layers, state_nodes
from filter_service.psfs.pack import ComputedPsfs
from filter_service.psfs.store import PsfStore, StateNode
from filter_service.rendering.frame import merge_spread_px
from filter_service.rendering.frame_kernels import SampledFrame, missing_psfs_of
from filter_service.rendering.image_cells import ImageCells, image_cells, stored_scale
from filter_service.settings import DEFAULT_OPTIONS, RenderOptions
from filter_service.view_state import State


class EdgeTables(NamedTuple):
    """Edges of the pupils of groups, in pixels of the stored kernels (x right, y down).

    Attributes
    ----------
    is_known : (n_groups,)
    slope_px, slope_px_per_dpt : (n_groups, 3, N_EDGE, 2)
        Slopes of the wavefront at 0 dpt and their change with total defocus, at points
        of the edge, counterclockwise from +x.
    half_um_per_px : (n_groups, 3, 2, 2)
        Map from the unit disc to the pupil t, see `estimator.psf.pupil`.
    edge_light_um : (n_groups, 3)
        See `PupilSurvey`.
    shift_px_per_um : (n_groups, 2, 2)
        Change of a ray's position in the image per diopter and t of its point in the
        pupil.
    center_px_per_dpt : (n_groups, 2)
        That change for the center of the pupil.
    """

    is_known: NDArray[np.bool_]
    slope_px: NDArray[np.float64]
    slope_px_per_dpt: NDArray[np.float64]
    half_um_per_px: NDArray[np.float64]
    edge_light_um: NDArray[np.float64]
    shift_px_per_um: NDArray[np.float64]
    center_px_per_dpt: NDArray[np.float64]


@dataclass(eq=False)
class PupilEdges:
    """Edges of the pupils of a store, computed when they are first needed.

    Attributes
    ----------
    store : PsfStore
    tables : EdgeTables or None
        None before the first use.
    """

    store: PsfStore
    tables: EdgeTables | None = None

    def of(self, groups: NDArray[np.int64]) -> EdgeTables:
        """Return the tables, with the edges of the groups (n,) of field nodes."""
        count = self.store.nodes.channel_shift_dpt.shape[0]
        if self.tables is None or self.tables.is_known.size < count:
            self.tables = _grown(self.tables, count)
        new = np.unique(groups)
        new = new[~self.tables.is_known[new]]
        if new.size:
            self._compute(self.tables, new)
        return self.tables

    def _compute(self, tables: EdgeTables, groups: NDArray[np.int64]) -> None:
        """Write the edges of groups (n,).

        The edges of a wide primary are the means over its wavelengths.
        """
        store, wavefronts = self.store, self.store.nodes.wavefronts
        n_primaries = wavefronts.wavelength_nm.shape[1]
        index = np.repeat(groups, RGB)
        channels = np.tile(np.arange(RGB), groups.size)
        wavelength_nm = wavefronts.wavelength_nm[channels].ravel()
        weighed = apodization(store.eye, store.spec)
        scale = wavefronts.pixel_from_mrad[np.repeat(index, n_primaries)]
        shape = groups.size, RGB, n_primaries
        slopes_px = []
        for total_dpt in (0.0, 1.0):
            found = wavefronts.at(index, channels, np.full(index.size, total_dpt))
            survey = survey_pupils(
                pupil_frames(
                    wavefront_polynomial(found.zernike_um),
                    circle_radius_mm=found.circle_diameter_mm / 2.0,
                    wavelength_nm=wavelength_nm,
                    pixel_from_mrad=scale,
                    pupil_ellipse=found.pupil_ellipse,
                    apodization=(
                        None if weighed is None else weighed.amplitude(wavelength_nm)
                    ),
                )
            )
            slope_px = survey.edge_slope_px * [1.0, -1.0]
            slopes_px.append(slope_px.reshape(*shape, N_EDGE, 2).mean(axis=2))
        half = survey.frames.half_width_um_per_px
        shear = survey.frames.shear_ratio
        disc = np.zeros((half.shape[0], 2, 2))
        disc[:, 0, 0] = half[:, 0]
        disc[:, 1, 0] = -half[:, 1] * shear
        disc[:, 1, 1] = -half[:, 1] * np.sqrt(1.0 - shear * shear)
        flip = np.diag([1.0, -1.0])
        own = wavefronts.pixel_from_mrad[groups]
        center_mm = found.pupil_ellipse.reshape(*shape, -1)[:, 1, 0, :2]
        tables.slope_px[groups] = slopes_px[0]
        tables.slope_px_per_dpt[groups] = slopes_px[1] - slopes_px[0]
        tables.half_um_per_px[groups] = disc.reshape(*shape, 2, 2).mean(axis=2)
        tables.edge_light_um[groups] = survey.edge_light_um.reshape(shape).mean(axis=2)
        tables.shift_px_per_um[groups] = flip @ own @ np.swapaxes(own, 1, 2) @ flip
        tables.center_px_per_dpt[groups] = (flip @ own @ center_mm[:, :, None]).squeeze(
            -1
        )
        tables.is_known[groups] = True


def _grown(tables: EdgeTables | None, count: int) -> EdgeTables:
    """Return tables for more groups; the new ones are not known."""
    found = EdgeTables(
        is_known=np.zeros(count, np.bool_),
        slope_px=np.zeros((count, RGB, N_EDGE, 2)),
        slope_px_per_dpt=np.zeros((count, RGB, N_EDGE, 2)),
        half_um_per_px=np.zeros((count, RGB, 2, 2)),
        edge_light_um=np.zeros((count, RGB)),
        shift_px_per_um=np.zeros((count, 2, 2)),
        center_px_per_dpt=np.zeros((count, 2)),
    )
    for name, known in (tables._asdict() if tables is not None else {}).items():
        getattr(found, name)[: len(known)] = known
    return found


LAYER_STEP_RATIOS = (0.2, 2.0)
"""Smallest and largest layer step relative to the default.  With the smallest, layers
add less error than the 16 bits of the kernels."""


def layer_step_ratio(tolerance: float) -> float:
    """Return the layer step relative to the default; the error grows as its square."""
    return min(max(math.sqrt(tolerance), LAYER_STEP_RATIOS[0]), LAYER_STEP_RATIOS[1])


KEPT_EXACT = 2
"""Number of stores of single states that are kept."""

CornerWeights = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Weights of the defocus spline along h and v at the corners of cells."""


class Timer(Protocol):
    """Stage timer of an engine."""

    def wall(self, name: str) -> AbstractContextManager[None]:
        """Return a context manager that adds its wall time to a stage."""


@dataclass(eq=False)
class FrameStore:
    """A PSF store with the cells of its camera and the last frame's layers and cells.

    The base class of engines' stores.  The same objects are returned until the state of
    frames changes, so that callers can compare states by identity.

    Attributes
    ----------
    is_released : bool
        Whether the store was released; engines then drop all state of it.
    """

    store: PsfStore
    image: ImageCells

    can_blend: ClassVar[bool] = False
    """Whether the engine blends the kernels of cells, see `image_cells`."""

    def __post_init__(self) -> None:
        """Begin without cached states."""
        self.is_released = False
        self._layers: tuple[tuple[float, ...], FrameLayers] | None = None
        self._image: tuple[tuple[Any, ...], ImageCells] | None = None
        self._change: tuple[FrameLayers, ImageCells, NDArray[Any]] | None = None
        self._corner_weights: tuple[FieldAxes, ImageCells, CornerWeights] | None = None
        self._exact: dict[tuple[Any, ...], FrameStore] = {}
        self._field_step_ratio = 1.0  # of exact stores, more if memory is short

    @cached_property
    def node_scale(self) -> NDArray[np.float64]:
        """Scale of the stored pixels, see `stored_scale`; cached, as it takes 3 ms."""
        return stored_scale(self.store.spec, self.store.plan)

    @cached_property
    def edges(self) -> PupilEdges:
        """Edges of the pupils of its nodes."""
        return PupilEdges(self.store)

    @property
    def computed_count(self) -> int:
        """Number of computed PSFs."""
        return self.store.computed_count

    @property
    def memory_mb(self) -> float:
        """Memory of the computed kernels, MB."""
        return self.store.memory_mb + self._exact_mb

    @property
    def tables_mb(self) -> float:
        """Memory of the tables and nodes, MB."""
        exact_mb = sum(handle.tables_mb for handle in self._exact.values())
        return self.store.tables_mb + exact_mb

    @property
    def _exact_mb(self) -> float:
        return sum(handle.memory_mb for handle in self._exact.values())

    def missing_psfs(
        self,
        frame: SampledFrame | None = None,
        *,
        state: State | None = None,
    ) -> NDArray[np.int64]:
        """Return the PSFs (n,) that a frame needs and that are not computed yet.

        Parameters
        ----------
        frame : SampledFrame, optional
            By default, PSFs that any frame may need are returned.
        state : State, optional
            Pupil and focus to use instead of the frame's.

        Raises
        ------
        OutOfMemory
            All PSFs were requested, but do not fit in memory.
        """
        if frame is None:
            if self.store.generation:
                raise OutOfMemory(
                    f"the PSFs of all ranges take more than {self.memory_mb:.0f} MB",
                    allowed='narrower ranges, or "prepare": "stream"',
                )
            self.store.plan_all()
            return np.flatnonzero(~self.store.tables.is_computed)
        return missing_psfs_of(self.store, frame, self._cells_at, state=state)

    def not_computed(self, psfs: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the PSFs (m,) to compute, see `PsfStore.not_computed`."""
        return self.store.not_computed(psfs)

    def computed(
        self, psfs: NDArray[np.int64], *, thread_count: int | None = None
    ) -> ComputedPsfs:
        """Compute PSFs for `add`, see `PsfStore.computed`."""
        return self.store.computed(psfs, thread_count=thread_count)

    def add(self, found: ComputedPsfs) -> None:
        """Add computed PSFs, see `PsfStore.add`."""
        self.store.add(found)

    def state_nodes(self, state: State) -> tuple[StateNode, ...]:
        """Return the nodes of pupil and accommodation that frames of a state read."""
        return state_nodes(self.store, state.clamped(self.store.spec.settings))

    def is_planned(self, nodes: tuple[StateNode, ...]) -> bool:
        """Return whether the PSFs of these nodes are planned."""
        return self.store.is_planned(nodes)

    def add_part(self, part: Any) -> None:
        """Add a part of the plan that the worker has prepared."""
        self.store.take(part)

    def exact(
        self,
        state: State,
        object_range_dpt: tuple[float, float],
        load: Callable[[PsfStore], FrameStore],
    ) -> FrameStore:
        """Return a store with the PSFs of one state, loaded by a function.

        The last `KEPT_EXACT` are kept: a frame with a deadline continues where an
        earlier attempt stopped, even if another stream uses the eye in between.

        Parameters
        ----------
        state : State
            Pupil, focus and gaze; the gaze is within the prepared range.
        object_range_dpt : (low, high)
            Object distances that the PSFs are for.
        load : callable
            `FrameEngine.load`.
        """
        key = state, object_range_dpt
        handle = self._exact.pop(key, None)
        if handle is None:
            while len(self._exact) >= KEPT_EXACT:
                self._exact.pop(next(iter(self._exact))).release()
            handle = load(
                ExactStore(
                    self.store,
                    state,
                    object_range_dpt,
                    field_step_ratio=self._field_step_ratio,
                )
            )
        self._exact[key] = handle
        return handle

    def coarsen_exact(self) -> bool:
        """Reduce the field nodes of `exact`, whose PSFs do not fit in memory.

        Returns whether that was possible.
        """
        if not any(
            isinstance(handle.store, ExactStore) and handle.store.is_refined
            for handle in self._exact.values()
        ):
            return False
        self._field_step_ratio *= 1.5
        self._release_exact()
        return True

    def _release_exact(self) -> None:
        for handle in self._exact.values():
            handle.release()
        self._exact = {}

    def release(self) -> None:
        """Free the engine's resources for this store; call it once."""
        self._release_exact()
        self.is_released = True

    def evict(self, max_mb: float) -> None:
        """Evict the least recently used PSFs, see `PsfStore.evict`."""
        self._release_exact()
        self.store.frame_number += 1  # between frames, no PSFs are in use
        self.store.evict(int(max_mb * 1e6 / self.store.kernels.itemsize))

    def _cells_at(self, gaze_deg: tuple[float, float]) -> ImageCells:
        spec = self.store.spec
        if gaze_deg == spec.settings.gaze_deg or not spec.follows_field:
            return self.image
        return image_cells(
            spec,
            self.store.plan,
            gaze_deg,
            node_scale=self.node_scale,
            can_blend=self.can_blend,
        )

    def layers(
        self,
        timer: Timer,
        state: State,
        options: RenderOptions = DEFAULT_OPTIONS,
    ) -> FrameLayers:
        """Return the layers for a pupil, a focus and the options of a frame."""
        if isinstance(self.store, ExactStore):
            return self.store.layers
        tolerance, spread_px = options.render_tolerance, merge_spread_px(options)
        key = (state.pupil_diameter_mm, state.focus_dpt, tolerance, spread_px)
        if self._layers is None or self._layers[0] != key:
            with timer.wall("psf_plan_ms"):
                self._layers = (
                    key,
                    frame_layers(
                        self.store,
                        state,
                        step_ratio=layer_step_ratio(tolerance),
                        merge_spread_px=spread_px,
                    ),
                )
        return self._layers[1]

    def cells(
        self,
        timer: Timer,
        gaze_deg: tuple[float, float],
        cell_px: int | None = None,
    ) -> ImageCells:
        """Return the cells for a gaze; ``cell_px`` overrides the default cell size."""
        spec, state = self.store.spec, (gaze_deg, cell_px)
        if state == (spec.settings.gaze_deg, None):
            return self.image
        if self._image is None or self._image[0] != state:
            with timer.wall("psf_plan_ms"):
                self._image = (
                    state,
                    image_cells(
                        spec,
                        self.store.plan,
                        gaze_deg,
                        cell_px=cell_px,
                        node_scale=self.node_scale,
                        can_blend=self.can_blend,
                    ),
                )
        return self._image[1]

    def corner_change_dpt(
        self, timer: Timer, layers: FrameLayers, image: ImageCells
    ) -> NDArray[np.float32]:
        """Return the change of defocus at cell corners, see `FieldDefocus.at`."""
        last = self._change
        if last is None or last[0] is not layers or last[1] is not image:
            with timer.wall("psf_plan_ms"):
                change_dpt = layers.field.of_weights(self._weights(layers, image))
            last = self._change = layers, image, change_dpt.astype(np.float32)
        return last[2]

    def _weights(self, layers: FrameLayers, image: ImageCells) -> CornerWeights:
        """Return the spline weights at the corners; they are equal in all states."""
        axes, last = layers.field.axes, self._corner_weights
        if last is None or last[0] is not axes or last[1] is not image:
            weights = axes.weights(image.corner_h_deg, image.corner_v_deg)
            last = self._corner_weights = axes, image, weights
        return last[2]
