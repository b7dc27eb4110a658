"""PSF store of a perfect eye, whose filter returns the image unchanged."""

from typing import Any

import numpy as np

from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from filter_service.camera import Camera
from filter_service.constants import RGB, WEIGHT_MAX
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.node_wavefronts import NodeWavefronts, PupilStates
from filter_service.planning.nodes import CachePlan, PlanNodes, RaggedNodes
from filter_service.psfs.pack import PackedKernels
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import FrameEngine, ViewRequest
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rgbd_view import RgbdView
from filter_service.settings import Accumulation, FilterSettings, Output, RenderOptions
from filter_service.view_state import State

PUPIL_MM = 3.0
STATE = State(PUPIL_MM, 0.0)
SIDE_PX = 16
TANGENTS = (-0.01, 0.01, 0.01, -0.01)

VARIANTS: tuple[tuple[type[Any], Output, Accumulation], ...] = (
    (np.uint8, "srgb8", "coverage"),
    (np.uint8, "srgb8", "paper"),
    (np.float32, "linear", "coverage"),
    (np.float16, "linear16", "coverage"),
)
"""Color type, output and accumulation rule of each code path of an engine."""


def change_by_perfect_eye(engine: FrameEngine) -> float:
    """Filter a tiny frame once per code path of the engine.

    Returns
    -------
    float
        Largest change of a pixel's value; ideally zero.
    """
    handle = engine.load(perfect_store(Camera(SIDE_PX, SIDE_PX, TANGENTS)))
    depth_m = np.ones((SIDE_PX, SIDE_PX), np.float32)
    changes = []
    for dtype, output, accumulation in VARIANTS:
        view = RgbdView(np.ones((SIDE_PX, SIDE_PX, RGB), dtype), depth_m, TANGENTS)
        options = RenderOptions(accumulation=accumulation)
        request = ViewRequest(view, handle, STATE, output=output, options=options)
        rendered = engine.begin(request)()
        assert not isinstance(rendered, MissingPsfs)  # it has no deadline
        changes.append(np.abs(rendered.color.astype(np.float32) - view.color))
    handle.release()
    return float(np.max(changes))


def perfect_store(camera: Camera) -> PsfStore:
    """Return one-pixel PSFs for one pupil, focus at infinity, objects at 0 to 2 dpt.

    Their nominal spread of 16 px is large enough for all levels of merging.
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
    plan = CachePlan(
        h_deg=np.zeros(1),
        v_deg=np.zeros(1),
        pupils_mm=np.array([PUPIL_MM]),
        accommodations_dpt=np.zeros(1),
        nodes=PlanNodes(
            defocus=RaggedNodes.of([np.zeros(1)]),
            channel_shift_dpt=np.zeros((1, RGB)),
            blur_px=np.zeros(RGB, np.float32),
            is_limited=np.zeros(1, bool),
            shrink_ratio=np.ones(1),
            wavefronts=NodeWavefronts.of(eye, spec, _at_rest(spec)),
        ),
    )
    one = np.ones(RGB)
    packed = PackedKernels(
        weights=np.full(RGB, WEIGHT_MAX, np.uint16),
        offsets=np.arange(RGB),
        reach_px=np.zeros((RGB, 4), np.int64),
        radius_px=np.zeros(RGB, np.int64),
        peak_ratio=one,
        spread_px=16.0 * one,
        lost_energy_ratio=0.0 * one,
    )
    return PsfStore.of_kernels(eye, spec, plan, packed)


def _at_rest(spec: GridSpec) -> PupilStates:
    """Return the single state of the perfect eye."""
    return PupilStates.of(
        h_deg=np.zeros(1),
        v_deg=0.0,
        pupil_diameter_mm=PUPIL_MM,
        accommodation_dpt=0.0,
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
        total_defocus_dpt=0.0,
    )
