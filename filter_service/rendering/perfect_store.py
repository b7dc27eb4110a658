"""PSFs of a perfect eye: the smallest store that frames can be filtered with."""

import numpy as np

from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from filter_service.camera import Camera
from filter_service.constants import RGB, WEIGHT_MAX
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan, PlanPrediction, RaggedNodes
from filter_service.psfs.store import PsfStore
from filter_service.settings import FilterSettings

PUPIL_MM = 3.0


def perfect_store(camera: Camera) -> PsfStore:
    """Return PSFs of one pixel at one pupil, focused at infinity, for 0 to 2 dpt.

    Their spread of 16 px is wide enough on paper for every merging pass to run.
    """
    spec = GridSpec(
        camera,
        FilterSettings(
            mode="on-axis",
            pupil_range_mm=(PUPIL_MM, PUPIL_MM),
            focus_range_dpt=(0.0, 0.0),
            object_range_dpt=(0.0, 2.0),
        ),
    )
    eye = MeasuredWavefront.from_profile(
        parse_profile({"kind": "prescription", "sphere_dpt": 0.0})
    )
    one = np.ones(RGB)
    return PsfStore(
        spec=spec,
        eye=eye,
        plan=CachePlan(
            h_deg=np.zeros(1),
            v_deg=np.zeros(1),
            pupils_mm=np.array([PUPIL_MM]),
            accommodations_dpt=eye.accommodation_nodes_dpt(
                spec.settings.focus_range_dpt
            ),
            defocus=RaggedNodes.of([np.zeros(1)]),
            channel_shift_dpt=np.zeros((1, RGB)),
            prediction=PlanPrediction(RGB, 0.0, 0.0, 1, np.inf, {}),
            is_limited=np.zeros(1, bool),
        ),
        kernels=np.full(RGB, WEIGHT_MAX, np.uint16),
        offsets=np.arange(RGB),
        reach_px=np.zeros((RGB, 4), np.int64),
        radius_px=np.zeros(RGB, np.int64),
        blur_px=0.0 * one,
        spread_px=16.0 * one,
        peak_ratio=one,
    )
