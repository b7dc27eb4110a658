"""`FilterOperator`: the filter of one frame as a matrix, and its transpose.

For fixed depth, state of the eye and gaze, the image is a linear function of the color,
in linear light, if pixels are not merged and bright pixels are treated like others.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter_service.camera import Camera
from filter_service.constants import RGB
from filter_service.errors import BadMessage, OutOfMemory, RenderFailed
from filter_service.filtering.planned_frame import PlannedFrame, PlannedView
from filter_service.psfs.exact_store import LAYER_STEP_RATIO
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.frozen_store import FrozenLayers, FrozenStore
from filter_service.rendering.engine import ViewRequest, clamped_gaze
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.media_effects import (
    MediaEffects,
    Spectacles,
    seen_through,
)
from filter_service.rendering.native import NativeRenderer
from filter_service.rendering.native.frame_record import NativeStore
from filter_service.rgbd_view import RgbdView, as_views
from filter_service.settings import RenderOptions

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

    from filter_service.rendering.native import FrameOperator


class FilterOperator:
    """The filter of one frame as a linear operator; see `EyeFilter.operator`.

    Color and image are linear light, float32.  With the matrix A of the operator,
    ``forward`` computes A x and ``adjoint`` computes its transpose times y.  Both
    sum in float32, so that ``<A x, y>`` equals ``<x, A' y>`` to about 1e-6 of the sum
    of magnitudes.  Results do not depend on the number of threads.

    The operator keeps the plan, kernels and lists of its frame, and remains valid when
    the filter is closed or gets another profile.  It may be used by several threads;
    calls of the same operator wait for each other.

    Attributes
    ----------
    color_shape : tuple of int
        (height, width, 3); (2, height, width, 3) with a hidden layer, whose color
        follows that of the visible surface.  If the operator was made for a sequence of
        views, their number comes first.
    image_shape : tuple of int
        (height, width, 3), after the number of views if there is one.
    shape : (rows, columns)
        Shape of the matrix: the sizes of an image and of a color.
    """

    def __init__(self, views: Sequence[ViewOperator], *, is_sequence: bool) -> None:
        self._views, self._lock = tuple(views), threading.Lock()
        first = self._views[0]
        for i, view in enumerate(self._views):
            if view.color_shape != first.color_shape:
                raise BadMessage(
                    f"its color has shape {view.color_shape}",
                    field=f"views[{i}]",
                    allowed=f"{first.color_shape}, as the first",
                )
        counts = (len(self._views),) if is_sequence else ()
        self.color_shape = (*counts, *first.color_shape)
        self.image_shape = (*counts, *first.color_shape[-3:])
        self.shape = (
            int(np.prod(self.image_shape)),
            int(np.prod(self.color_shape)),
        )

    dtype = np.dtype(np.float32)

    @classmethod
    def of(
        cls, planned: PlannedFrame, options: RenderOptions, *, is_sequence: bool
    ) -> Self:
        """Return the operator of a planned frame; see `EyeFilter.operator`."""
        views = [_planned_operator(view, options) for view in planned.views]
        return cls(views, is_sequence=is_sequence)

    def forward(self, color: ArrayLike) -> NDArray[np.float32]:
        """Return the image of a color.

        Parameters
        ----------
        color : array of `color_shape`
            Linear light of any sign.  Non-finite values count as 0.

        Returns
        -------
        image : float32 array of `image_shape`

        Raises
        ------
        BadMessage
            If the array has another shape, or does not contain real floats.
        """
        light = _checked(color, self.color_shape, "color")
        parts = light.reshape(-1, *self._views[0].color_shape)
        with self._lock:
            found = [own.forward(x) for own, x in zip(self._views, parts, strict=True)]
        return _joined(found, self.image_shape)

    def adjoint(self, image: ArrayLike) -> NDArray[np.float32]:
        """Return the transpose of the operator times an image.

        Parameters
        ----------
        image : array of `image_shape`
            As the color of `forward`.

        Returns
        -------
        color : float32 array of `color_shape`

        Raises
        ------
        BadMessage
            As `forward`.
        """
        light = _checked(image, self.image_shape, "image")
        parts = light.reshape(-1, *self.image_shape[-3:])
        with self._lock:
            found = [own.adjoint(y) for own, y in zip(self._views, parts, strict=True)]
        return _joined(found, self.color_shape)

    def as_linear_operator(self) -> LinearOperator:
        """Return a SciPy operator on flattened arrays, for solvers such as `lsqr`."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(
            self.shape,
            matvec=lambda x: self.forward(x.reshape(self.color_shape)).ravel(),
            rmatvec=lambda y: self.adjoint(y.reshape(self.image_shape)).ravel(),
            dtype=self.dtype,
        )


def _checked(
    array: ArrayLike, shape: tuple[int, ...], field: str
) -> NDArray[np.float32]:
    found = np.asarray(array)
    if found.shape != shape or found.dtype.kind != "f":
        raise BadMessage(
            f"it is {found.dtype} of shape {found.shape}",
            field=field,
            allowed=f"floats of shape {shape}, in linear light",
        )
    return np.ascontiguousarray(found, np.float32)


