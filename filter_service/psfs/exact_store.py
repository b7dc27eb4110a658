"""PSFs of one state, computed at the layers of its frames.

Frames with a render tolerance of 0 read no PSFs between nodes of pupil, accommodation
or defocus: every PSF is computed for the pupil and the focus of the frame, at the total
defocus of a layer.  What remains is the interpolation between layers and over the
field.  Nodes of the field are those of the plan of the eye and more between them, at
most `FIELD_STEP_DEG` apart.  They do not depend on the state, so frames change
continuously with it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.defocus_nodes import (
    GroupRays,
    limited_defocus,
    node_blur_px,
)
from filter_service.planning.grid import GREEN
from filter_service.planning.node_wavefronts import NodeWavefronts, PupilStates
from filter_service.planning.nodes import PlanAxes, PlanNodes, RaggedNodes
from filter_service.psfs.frame_layers import blur_limits, edge_reach_px, frame_layers
from filter_service.psfs.pack import StateReads
from filter_service.psfs.store import PsfStore
from filter_service.view_state import State

FIELD_STEP_DEG = {"dynamic": 0.9, "quality": 0.7}
FINE_FIELD_RATIO = 0.5
"""Largest distance between field nodes, by mode, and the factor of "fine".  The error
grows with its square: in an eye after LASIK, pupil 6 mm, (21, -9) deg, 1.9 % of the
light is misplaced at 1 degree, 0.8 % at 0.6."""

LAYER_STEP_RATIO = {"on-axis": 0.2, "quality": 0.2, "dynamic": 0.15}
FINE_STEP_RATIO = 0.5
"""Steps between layers relative to the default, by mode, and the factor of "fine"."""

RAYS_FROM_DB = {"on-axis": 64.0, "quality": 64.0, "dynamic": 60.0}
FINE_DB = 2.0
"""Predicted PSNR from which PSFs are computed by ray optics, by mode, and what "fine"
adds.  Ray optics misplaces up to 5.6 % of the light, wave optics 0.9 %, and 0.26 % with
the accuracy that the modes on-axis and quality use."""

KEPT_ENERGY_RATIO, FINE_ENERGY_RATIO = 0.998, 0.9985
"""Share of light within a kernel's box, and the same with "fine"."""


