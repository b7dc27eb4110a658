"""Interface of the frame engines: requests, results, and the checks of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from estimator.note import Note
from filter_service.errors import BadMessage, CameraMismatch
from filter_service.planning.grid import GridSpec
from filter_service.rendering.frame import Merging, object_range_dpt
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.frame_states import FrameStore
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DEFAULT_OPTIONS, Output, RenderOptions
from filter_service.stage_times import StageTimes
from filter_service.texture_view import (
    EarlierFrame,
    GlTexture,
    TextureView,
)
from filter_service.validation import checked
from filter_service.view_state import EyeName, State, WithState

ROUNDING_DEG = 1e-6

OUTPUT_DTYPES = {"linear": np.float32, "srgb8": np.uint8, "linear16": np.float16}

SAMPLE_STRIDE_PX = 16
"""Stride of the check of the depth unit, which takes 25 us."""

RANGE_STEP_DPT = 0.5
"""Steps of the range of object distances that the PSFs of a single state are for."""

FAR_SCENE_M = 100.0
"""If all depth exceeds this, the unit is probably centimeters or millimeters: scenes
without a nearer object are rare."""


@dataclass(frozen=True)
class ViewRequest:
    """One view to filter, with the eye, its state and the options.

    Attributes
    ----------
    view : RgbdView or TextureView
        Images as arrays, or as textures of the current OpenGL context.
    handle : FrameStore
        PSFs of the eye, loaded by the engine.
    state : State
        A gaze outside the prepared range is clamped, and the result has a note.
    output : "srgb8", "linear" or "linear16"
        Encoding of an output array; a texture has its own.
    out : array or GlTexture, optional
        Array of the shape and type of the output, which the engine may fill; or the
        texture for the image of a `TextureView`, which is required: "rgba8" or
        "srgb8_a8" for sRGB values, "rgba16f" for linear light.
    until_s : float, optional
        Deadline by `time.monotonic`; the engine computes no PSFs after it.
    white_level : float, optional
        White level of arrays, if it is known; see `white_level`.
    times : StageTimes
        Receives the times of the frame's stages.
    target_is_top_first : bool, optional
        Whether the first row of a texture is the top of its image; by default as in
        the view.
    gain_ratio : (red, green, blue)
        Transmittance of the ocular media, for textures.
    waits : bool
        Whether to wait until a frame in textures is finished, and to repeat it until it
        is complete, so that `ViewResult.earlier` describes this frame.
    is_encoded : bool, optional
        Whether the caller encodes the image for a display; by default as ``output``.
    added_light : (rows, columns, 8), optional
        Light of `KernelTails`, for engines that add it.
    """

    view: RgbdView | TextureView
    handle: Any
    state: State
    output: Output = "linear"
    options: RenderOptions = DEFAULT_OPTIONS
    out: NDArray[Any] | GlTexture | None = None
    until_s: float | None = None
    white_level: float | None = None
    times: StageTimes = field(default_factory=StageTimes)
    target_is_top_first: bool | None = None
    gain_ratio: tuple[float, float, float] = (1.0, 1.0, 1.0)
    waits: bool = False
    is_encoded: bool | None = None
    added_light: NDArray[np.float32] | None = None

    @property
    def merges_for_display(self) -> bool:
        """Whether dark parts need a finer tolerance of merging."""
        return self.output == "srgb8" if self.is_encoded is None else self.is_encoded

    @property
    def merging(self) -> Merging:
        """How the frame merges pixels."""
        mode = self.handle.store.spec.settings.mode
        return Merging.of(self.options, self.state.gaze_deg, mode)


@dataclass(frozen=True, kw_only=True)
class FrameCounts:
    """Counters of a frame that users receive.

    A new counter needs a field here, with the default 0, and a value from each engine.
    If `Result` has a field of the same name, the service sends the counter.

    Attributes
    ----------
    missing_depth_count, clamped_depth_count, bad_color_count : int
        Pixels whose depth was missing and filled in, whose distance was outside the
        prepared range, and whose color was not finite and became black.  The last two
        include the hidden layer where it has depth.
    overflow_count : int
        Entries that did not fit a fragment list.  Their light is missing.
    """

    missing_depth_count: int = 0
    clamped_depth_count: int = 0
    bad_color_count: int = 0
    overflow_count: int = 0

    @property
    def counts(self) -> dict[str, int]:
        """Return the counts by name."""
        return summed_counts([self])


def summed_counts(counts: Sequence[FrameCounts]) -> dict[str, int]:
    """Return the sums of counts by name."""
    names = [count.name for count in fields(FrameCounts)]
    return {name: sum(int(getattr(c, name)) for c in counts) for name in names}


@dataclass(frozen=True, kw_only=True)
class ViewResult(FrameCounts, WithState):
    """A filtered view, the eye and state that it was filtered with, and statistics.

    Attributes
    ----------
    color : (height, width, 3)
        uint8 sRGB, or float32 or float16 linear light; empty for a view in textures.
    state : State
        Pupil, focus and gaze used.  A profile may limit the pupil, and an eye can only
        add power.
    notes : tuple of str
    stage_times_ms : dict
        Times of all views of the frame by stage.
    eye : "both", "left" or "right"
    profile_id : int
        The caller's identifier of the profile; by default the generation.
    generation : int
        Number of the profile in its stream.
    number : int
        Number of a frame in textures within the context, starting at 1.
    earlier : EarlierFrame or None
        For textures: the newest frame through this eye that the GPU has finished; this
        frame if the request waits, and otherwise one whose counts this result lacks.
    fragment_count, merged_count, entry_count : int
        Fragments, pixels merged into fragments, and entries of the bins' fragment
        lists (in the engine `native`, fragments of the listed clusters).  Rows shared
        by two strips of a very large frame count twice.  With a hidden layer, the
        border counts too.
    kernel_count, kernel_texel_count : int
        Kernels of the frame, and texels of all their levels.
    """

    color: NDArray[Any] = field(default_factory=lambda: np.empty((0, 0, 3), np.uint8))
    state: State
    notes: tuple[str, ...] = ()
    stage_times_ms: dict[str, float] = field(default_factory=dict)
    eye: EyeName = "both"
    profile_id: int = 0
    generation: int = 0
    number: int = 0
    earlier: EarlierFrame | None = None
    fragment_count: int = 0
    merged_count: int = 0
    entry_count: int = 0
    kernel_count: int = 0
    kernel_texel_count: int = 0
    layer_count: int = 0


Pending = Callable[[], ViewResult | MissingPsfs]
"""Wait for a view that `FrameEngine.begin` has started, and return it, or the PSFs that
were not computed by ``until_s``."""


class FrameEngine(Protocol):
    """Filters views through loaded stores, one at a time; not thread-safe."""

    @property
    def name(self) -> str:
        """Name of the renderer in replies and in `ocufilter doctor`."""

    @property
    def adds_light(self) -> bool:
        """Whether frames include the light of `KernelTails` in the request."""

    @property
    def importer(self) -> Any:
        """Importer of textures of other processes (`gl.renderer.Importer`), or None."""

    @property
    def memory_mb(self) -> float:
        """Memory of the buffers that frames reuse, 10^6 bytes; gl: all on the GPU."""

    def trim(self) -> None:
        """Release buffers that frames reuse; called after an idle period."""

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Register a callback for pauses during frames, if the engine has any.

        The engine calls it at most once every ``interval_s``.  The callback must not
        raise; it may filter another frame or load a store.  Returns whether the engine
        will call it.
        """

    def load(self, store: Any) -> FrameStore:
        """Load a store; its kernels may be computed later."""

    def begin(self, request: ViewRequest) -> Pending:
        """Start filtering a view; return a function that waits for the result.

        The caller may start other views before it calls that function, such as the
        view of the other eye.  An engine without concurrency filters the view at once.
        A view in textures is submitted to the GPU; only a request that waits waits.

        Raises
        ------
        BadMessage
            Images or options are invalid.
        CameraMismatch
            The store is for another camera, see `camera.is_same_camera`.
        RenderError
            In particular, the engine does not filter textures.
        """


