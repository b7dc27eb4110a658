"""The OpenGL frame engine.

A software renderer compiles a shader at its first dispatch, which would delay the first
frames of a new service by half a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from filter_service.errors import RenderFailed
from filter_service.gl.gpu import Gpu
from filter_service.gl.texture_io import ImportedTexture, TextureImporter
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import (
    OneView,
    Pending,
    ViewRequest,
    ViewResult,
    check_request,
    input_notes,
    output_array,
    sampled_input_notes,
    with_exact_psfs,
)
from filter_service.rendering.frame import blur_notes
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.gl.frame_run import EyeStates, FrameRun
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.texture_frames import TextureFrames
from filter_service.rendering.perfect_eye import change_by_perfect_eye
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import TextureMemory, TextureSupport, TextureView


class FilterRenderer(OneView):
    """Frame engine of OpenGL compute shaders; not thread-safe."""

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._eyes = EyeStates(gpu)
        self._had_missing_depth = False
        self._textures: TextureFrames | None = None

    adds_light = False

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

    @property
    def memory_mb(self) -> float:
        """Memory of the named buffers and atlases on the GPU, MB."""
        return self._gpu.memory_mb

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Return False: frames on a GPU are too short for pauses."""
        return False

    def begin(self, request: ViewRequest) -> Pending:
        """Start filtering a view; see `FrameEngine.begin`.

        Raises
        ------
        OutOfGpuMemory, RenderFailed
            In addition to the errors of `FrameEngine.begin`.
        """
        gaze = check_request(request, request.handle.store.spec)
        request = with_exact_psfs(self, request)
        if isinstance(request.view, TextureView):
            found = self._filter_textures(request, *gaze)
            return lambda: found
        # The application's own context may be current.
        with self._gpu.entered():
            self._gpu.drop_errors()
            run = FrameRun(
                self._gpu,
                self._eyes.of(request.handle),
                request,
                request.view,
                output_array(request),
                gaze_deg=gaze[0],
                fill_depth=self._had_missing_depth,
            )
        return partial(self._finish, run, *gaze)

    def _filter_textures(
        self,
        request: ViewRequest,
        gaze_deg: tuple[float, float],
        gaze_notes: tuple[str, ...],
    ) -> ViewResult | MissingPsfs:
        """Filter a view from textures, without waiting unless the request waits."""
        with self._gpu.entered():
            if self._textures is None:
                self._textures = TextureFrames(self._gpu)
            found = self._textures.filter(
                request, self._eyes.of(request.handle), gaze_deg
            )
            if found is None:
                return MissingPsfs(np.zeros(0, np.int64))
            layers, earlier = found
            counts: Mapping[str, Any] = {}
            notes = layers.notes + gaze_notes
            if layers.limits is not None and earlier is not None:
                image = request.handle.cells(request.times, gaze_deg)
                sampled = earlier.sampled
                view = RgbdView(sampled.color, sampled.depth_m, request.view.tangents)
                notes += blur_notes(view, layers, image)
            if request.waits and earlier is not None:
                self._gpu.check("render")
                counts = earlier.counts
                notes += sampled_input_notes(
                    earlier.sampled.depth_m,
                    counts["bad_color_count"],
                    has_depth=counts["missing_depth_count"]
                    < request.view.camera.pixel_count,
                )
        return ViewResult(
            state=replace(layers.state, gaze_deg=gaze_deg),
            notes=notes,
            stage_times_ms=request.times.ms,
            number=self._textures.number,
            earlier=earlier,
            layer_count=len(layers.layer_dpt),
            **counts,
        )

    @cached_property
    def importer(self) -> Importer | None:
        """Importer of textures of other processes, or None."""
        with suppress(RenderFailed):
            return Importer(self._gpu)
        return None

    def _finish(
        self, run: FrameRun, gaze_deg: tuple[float, float], gaze_notes: tuple[str, ...]
    ) -> ViewResult | MissingPsfs:
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
        return ViewResult(
            color=color,
            stage_times_ms=stages_ms,
            state=replace(layers.state, gaze_deg=gaze_deg),
            **counts,
            layer_count=len(layers.layer_dpt),
            notes=(
                *(*layers.notes, *gaze_notes, *run.blur_notes),
                *input_notes(run.depth_m, *noted),
            ),
        )


class Importer:
    """Importer of textures to the context of a `Gpu`.

    Raises
    ------
    RenderFailed
        If this OpenGL imports no memory.
    """

    def __init__(self, gpu: Gpu) -> None:
        self._gpu = gpu
        with gpu.entered():
            self._importer = TextureImporter(
                gpu.context.extensions, is_software=gpu.is_software
            )

    @property
    def support(self) -> TextureSupport:
        """Devices whose memory it can import."""
        return self._importer.support

    def import_texture(self, memory: TextureMemory, descriptor: int) -> ImportedTexture:
        """Return a texture in memory of another process; close the descriptor.

        Raises
        ------
        BadMessage
            OpenGL cannot use the memory for such a texture.
        """
        with self._gpu.entered():
            return self._importer.import_texture(memory, descriptor)

    def release(self, imported: ImportedTexture) -> None:
        """Free an imported texture and its memory."""
        with self._gpu.entered():
            self._importer.release(imported)
            # Drivers free memory when they flush, and an idle service would not.
            self._gpu.wait()
            self._gpu.texture_io.forget()


def compile_passes(renderer: FilterRenderer) -> float:
    """Filter a tiny frame in every variant that clients may request.

    Returns
    -------
    float
        Largest change of a pixel's value; ideally zero.
    """
    return change_by_perfect_eye(renderer)