class ExactStore(PsfStore):
    """PSFs of one state of an eye, for frames with a render tolerance of 0.

    Parameters
    ----------
    base : PsfStore
        Store of the eye, which determines the layers and the field nodes.
    state : State
        Pupil, focus and gaze of the frame; the gaze is within the prepared range.
    object_range_dpt : (low, high)
        Object distances of the frame.
    field_step_ratio : float
        Factor of the largest distance between field nodes, to save memory.
    layer_dpt : (n_layers,), optional
        Layers of all states, ascending; by default those that suit the state.

    Attributes
    ----------
    layers : FrameLayers
        Layers of all frames in this state.
    is_refined : bool
        Whether there are more field nodes than in the eye's plan.
    """

    def __init__(
        self,
        base: PsfStore,
        state: State,
        object_range_dpt: tuple[float, float],
        *,
        field_step_ratio: float = 1.0,
        layer_dpt: NDArray[np.float64] | None = None,
    ) -> None:
        settings = base.spec.settings
        is_fine = settings.tolerance == "fine"
        step_ratio = LAYER_STEP_RATIO[settings.mode]
        step_ratio *= FINE_STEP_RATIO if is_fine else 1.0
        layers = frame_layers(base, state, step_ratio=step_ratio)
        spec = replace(
            base.spec.with_settings(gaze_deg=state.gaze_deg, gaze_range_deg=(0.0, 0.0)),
            kept_energy_ratio=FINE_ENERGY_RATIO if is_fine else KEPT_ENERGY_RATIO,
            rays_from_db=RAYS_FROM_DB[settings.mode] + (FINE_DB if is_fine else 0.0),
            is_exact=True,
        )
        pupil_mm = layers.state.pupil_diameter_mm
        accommodation_dpt = base.eye.accommodation_dpt(
            state.focus_dpt, pupil_diameter_mm=pupil_mm
        )
        step_deg = field_step_ratio * FIELD_STEP_DEG.get(settings.mode, math.inf)
        step_deg *= FINE_FIELD_RATIO if is_fine else 1.0
        axes = PlanAxes(
            h_deg=_divided(base.plan.h_deg, step_deg),
            v_deg=_divided(base.plan.v_deg, step_deg),
            pupils_mm=np.array([pupil_mm]),
            accommodations_dpt=np.array([accommodation_dpt]),
        )
        sizes = [plan.h_deg.size * plan.v_deg.size for plan in (axes, base.plan)]
        self.is_refined = sizes[0] > sizes[1]
        super().__init__(base.eye, spec, axes, engine=base.engine)
        at_infinity_dpt, change = self.defocus.state(
            pupil_diameter_mm=pupil_mm, accommodation_dpt=accommodation_dpt
        )
        zero_dpt = at_infinity_dpt - self.defocus.change_at_nodes_dpt(change)
        if layer_dpt is not None:
            used_layer_dpt = layer_dpt
        else:
            layer_dpt = _covering(
                layers.layer_dpt, np.add(layers.vergence_range_dpt, change.range_dpt)
            )
            used_dpt = base.eye.vergence.vergence_dpt(np.array(object_range_dpt))
            first, last = np.searchsorted(layer_dpt, used_dpt + change.range_dpt)
            used_layer_dpt = layer_dpt[max(first - 1, 0) : last + 2]
        nodes = self._nodes(pupil_mm, accommodation_dpt, zero_dpt, used_layer_dpt)
        self._add_nodes([(0, 0)], nodes)
        reads = StateReads(np.zeros(1, np.int64), np.ones(1), np.ones(1))
        self.layers = replace(
            layers,
            layer_dpt=layer_dpt,
            field=change,
            layer_zero_dpt=zero_dpt,
            reads=reads,
            tables=self.tables,
            edge_reach_px=edge_reach_px(spec, pupil_mm),
            limits=blur_limits(self, reads, zero_dpt, change),
        )

    def _nodes(
        self,
        pupil_mm: float,
        accommodation_dpt: float,
        zero_dpt: NDArray[np.float64],
        layer_dpt: NDArray[np.float64],
    ) -> PlanNodes:
        """Return the nodes of all field nodes: one at each layer."""
        eye, spec = self.eye, self.spec
        h_deg, v_deg = self.plan.field_nodes_deg
        groups = PupilStates.of(
            h_deg=h_deg,
            v_deg=v_deg,
            pupil_diameter_mm=pupil_mm,
            accommodation_dpt=accommodation_dpt,
            wavelength_nm=spec.channel_wavelengths_nm[GREEN],
            total_defocus_dpt=0.0,
        )
        wavefronts = NodeWavefronts.of(eye, spec, groups)
        rays = GroupRays.of(wavefronts)
        whole_dpt = np.stack(
            [zero_dpt.min(axis=1) + layer_dpt[0], zero_dpt.max(axis=1) + layer_dpt[-1]],
            axis=-1,
        )
        limited_dpt, shrink_ratio = limited_defocus(eye, spec, groups, rays, whole_dpt)
        defocus = RaggedNodes.of(
            [
                _within(layer_dpt, low - own.min(), high - own.max())
                for own, (low, high) in zip(zero_dpt, limited_dpt, strict=True)
            ]
        )
        if np.any(shrink_ratio != 1.0):
            wavefronts = wavefronts.scaled(shrink_ratio)
        if spec.settings.lateral_color and spec.settings.chromatic:
            wavefronts = wavefronts.with_lateral_color(eye, spec, groups)
        return PlanNodes(
            defocus=defocus,
            channel_shift_dpt=zero_dpt,
            blur_px=node_blur_px(eye, spec, rays, defocus, zero_dpt, shrink_ratio),
            is_limited=np.any(limited_dpt != whole_dpt, axis=1),
            shrink_ratio=shrink_ratio,
            wavefronts=wavefronts,
        )


def _divided(axis: NDArray[np.float64], step_deg: float) -> NDArray[np.float64]:
    """Return an axis with each interval in equal parts, of at most a step."""
    counts = np.maximum(np.ceil(np.diff(axis) / step_deg), 1.0).astype(np.int64)
    places = [k + np.arange(n) / n for k, n in enumerate(counts)]
    return np.interp([*itertools.chain(*places), counts.size], range(axis.size), axis)


def _covering(
    layer_dpt: NDArray[np.float64], range_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return layers with the ends of a range, if they do not reach these."""
    return np.unique(np.clip(np.append(layer_dpt, range_dpt), *range_dpt))


def _within(
    layer_dpt: NDArray[np.float64], low_dpt: float, high_dpt: float
) -> NDArray[np.float64]:
    """Return the layers in a range, or the one nearest to its middle."""
    margin_dpt = 1e-9  # of rounding
    is_within = layer_dpt >= low_dpt - margin_dpt
    found = layer_dpt[is_within & (layer_dpt <= high_dpt + margin_dpt)]
    if found.size:
        return found
    nearest = np.abs(layer_dpt - 0.5 * (low_dpt + high_dpt)).argmin()
    return layer_dpt[nearest : nearest + 1]
