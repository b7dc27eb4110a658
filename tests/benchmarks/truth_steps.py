"""Errors of single steps between wavefront and frame, for `bench_truth`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfBatch, compute_psf_batch
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.planning.grid import GridSpec, field_deg
from filter_service.planning.node_wavefronts import PupilStates
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.pack import pack_kernels
from tests.benchmarks.truth_points import PointState, PointTruth, wavefronts_of
from tests.numerical.plan_cases import plan_corners

MAX_RADIUS_PX = 110
KEPT_RATIO = 0.9995
"""Share of the light of kernels that are not cropped."""


def half_l1(kernel: NDArray, other: NDArray) -> float:
    """Return half the sum of absolute differences of square kernels."""
    radius = max(len(kernel), len(other)) // 2
    difference = np.zeros((2 * radius + 1,) * 2)
    for sign, square in ((1.0, kernel), (-1.0, other)):
        edge = radius - len(square) // 2
        difference[edge : edge + len(square), edge : edge + len(square)] += (
            sign * square
        )
    return float(np.abs(difference).sum() / 2.0)


@dataclass(frozen=True)
class Steps:
    """Points (n,) in the field of a filter, in three colors each.

    Attributes
    ----------
    eye_filter : EyeFilter
    places_px : list of (column, row)
    states : list of PointState
    """

    eye_filter: EyeFilter
    places_px: list[tuple[int, int]]
    states: list[PointState]

    @property
    def _handle(self):
        return self.eye_filter.prepared_stores[-1].store

    @property
    def _spec(self) -> GridSpec:
        return self._handle.store.spec

    @property
    def _eye(self) -> EyeOptics:
        return self._handle.store.eye

    def errors(self, truth: PointTruth) -> dict[str, NDArray[np.float64]]:
        """Return the errors (n,) of each step, the worst color.

        "method" is that of the program's PSFs of exactly the pixels, all the others
        are differences from those.
        """
        x_px, y_px = (np.array(v) + 0.5 for v in zip(*self.places_px, strict=True))
        states, added_dpt = self._pupil_states(x_px, y_px)
        scale = self._spec.pixel_from_mrad(states.h_deg, states.v_deg)
        exact = self._kernels(states, scale)
        plain = _normalized(exact)
        found = {"method": self._against_truth(plain, truth)}
        for accuracy in ("normal", "fine"):
            waves = self._kernels(states, scale, accuracy=accuracy, method="fourier")
            found[f"method, waves, {accuracy}"] = self._against_truth(
                _normalized(waves), truth
            )
        for kept in (0.99, 0.998):
            found[f"cropped to {kept:g}"] = self._worst(plain, _cropped(exact, kept))
        for bits in (16, 15):
            found[f"{bits} bits"] = self._worst(
                plain, [_in_bits(k, bits) for k in plain]
            )
        plan = unchecked_plan(self._eye, self._spec, predict=False)
        for name, axes in (
            ("pupil and accommodation", ("pupil", "accommodation")),
            ("field", ("h", "v")),
            ("all but defocus", ("h", "v", "pupil", "accommodation")),
            ("all nodes", ("h", "v", "pupil", "accommodation", "defocus")),
        ):
            blended = self._blended(plan, states, added_dpt, scale, axes)
            found[f"nodes: {name}"] = self._worst(plain, blended)
        cell_px = self._handle.image.cell_px
        centers, _ = self._pupil_states(
            *((np.floor(v / cell_px) + 0.5) * cell_px for v in (x_px, y_px))
        )
        own = self._spec.pixel_from_mrad(centers.h_deg, centers.v_deg)
        found["center of the cell"] = self._worst(
            plain, _normalized(self._kernels(centers, own))
        )
        return found

    def _pupil_states(self, x_px, y_px) -> tuple[PupilStates, NDArray[np.float64]]:
        """Return states (3 n,) of image points (n,), and their vergence."""
        h_deg, v_deg = field_deg(self._spec.camera, x_px, y_px)
        each = {
            "h_deg": h_deg,
            "v_deg": v_deg,
            "pupil_diameter_mm": [s.pupil_diameter_mm for s in self.states],
            "accommodation_dpt": [
                self._eye.accommodation_dpt(
                    s.focus_dpt, pupil_diameter_mm=s.pupil_diameter_mm
                )
                for s in self.states
            ],
        }
        columns = {name: np.repeat(np.array(v, float), 3) for name, v in each.items()}
        columns["wavelength_nm"] = np.tile(
            self._spec.channel_wavelengths_nm, len(self.states)
        )
        vergence = self._eye.vergence.vergence_dpt
        added_dpt = np.repeat([float(vergence(s.object_dpt)) for s in self.states], 3)
        total_dpt = self._eye.total_defocus_dpt(**columns) + added_dpt
        return PupilStates(**columns, total_defocus_dpt=total_dpt), added_dpt

    def _kernels(self, states: PupilStates, scale: NDArray, **options: str) -> PsfBatch:
        found = self._eye.wavefronts(**vars(states))
        return compute_psf_batch(
            found.zernike_um,
            pupil_diameter_mm=found.circle_diameter_mm,
            pupil_ellipse=found.pupil_ellipse,
            wavelength_nm=states.wavelength_nm,
            pixel_from_mrad=scale,
            min_energy_ratio=KEPT_RATIO,
            max_radius_px=MAX_RADIUS_PX,
            **options,
        )

    def _against_truth(self, kernels, truth: PointTruth) -> NDArray[np.float64]:
        exact = []
        for (x, y), state in zip(self.places_px, self.states, strict=True):
            points = wavefronts_of(self.eye_filter, self._spec.camera, x, y, state)
            exact += truth.images(points, MAX_RADIUS_PX)
        return self._worst(exact, kernels)

    @staticmethod
    def _worst(kernels, others) -> NDArray[np.float64]:
        errors = [half_l1(k, o) for k, o in zip(kernels, others, strict=True)]
        return np.array(errors).reshape(-1, 3).max(axis=1)

    def _blended(self, plan, states, added_dpt, scale, axes) -> list[NDArray]:
        """Return kernels of nodes, blended, in the pixels of the point."""
        corners = plan_corners(self._eye, self._spec, plan, states, added_dpt, axes)
        kept = corners.weights > 1e-9
        owner = np.nonzero(kept)[0]
        own = PupilStates(**{n: v[kept] for n, v in vars(corners.states).items()})
        kernels = _normalized(self._kernels(own, scale[owner]))
        blended = []
        for number in range(len(scale)):
            parts = [kernels[k] for k in np.flatnonzero(owner == number)]
            side = max(len(part) for part in parts)
            total = np.zeros((side, side))
            for weight, part in zip(
                corners.weights[number][kept[number]], parts, strict=True
            ):
                edge = (side - len(part)) // 2
                total[edge : side - edge, edge : side - edge] += weight * part
            blended.append(total)
        return blended


def _normalized(batch: PsfBatch) -> list[NDArray[np.float64]]:
    kernels = [psf.kernel.astype(np.float64) for psf in batch]
    return [kernel / kernel.sum() for kernel in kernels]


def _cropped(batch: PsfBatch, kept: float) -> list[NDArray[np.float64]]:
    packed = pack_kernels(batch, kept_energy_ratio=kept)
    kernels = []
    for psf, reach_px in zip(batch, packed.reach_px, strict=True):
        left, right, up, down = (int(r) for r in reach_px)
        middle = psf.radius_px
        is_kept = np.zeros(psf.kernel.shape, bool)
        is_kept[middle - up : middle + down + 1, middle - left : middle + right + 1] = (
            True
        )
        kernel = np.where(is_kept, psf.kernel.astype(np.float64), 0.0)
        kernels.append(kernel / kernel.sum())
    return kernels


def _in_bits(kernel: NDArray[np.float64], bits: int) -> NDArray[np.float64]:
    steps = np.floor(kernel / kernel.max() * (2**bits - 1) + 0.5)
    return steps / steps.sum()
