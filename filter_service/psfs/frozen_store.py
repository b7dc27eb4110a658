"""PSFs of one state in 32 bits at given distances, for derivatives.

A derivative is a difference of images whose kernels differ by little, so everything
else must be equal or precise: objects have the same distances and layers in all states,
kernels have 32 instead of 16 bits and extend over the image, and PSFs are computed by
quadrature (`estimator.psf.quadrature`).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import plan_psfs
from estimator.psf.quadrature import quadrature_kernels
from estimator.psf.survey import needed_radius_px
from filter_service.constants import RECIPE_TAPS, RGB, WEIGHT_MAX
from filter_service.errors import OutOfMemory
from filter_service.planning.node_wavefronts import apodization
from filter_service.psfs.exact_store import ExactStore
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.pack import ComputedPsfs, PackedKernels, StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.view_state import State

LOST_RATIO = 2e-4
"""Share of the light that kernels may omit if the image is wider.  The omitted light
changes by the same ratio as the pupil."""

MAX_REACH_PX = 255

MAX_DISTANCES = 48
"""Distances of objects that have layers of their own; more share layers."""

SAME_BLUR_PX = 0.01
"""Difference of blur radii below which distances are the same."""

ALONE_DPT = 0.01
"""Distance of the outermost layers from the objects."""


@dataclass(frozen=True)
class FrozenLayers:
    """Layers of a frame that do not change with the state of the eye.

    Attributes
    ----------
    layer_dpt : (n + 1,)
        Ends of the intervals, ascending; see `FrameLayers.layer_dpt`.
    object_dpt : (n,)
        Where the kernels of each interval are computed.
    blur_px_per_dpt : float
        See `FrameLayers`; it decides where edges are.
    """

    layer_dpt: NDArray[np.float64]
    object_dpt: NDArray[np.float64]
    blur_px_per_dpt: float

    @classmethod
    def of(cls, layers: FrameLayers, vergence_dpt: NDArray[np.float64]) -> FrozenLayers:
        """Return layers for objects at given vergences (n,).

        Vergences within a blur of `SAME_BLUR_PX` are the same, that of their mean.  Up
        to `MAX_DISTANCES` have layers of their own, if all directions of the field have
        the same defocus.  Otherwise, objects have the vergence of the middle between
        two of the layers given.
        """
        change_dpt = layers.field.range_dpt
        lowest_dpt = vergence_dpt.min()
        step_dpt = SAME_BLUR_PX / max(layers.blur_px_per_dpt, SAME_BLUR_PX)
        step = np.floor((vergence_dpt - lowest_dpt) / step_dpt)
        _, place, counts = np.unique(step, return_inverse=True, return_counts=True)
        own = np.bincount(place.ravel(), vergence_dpt.ravel()) / counts
        if own.size <= MAX_DISTANCES and not any(change_dpt):
            between = (own[1:] + own[:-1]) / 2.0
            ends = own[0] - ALONE_DPT, own[-1] + ALONE_DPT
            layer_dpt = np.concatenate([ends[:1], between, ends[1:]])
            return cls(layer_dpt, own, layers.blur_px_per_dpt)
        low, high = own[0] + change_dpt[0], own[-1] + change_dpt[1]
        first, last = np.searchsorted(layers.layer_dpt, [low, high])
        layer_dpt = layers.layer_dpt[max(first - 1, 0) : last + 2]
        middle_dpt = (layer_dpt[1:] + layer_dpt[:-1]) / 2.0
        return cls(layer_dpt, middle_dpt, layers.blur_px_per_dpt)


class FrozenStore(ExactStore):
    """PSFs of one state of an eye in frozen layers.

    A PSF has two numbers: that of its high 16 bits, and, after those of all PSFs, that
    of its low ones.

    Parameters
    ----------
    base, state
        As of `ExactStore`.
    frozen : FrozenLayers
    size_px : (width, height)
        Of the image, over which kernels extend.
    """

    def __init__(
        self,
        base: PsfStore,
        state: State,
        frozen: FrozenLayers,
        size_px: tuple[int, int],
    ) -> None:
        super().__init__(base, state, (0.0, 0.0), layer_dpt=frozen.layer_dpt)
        self._frozen, self._size_px = frozen, size_px
        self._low_number = self.tables.offsets.size
        tables = self.tables._asdict()
        per_psf = {name: np.tile(tables[name], 2) for name in PER_PSF}
        self.tables: StoreTables = self.tables._replace(**per_psf)
        self.layers = replace(
            self.layers, tables=self.tables, blur_px_per_dpt=frozen.blur_px_per_dpt
        )

    def computed(
        self, psfs: NDArray[np.int64], *, thread_count: int | None = None
    ) -> ComputedPsfs:
        """Compute kernels, see `PsfStore.computed`."""
        with self._client_errors():
            kernels = self._kernels(psfs, thread_count)
        boxes = [self._box(kernel) for kernel in kernels]
        return ComputedPsfs(
            np.concatenate([psfs, psfs + self._low_number]),
            _packed(boxes),
            Counter({"quadrature": psfs.size}),
        )

    def evict(self, max_words: int) -> None:
        """Raise, because the frame reads all kernels.

        Raises
        ------
        OutOfMemory
        """
        raise OutOfMemory(
            "the PSFs of a derivative do not fit in memory",
            allowed=f"up to {self.spec.memory_budget_mb:g} MB per eye and camera",
        )

    def add_low_words(self, recipes: NDArray[np.uint32]) -> None:
        """Add the low bits of all kernels to recipes (n, 3, 18), in place.

        A state without neighbors uses two of the six taps.
        """
        numbers, reach, factors = (
            recipes[..., k * RECIPE_TAPS : (k + 1) * RECIPE_TAPS] for k in range(3)
        )
        numbers[..., 2:4] = numbers[..., :2] + self._low_number
        reach[..., 2:4] = reach[..., :2]
        high = np.ascontiguousarray(factors[..., :2]).view(np.float32)
        factors[..., 2:4] = (high / np.float32(WEIGHT_MAX)).view(np.uint32)

    def _kernels(
        self, psfs: NDArray[np.int64], thread_count: int | None
    ) -> list[NDArray[np.float64]]:
        """Return kernels (2R+1, 2R+1) of PSFs (n,)."""
        nodes, eye, spec = self.nodes, self.eye, self.spec
        groups, channels = nodes.defocus.group_at(psfs // RGB), psfs % RGB
        layer_dpt = nodes.defocus.values_dpt[psfs // RGB]
        interval = np.searchsorted(self._frozen.layer_dpt, layer_dpt - 1e-9)
        # The kernels of the last layer are not read: intervals have those of their
        # lower ends.
        interval = np.minimum(interval, self._frozen.object_dpt.size - 1)
        # Layers at both ends of the last interval have the same kernel.
        each = np.stack([groups, channels, interval])
        (groups, channels, interval), place = np.unique(
            each, axis=1, return_inverse=True
        )
        object_dpt = self._frozen.object_dpt[interval]
        total_dpt = object_dpt + nodes.channel_shift_dpt[groups, channels]
        wavefronts = nodes.wavefronts
        count = wavefronts.wavelength_nm.shape[1]
        found = wavefronts.at(groups, channels, total_dpt)
        arguments = {
            "pupil_diameter_mm": found.circle_diameter_mm,
            "pupil_ellipse": found.pupil_ellipse,
            "wavelength_nm": wavefronts.wavelength_nm[channels].ravel(),
            "pixel_from_mrad": wavefronts.pixel_from_mrad[np.repeat(groups, count)],
        }
        weighed = apodization(eye, spec)
        plan = plan_psfs(found.zernike_um, stiles_crawford=weighed, **arguments)
        needed_px = needed_radius_px(
            plan.survey, lost_energy_ratio=LOST_RATIO, tail_end_px=MAX_REACH_PX
        )
        across_px = math.ceil(math.hypot(*self._size_px))
        radius_px = np.minimum(needed_px, min(across_px, MAX_REACH_PX))
        kernels = quadrature_kernels(
            found.zernike_um,
            radius_px=np.repeat(radius_px.reshape(-1, count).max(axis=1), count),
            stiles_crawford=weighed,
            workers=thread_count,
            **arguments,
        )
        means = [
            np.mean(kernels[k : k + count], axis=0)
            for k in range(0, len(kernels), count)
        ]
        return [means[k] for k in place.ravel().tolist()]

    def _box(self, kernel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a kernel without what no pixel of the image can reach, of unit sum."""
        radius = len(kernel) // 2
        x, y = (min(radius, size - 1) for size in self._size_px)
        found = kernel[radius - y : radius + y + 1, radius - x : radius + x + 1]
        total: float = found.sum()
        return found / total