def _joined(
    parts: Sequence[NDArray[np.float32]], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    found = parts[0] if len(parts) == 1 else np.stack(parts)
    return found.reshape(shape)


@dataclass(frozen=True)
class ViewOperator:
    """The operator of one view: spectacles, frame and media.

    Attributes
    ----------
    color_shape : tuple of int
        As `FilterOperator.color_shape`, of one view.
    """

    frame: FrameOperator
    camera: Camera
    color_shape: tuple[int, ...]
    depths_m: tuple[NDArray[np.float32], ...]
    effects: MediaEffects | None
    spectacles: Spectacles | None

    @classmethod
    def of(
        cls,
        request: ViewRequest,
        effects: MediaEffects | None,
        *,
        n_threads: int | None = None,
    ) -> Self:
        """Return the operator of a view whose PSFs may be computed meanwhile.

        Raises
        ------
        RenderError
        """
        view = request.view
        assert isinstance(view, RgbdView)
        spectacles = None
        if effects is not None and effects.magnification_ratio is not None:
            spectacles = Spectacles(effects.magnification_ratio, view.camera)
            view = seen_through(view, effects.magnification_ratio)
        request = _native(request, view)
        while True:
            try:
                frame = NativeRenderer(n_threads=n_threads).operator(request)
                break
            except OutOfMemory:
                if not request.handle.coarsen_exact():
                    raise
        if isinstance(frame, MissingPsfs):
            raise RenderFailed(f"{frame.psfs.size} PSFs are missing")
        surfaces = (2,) if view.surface_count == 2 else ()
        shape = (*surfaces, view.height_px, view.width_px, RGB)
        depths_m = view.surface_depths_m
        return cls(frame, view.camera, shape, depths_m, effects, spectacles)

    def forward(self, color: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (height, width, 3) of a color of the operator's shape."""
        colors = color.reshape(-1, *self.color_shape[-3:])
        if self.spectacles is not None:
            see = self.spectacles.resample
            seen = [see(c, m)[0] for c, m in zip(colors, self.depths_m, strict=True)]
            colors = np.stack(seen)
        # A hidden layer that is empty is not part of the frame.
        image = self.frame.forward(colors[: self.frame.color_shape[0]])
        if self.effects is not None:
            self.effects.apply(image, self.camera)
        return image

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the adjoint, of the operator's shape, of an image."""
        if self.effects is not None:
            image = self.effects.adjoint(image, self.camera)
        colors = self.frame.adjoint(image)
        if self.spectacles is not None:
            colors = np.stack([self.spectacles.adjoint(color) for color in colors])
        found = colors.reshape(-1, *self.color_shape[-3:])
        missing = len(self.depths_m) - len(found)
        if missing:
            found = np.pad(found, ((0, missing), (0, 0), (0, 0), (0, 0)))
        return found.reshape(self.color_shape)


def _native(request: ViewRequest, view: RgbdView) -> ViewRequest:
    """Return a request for the native engine, whatever the engine of its store."""
    handle = request.handle
    if not isinstance(handle, NativeStore):
        handle = NativeStore(handle.store)
    return replace(request, view=view, handle=handle)


def _planned_operator(planned: PlannedView, options: RenderOptions) -> ViewOperator:
    settings = planned.eye.settings
    if settings.frame_options(options).accumulation == "paper":
        raise BadMessage(
            f"it is {settings.pipeline!r}", field="pipeline", allowed="'exact'"
        )
    request = ViewRequest(planned.view, planned.store, planned.state, options=options)
    with planned.builder.frame():
        found = ViewOperator.of(request, planned.eye.media_effects)
        planned.builder.mark_rendered(planned.stream, planned.eye, planned.store)
    return found


def frozen_layers(planned: PlannedView) -> FrozenLayers:
    """Return layers at the distances of a planned view, for `frozen_operator`."""
    store, view = planned.store.store, planned.view
    assert isinstance(view, RgbdView)
    distances_dpt = [
        object_dpt(view, fill_missing_depth(depth_m)[0]).ravel()
        for depth_m in view.surface_depths_m
    ]
    layers = frame_layers(
        store, planned.state, step_ratio=LAYER_STEP_RATIO[store.spec.settings.mode]
    )
    vergence_dpt = store.eye.vergence.vergence_dpt(np.concatenate(distances_dpt))
    return FrozenLayers.of(layers, np.clip(vergence_dpt, *layers.vergence_range_dpt))


def frozen_operator(
    planned: PlannedFrame, frozen: Sequence[FrozenLayers], *, is_sequence: bool
) -> FilterOperator:
    """Return the operator of a planned frame whose views have frozen layers.

    Raises
    ------
    BadMessage
        If the PSFs of the eye or of the settings cannot be computed by quadrature.
    """
    views = []
    for view, layers in zip(planned.views, frozen, strict=True):
        store = view.store.store
        if store.eye.rings is not None or not store.spec.settings.diffraction:
            raise BadMessage(
                "'fine'",
                field="accuracy",
                allowed="'normal' without diffraction or with a multifocal lens",
            )
        gaze_deg, _ = clamped_gaze(store.spec, view.state.gaze_deg)
        state = replace(view.state, gaze_deg=gaze_deg)
        camera = view.view.camera
        size_px = camera.width_px, camera.height_px
        own = NativeStore(FrozenStore(store, state, layers, size_px))
        views.append(_planned_operator(replace(view, store=own), operator_options(0.0)))
    return FilterOperator(views, is_sequence=is_sequence)


def views_of_depth(
    depth_m: NDArray[Any] | RgbdView | Sequence[RgbdView], camera: Camera | None
) -> tuple[RgbdView, ...]:
    """Return the views of a frame, given as depth or as views.

    Raises
    ------
    BadMessage
        As `as_views`.
    """
    if not isinstance(depth_m, np.ndarray):
        return as_views(depth_m, None, camera)
    shape = depth_m.shape if depth_m.ndim == 2 else (1, 1)
    return as_views(np.zeros((*shape, RGB), np.uint8), depth_m, camera)


def operator_options(render_tolerance: float) -> RenderOptions:
    """Return the options with which `EyeFilter.filter` computes the same image."""
    return RenderOptions(
        merge=False, bright_pixels=False, render_tolerance=render_tolerance
    )