def with_exact_psfs(engine: FrameEngine, request: ViewRequest) -> ViewRequest:
    """Return a request with the PSFs of its state if its render tolerance is 0.

    Textures whose caller does not wait keep the PSFs of the store: computing those of a
    state takes seconds.
    """
    if request.options.render_tolerance > 0.0:
        return request
    spec, is_paper = request.handle.store.spec, request.options.accumulation == "paper"
    if spec.is_exact or spec.settings.grid == "paper" or is_paper:
        return request
    if isinstance(request.view, TextureView) and not request.waits:
        return request
    gaze_deg, _ = clamped_gaze(spec, request.state.gaze_deg)
    state = replace(request.state, gaze_deg=gaze_deg)
    with request.times.wall("psf_plan_ms"):
        range_dpt = spec.object_range_dpt
        if isinstance(request.view, RgbdView):
            # In whole steps, so that frames of a stream use the same PSFs.
            whole = RANGE_STEP_DPT * np.array([-1.0, 1.0])
            outer = whole * np.ceil(np.array(object_range_dpt(request.view)) / whole)
            low, high = np.clip(outer, *range_dpt).tolist()
            range_dpt = low, high
        handle = request.handle.exact(state, range_dpt, engine.load)
    return replace(request, handle=handle)


class OneView:
    """Mixin that adds the method `render` to an engine."""

    def render(
        self: FrameEngine, view: RgbdView, handle: Any, **values: Any
    ) -> ViewResult | MissingPsfs:
        """Filter one view; ``values`` are a state, options or fields of the request."""
        state = State(
            values.pop("pupil_diameter_mm"),
            values.pop("focus_dpt"),
            values.pop("gaze_deg", None),
        )
        names = {option.name for option in fields(RenderOptions)}
        options = {name: values.pop(name) for name in names & set(values)}
        request = ViewRequest(
            view, handle, state, options=RenderOptions(**options), **values
        )
        return self.begin(request)()


