"""An eye as a linear layer of PyTorch; requires the extra ``ocufilter[torch]``.

    from ocufilter.torch import SeeThrough

    see = SeeThrough("myopia", camera, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0)
    loss = (see(color) - target).square().mean()
    loss.backward()

Only this module and the training of the networks import PyTorch.  The service never
does.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import lsqr

from filter_service import (
    Camera,
    EyeFilter,
    FilterOperator,
    FilterSettings,
    RgbdView,
    image_derivatives,
)

try:
    import torch
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "ocufilter.torch requires PyTorch; install it with: "
        "pip install 'ocufilter[torch]'",
        name="torch",
    ) from error


STATE = ("pupil_diameter_mm", "focus_dpt")
"""Parameters of the state that may be tensors with gradients."""


class SeeThrough(torch.nn.Module):
    """The filter of a frame as a differentiable linear layer.

    For fixed depth and state, the image is a linear function of the color, in linear
    light; see `EyeFilter.operator`.  Colors and images are float tensors of shape
    (..., 3, height, width), with any number of batch dimensions, on any device.  With a
    hidden layer, colors are (..., 2, 3, height, width).  The filter computes on the
    CPU, in float32, and returns the type and device of its input.  Results do not
    depend on the number of threads, nor on the other items of a batch.

    The methods have the names of linear operators in deepinv: ``A``, ``A_adjoint`` and
    ``A_dagger``.

    The module can be pickled and passed to workers.  Each process opens its own filter
    when it first needs it, which takes a second or two.

    Parameters
    ----------
    profile : EyeProfile, mapping, str or Path
        Profile, as for `EyeFilter`.  Assign another one to the attribute of the same
        name to see through another eye, such as one of an `EyeBank` for each sample.
    camera : Camera
    depth_m : (height, width) float32, RgbdView, or sequence of RgbdView
        Depth, as for `EyeFilter.operator`.  Assign another array to the attribute of
        the same name to filter another scene.
    pupil_diameter_mm, focus_dpt : float or scalar tensor
        State of the eye; other values may be assigned to the attributes.  Tensors that
        require gradients, such as parameters, get those of `image_derivatives`, which
        take seconds and cannot be differentiated again.
    gaze_deg : (h, v), optional
    settings : FilterSettings or mapping, optional
        Settings of the filter.
    render_tolerance : float
        As for `EyeFilter.operator`.
    accuracy : "normal" or "fine"
        Accuracy of gradients by pupil and focus, as for `image_derivatives`.
    worker : bool, optional
        As for `EyeFilter`.

    Raises
    ------
    BadMessage
        When it is first used: a parameter is invalid (a ValueError, too).
    """

    def __init__(
        self,
        profile: Any,
        camera: Camera,
        depth_m: NDArray[Any] | RgbdView | Sequence[RgbdView],
        *,
        pupil_diameter_mm: float | torch.Tensor,
        focus_dpt: float | torch.Tensor,
        gaze_deg: tuple[float, float] | None = None,
        settings: FilterSettings | Mapping[str, Any] = FilterSettings(),  # noqa: B008
        render_tolerance: float = 1.0,
        accuracy: str = "normal",
        worker: bool | None = None,
    ) -> None:
        super().__init__()
        self.profile, self.camera, self.settings = profile, camera, settings
        self.depth_m, self.gaze_deg = depth_m, gaze_deg
        self.pupil_diameter_mm, self.focus_dpt = pupil_diameter_mm, focus_dpt
        self.render_tolerance, self.accuracy = render_tolerance, accuracy
        self.worker = worker
        self._filter: EyeFilter | None = None
        self._made: tuple[Any, dict[str, Any], FilterOperator] | None = None
        self._opened_profile: Any = None
        self._pid = 0

    def forward(self, color: torch.Tensor) -> torch.Tensor:
        """Return the images of colors; see `A`."""
        return self.A(color)

    def A(self, color: torch.Tensor) -> torch.Tensor:  # noqa: N802
        """Return the images (..., 3, height, width) of colors.

        Raises
        ------
        ValueError
            If the tensor has another shape, or is not real and floating-point.
        """
        state = self.pupil_diameter_mm, self.focus_dpt
        image = _Applied.apply(color, self.operator(), False)
        if any(isinstance(value, torch.Tensor) for value in state):
            values = [torch.as_tensor(value) for value in state]
            return _OfState.apply(image, color, self, *values)
        return image

    def A_adjoint(self, image: torch.Tensor) -> torch.Tensor:  # noqa: N802
        """Return the transpose of the operator, applied to images.

        Raises
        ------
        ValueError
            As `A`.
        """
        return _Applied.apply(image, self.operator(), True)

    def A_dagger(  # noqa: N802
        self, image: torch.Tensor, *, max_iter: int = 50, tol: float = 1e-4
    ) -> torch.Tensor:
        """Return colors whose images are nearest to given images, by LSQR.

        LSQR starts at 0 and approaches the solution of least norm.  What the eye does
        not transmit is not restored, and noise is amplified: fewer iterations
        regularize.  The result carries no gradient.

        Parameters
        ----------
        max_iter : int
            Largest number of iterations; each applies the operator and its adjoint.
        tol : float
            Relative tolerance, ``atol`` and ``btol`` of `scipy.sparse.linalg.lsqr`.

        Raises
        ------
        ValueError
            As `A`.
        """
        operator = self.operator()
        matrix = operator.as_linear_operator()

        def solved(own: NDArray[np.float32]) -> NDArray[np.float32]:
            found = lsqr(matrix, own.ravel(), atol=tol, btol=tol, iter_lim=max_iter)[0]
            return found.astype(np.float32).reshape(operator.color_shape)

        return _each(image, solved, operator.image_shape, operator.color_shape)

    def operator(self) -> FilterOperator:
        """Return the operator of the module's depth and state, kept until these change.

        Raises
        ------
        BadMessage
            As `EyeFilter.operator`.
        """
        eye_filter = self._opened()
        state: dict[str, Any] = {
            "pupil_diameter_mm": _number(self.pupil_diameter_mm),
            "focus_dpt": _number(self.focus_dpt),
            "gaze_deg": self.gaze_deg,
            "render_tolerance": self.render_tolerance,
        }
        made = self._made
        if made is not None and made[0] is self.depth_m and made[1] == state:
            return made[2]
        self._made = None  # its memory goes first
        found = eye_filter.operator(self.depth_m, **state)
        self._made = self.depth_m, state, found
        return found

    def _derivatives(
        self,
        color: torch.Tensor,
        names: list[str],
        depth_m: Any,
        pupil_diameter_mm: float,
        focus_dpt: float,
    ) -> dict[str, torch.Tensor]:
        """Return the derivatives of images by pupil or focus."""
        if not names:
            return {}
        arrays = color.detach().to("cpu", torch.float32).movedim(-3, -1).numpy()
        found = image_derivatives(
            self._opened(),
            np.ascontiguousarray(arrays),
            depth_m,
            names,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            gaze_deg=self.gaze_deg,
            accuracy=self.accuracy,
        )
        return {
            name: torch.from_numpy(image).movedim(-1, -3)
            for name, image in found.items()
        }

    def _opened(self) -> EyeFilter:
        if self._pid != os.getpid():  # threads do not survive a fork
            self._forget()
            self._pid = os.getpid()
        if self._filter is None:
            self._filter = EyeFilter(
                self.profile, self.camera, self.settings, worker=self.worker
            )
        elif self.profile is not self._opened_profile:
            self._made = None
            self._filter.set_profile(self.profile)
        self._opened_profile = self.profile
        return self._filter

    def close(self) -> None:
        """Release the filter's resources; the next use opens another filter."""
        if self._filter is not None:
            self._filter.close()
        self._forget()

    def _forget(self) -> None:
        self._filter, self._made, self._pid = None, None, 0

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle, without the filter and the operator."""
        return {**self.__dict__, "_filter": None, "_made": None, "_pid": 0}


def _number(value: float | torch.Tensor) -> float:
    return float(value.item() if isinstance(value, torch.Tensor) else value)


class _OfState(torch.autograd.Function):
    """The images as functions of pupil and focus, besides their colors."""

    @staticmethod
    def forward(
        ctx: Any,
        image: torch.Tensor,
        color: torch.Tensor,
        see: SeeThrough,
        *state: torch.Tensor,
    ) -> torch.Tensor:
        ctx.see, ctx.state = see, [value.item() for value in state]
        ctx.depth_m = see.depth_m
        ctx.save_for_backward(color)
        return image.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[Any, ...]:
        needed = [
            name
            for name, is_needed in zip(STATE, ctx.needs_input_grad[3:], strict=True)
            if is_needed
        ]
        found = ctx.see._derivatives(
            ctx.saved_tensors[0], needed, ctx.depth_m, *ctx.state
        )
        by_state = [
            (found[name].to(gradient) * gradient).sum() if name in found else None
            for name in STATE
        ]
        return gradient, None, None, *by_state


class _Applied(torch.autograd.Function):
    """An operator or its transpose, whose gradient is the other one."""

    @staticmethod
    def forward(
        ctx: Any, given: torch.Tensor, operator: FilterOperator, is_adjoint: bool
    ) -> torch.Tensor:
        ctx.operator, ctx.is_adjoint = operator, is_adjoint
        shapes = operator.color_shape, operator.image_shape
        if is_adjoint:
            return _each(given, operator.adjoint, shapes[1], shapes[0])
        return _each(given, operator.forward, *shapes)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[Any, ...]:
        return _Applied.apply(gradient, ctx.operator, not ctx.is_adjoint), None, None


def _each(
    given: torch.Tensor,
    function: Any,
    shape: tuple[int, ...],
    found_shape: tuple[int, ...],
) -> torch.Tensor:
    """Apply a function of arrays of a shape to each item of a batch."""
    n_items = len(shape)
    expected = _channels_first(shape)
    if not isinstance(given, torch.Tensor) or not given.is_floating_point():
        kind = getattr(given, "dtype", type(given).__name__)
        raise ValueError(f"expected a tensor of floats in linear light, got {kind}")
    if tuple(given.shape[-n_items:]) != expected:
        raise ValueError(
            f"expected a tensor of shape (..., {', '.join(map(str, expected))}), "
            f"got {tuple(given.shape)}"
        )
    batch = given.shape[:-n_items]
    arrays = given.detach().to("cpu", torch.float32).movedim(-3, -1)
    arrays = arrays.reshape(-1, *shape).contiguous().numpy()
    found = np.empty((len(arrays), *found_shape), np.float32)
    for own, array in zip(found, arrays, strict=True):
        own[...] = function(array)
    images = torch.from_numpy(found).reshape(*batch, *found_shape)
    return images.movedim(-1, -3).contiguous().to(given.device, given.dtype)


def _channels_first(shape: tuple[int, ...]) -> tuple[int, ...]:
    return (*shape[:-3], shape[-1], *shape[-3:-1])
