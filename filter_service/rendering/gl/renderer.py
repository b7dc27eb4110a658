"""The OpenGL frame engine."""

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

from filter_service.errors import RenderFailed
from filter_service.gl.gpu import Gpu
from filter_service.gl.texture_io import ImportedTexture, TextureImporter
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import (
    OneView,
    Pending,
    ShownTexture,
    TextureRequest,
    ViewRequest,
)
from filter_service.rendering.filtered_view import (
    FilteredView,
    input_notes,
    sampled_input_notes,
)
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.frame_states import FrameStates
from filter_service.rendering.gl.eye_states import EyeStates
from filter_service.rendering.gl.frame_run import FrameRun
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.texture_frames import TextureFrames
from filter_service.rendering.request_checks import (
    check_options,
    check_request,
    output_array,
)
from filter_service.texture_view import (
    EarlierFrame,
    TextureMemory,
    TextureSupport,
    TextureView,
)


class FilterRenderer(OneView):
    """Frame engine of OpenGL compute shaders; not thread-safe."""

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._eyes = EyeStates(gpu)
        self._had_missing_depth = False
        self._textures: TextureFrames | None = None
        self._importer: TextureImporter | None = None

    @property
    def name(self) -> str:
        """Name of the OpenGL renderer."""
        return str(self._gpu.info["renderer"])

    def load(self, store: PsfStore) -> GlStore:
        """Load a store; its kernels may be computed later."""
        return GlStore(self._gpu, store)

    def trim(self) -> None:
        """Drop the state of released stores.

        Buffers on the GPU are kept: their size is bounded, and allocation is slow.
        """
        self._eyes.drop_released()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Return False: frames on a GPU are too short for pauses."""
        return False

    def frame_states(self, handle: GlStore) -> FrameStates:
        """Return the cached layers and cells of the frames of a loaded store."""
        return self._eyes.of(handle).states

    def begin(self, request: ViewRequest) -> Pending:
        """Start filtering a view; see `FrameEngine.begin`.

        Raises
        ------
        OutOfGpuMemory, RenderFailed
            In addition to the errors of `FrameEngine.begin`.
        """
        gaze = check_request(request, request.handle.store)
        # The application's own context may be current.
        with self._gpu.entered():
            self._gpu.drop_errors()
            run = FrameRun(
                self._gpu,
                self._eyes.of(request.handle),
                request,
                output_array(request),
                gaze_deg=gaze[0],
                fill_depth=self._had_missing_depth,
            )
        return partial(self._finish, run, *gaze)

    def filter_textures(self, request: TextureRequest) -> ShownTexture | None:
        """Filter a view from textures; see `TextureEngine.filter_textures`.

        Raises
        ------
        OutOfGpuMemory, RenderFailed
            In addition to its errors: the context is not current, or OpenGL cannot
            draw to the target.
        """
        gaze_deg, notes = check_options(request, request.handle.store)
        with self._gpu.entered():
            if self._textures is None:
                self._textures = TextureFrames(self._gpu)
            self._textures.check(request)
            found = self._textures.filter(
                request, self._eyes.of(request.handle), gaze_deg
            )
            if found is None:
                return None
            layers, earlier = found
            if request.waits:
                self._gpu.check("render")
                notes = (*notes, *_input_notes(request.view, earlier))
        return ShownTexture(
            state=replace(layers.state, gaze_deg=gaze_deg),
            number=self._textures.number,
            notes=(*layers.notes, *notes),
            earlier=earlier,
        )

    @property
    def texture_support(self) -> TextureSupport | None:
        """Devices whose memory this can import, or None."""
        if self._importer is None:
            with suppress(RenderFailed), self._gpu.entered():
                self._importer = TextureImporter(
                    self._gpu.context.extensions, is_software=self._gpu.is_software
                )
        return None if self._importer is None else self._importer.support

    def import_texture(self, memory: TextureMemory, descriptor: int) -> ImportedTexture:
        """Return a texture in memory of another process; close the descriptor.

        Raises
        ------
        BadMessage
            OpenGL cannot use the memory for such a texture.
        RenderFailed
            This OpenGL imports no memory.
        """
        if self.texture_support is None or self._importer is None:
            os.close(descriptor)
            raise RenderFailed("this OpenGL imports no memory")
        with self._gpu.entered():
            return self._importer.import_texture(memory, descriptor)

    def release_texture(self, imported: ImportedTexture) -> None:
        """Free an imported texture and its memory."""
        if self._importer is None:
            return
        with self._gpu.entered():
            self._importer.release(imported)
            # Drivers free memory when they flush, and an idle service would not.
            self._gpu.wait()
            self._gpu.texture_io.forget()

    def _finish(
        self, run: FrameRun, gaze_deg: tuple[float, float], gaze_notes: tuple[str, ...]
    ) -> FilteredView | MissingPsfs:
        with self._gpu.entered():
            found = run.finish()
            if isinstance(found, MissingPsfs):
                return found
            color, counts = found
            self._gpu.check("render")
            stages_ms = run.timer.result_ms()
        self._had_missing_depth = counts["missing_depth_count"] > 0
        layers = run.layers
        noted = counts["missing_depth_count"], counts["bad_color_count"]
        return FilteredView(
            color=color,
            stage_times_ms=stages_ms,
            state=replace(layers.state, gaze_deg=gaze_deg),
            **counts,
            layer_count=len(layers.layer_dpt),
            notes=[
                *layers.notes,
                *gaze_notes,
                *input_notes(run.depth_m, *noted),
            ],
        )


def _input_notes(view: TextureView, frame: EarlierFrame | None) -> tuple[str, ...]:
    """Return the notes on the input of a finished frame."""
    if frame is None:
        return ()
    has_depth = frame.counts["missing_depth_count"] < view.camera.pixel_count
    found = sampled_input_notes(
        frame.sampled.depth_m, frame.counts["bad_color_count"], has_depth=has_depth
    )
    return tuple(found)