PER_PSF = (
    *("offsets", "reach_words", "radius_px", "blur_px", "spread_px", "peak_ratio"),
    *("is_computed", "last_used"),
)


def _packed(boxes: list[NDArray[np.float64]]) -> PackedKernels:
    """Return kernels as high and low words, those with the low ones last."""
    words: list[NDArray[np.uint16]] = []
    low_words: list[NDArray[np.uint16]] = []
    for box in boxes:
        steps = box * (WEIGHT_MAX / box.max())
        high = np.floor(steps)
        words.append(high.ravel().astype(np.uint16))
        low_words.append(np.rint((steps - high) * WEIGHT_MAX).ravel().astype(np.uint16))
    sizes = np.array([own.size for own in words] * 2)
    half = np.array([[side // 2 for side in box.shape] for box in boxes])
    peak_ratio = np.array([box.max() for box in boxes])
    spread_px = np.array([1.0 / math.sqrt(math.pi * np.sum(box**2)) for box in boxes])
    return PackedKernels(
        weights=np.concatenate(words + low_words),
        offsets=np.cumsum(sizes) - sizes,
        reach_px=np.tile(half[:, [1, 1, 0, 0]], (2, 1)),
        radius_px=np.tile(np.ceil(np.hypot(*half.T)).astype(np.int64), 2),
        peak_ratio=np.concatenate([peak_ratio, peak_ratio / WEIGHT_MAX]),
        spread_px=np.tile(spread_px, 2),
        lost_energy_ratio=np.zeros(sizes.size),
    )