def check_request(
    request: ViewRequest, spec: GridSpec
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Check a request; return the clamped gaze, and a note if it was changed.

    Raises
    ------
    BadMessage
        Unknown choice, invalid gaze, or tolerance out of range.
    CameraMismatch
        The store is for another camera, see `camera.is_same_camera`.
    """
    output: Any = Output  # mypy takes only classes for types as arguments
    checked(request.output, output, "output")
    checked(request.options.fields(), RenderOptions)
    camera = request.view.camera
    if not spec.serves(camera):
        raise CameraMismatch(
            f"the PSFs are for {spec.camera}, the view has {camera}",
            field="tangents",
        )
    return clamped_gaze(spec, request.state.gaze_deg)


def output_array(request: ViewRequest) -> NDArray[Any]:
    """Return the output array of a view: the caller's, or a new one.

    Raises
    ------
    BadMessage
        The array has another shape or type, or is not contiguous and writeable.
    """
    assert isinstance(request.view, RgbdView)
    shape, dtype = request.view.color.shape, np.dtype(OUTPUT_DTYPES[request.output])
    out = request.out
    if out is None:
        return np.empty(shape, dtype)
    assert isinstance(out, np.ndarray)
    if out.shape != shape or out.dtype != dtype or not out.flags.carray:
        raise BadMessage(
            f"it is {out.dtype} of shape {out.shape}",
            field="out",
            allowed=f"{dtype} of shape {shape}, contiguous and writeable",
        )
    return out


def clamped_gaze(
    spec: GridSpec, gaze_deg: tuple[float, float] | None
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Return a gaze (h, v) clamped to the prepared range, and a note if it changed.

    Parameters
    ----------
    gaze_deg : (h, v) or None
        Requested gaze; None stands for the gaze of ``spec``.

    Raises
    ------
    BadMessage
        The gaze is not two finite angles.
    """
    if gaze_deg is None:
        return spec.settings.gaze_deg, ()
    requested_deg = tuple(float(angle) for angle in gaze_deg)
    if len(requested_deg) != 2 or not all(
        math.isfinite(angle) for angle in requested_deg
    ):
        raise BadMessage(
            f"{gaze_deg}", field="gaze_deg", allowed="two finite angles (h, v)"
        )
    h_deg, v_deg = (
        min(max(angle, middle - reach), middle + reach)
        for angle, middle, reach in zip(
            requested_deg,
            spec.settings.gaze_deg,
            spec.settings.gaze_range_deg,
            strict=True,
        )
    )
    clamped_deg = h_deg, v_deg
    if not spec.follows_field:
        clamped_deg = spec.settings.gaze_deg
    if math.dist(requested_deg, clamped_deg) <= ROUNDING_DEG:
        return clamped_deg, ()
    code, reason = (
        ("gaze_not_prepared", "is outside what was prepared")
        if spec.follows_field
        else ("gaze_not_followed", "is not followed in mode on-axis")
    )
    note = Note(
        code,
        f"gaze {_text(requested_deg)} {reason}: {_text(clamped_deg)} used",
        h_deg=requested_deg[0],
        v_deg=requested_deg[1],
        used_h_deg=clamped_deg[0],
        used_v_deg=clamped_deg[1],
    )
    return clamped_deg, (note,)


def _text(gaze_deg: tuple[float, float]) -> str:
    return "({:.4g}, {:.4g}) deg".format(*gaze_deg)


def input_notes(
    depth_m: NDArray[np.float32], missing_depth_count: int, bad_color_count: int
) -> tuple[str, ...]:
    """Return notes on missing depth, an implausible depth unit and invalid color."""
    return sampled_input_notes(
        depth_m[::SAMPLE_STRIDE_PX, ::SAMPLE_STRIDE_PX],
        bad_color_count,
        has_depth=missing_depth_count < depth_m.size,
    )


def _is_near(sampled_m: NDArray[np.float32]) -> bool:
    """Return whether the depth in the middle is plausible, as in most frames."""
    rows, columns = sampled_m.shape
    middle_m = sampled_m[rows // 2, columns // 2]
    return bool(0.0 < middle_m < FAR_SCENE_M)


def _is_beyond(sampled_m: NDArray[np.float32], far_m: float) -> bool:
    known_m = sampled_m[(sampled_m > 0.0) & (sampled_m < np.inf)]
    return bool(known_m.size and known_m.min() >= far_m)


def sampled_input_notes(
    sampled_m: NDArray[np.float32], bad_color_count: int, *, has_depth: bool
) -> tuple[str, ...]:
    """Return the same notes, from depth at some pixels."""
    notes: list[str] = []
    if not has_depth:
        notes.append(Note("no_depth", "no pixel has depth; infinity is assumed"))
    if not _is_near(sampled_m) and _is_beyond(sampled_m, FAR_SCENE_M):
        text = f"all depth is beyond {FAR_SCENE_M:g} m: is it in meters?"
        notes.append(Note("depth_implausible", text, beyond_m=FAR_SCENE_M))
    if bad_color_count:
        text = f"{bad_color_count} pixels with non-finite color were set to black"
        notes.append(Note("color_not_finite", text, pixel_count=bad_color_count))
    return tuple(notes)
