"""An eye as a linear layer of PyTorch; requires the extra ``ocufilter[torch]``.

    from ocufilter.torch import SeeThrough

    see = SeeThrough("myopia", camera, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0)
    loss = (see(color) - target).square().mean()
    loss.backward()

Only this module and the training of the networks import PyTorch.  The service never
does.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.media import LUMINANCE
from filter_service import (
    Camera,
    EyeFilter,
    FilterError,
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

    Gray colors (..., 1, height, width) or (height, width) are the same light in all
    channels.  Their images are gray, too: the luminance of the sRGB primaries.

    Profile, pupil, focus and depth may differ for each item of a batch (n, ..., 3,
    height, width): assign sequences of n profiles, such as `EyeBank` returns, sequences
    or tensors (n,) of numbers, or depth (n, height, width).

    The methods have the names of linear operators in deepinv: ``A``, ``A_adjoint`` and
    ``A_dagger``.

    The module can be pickled and passed to workers.  Each process opens its own filter
    when it first needs it, which takes up to a second.

    Parameters
    ----------
    profile : EyeProfile, mapping, str or Path, or sequence of them
        Profile, as for `EyeFilter`.  Assign another one to the attribute of the same
        name to see through another eye.
    camera : Camera
    depth_m : (height, width) or (n, height, width) float32, RgbdView, or sequence of it
        Depth, as for `EyeFilter.operator`, or a tensor.  Assign another one to the
        attribute of the same name to filter another scene.
    pupil_diameter_mm, focus_dpt : float, scalar tensor, or (n,) of them
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
        When it is first used: a parameter is invalid (a ValueError, too).  If it is
        that of one item of a batch, the message begins with its number:
        ``samples[3].focus_dpt``.
    """

    def __init__(
        self,
        profile: Any,
        camera: Camera,
        depth_m: NDArray[Any] | torch.Tensor | RgbdView | Sequence[RgbdView],
        *,
        pupil_diameter_mm: float | Sequence[float] | torch.Tensor,
        focus_dpt: float | Sequence[float] | torch.Tensor,
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
        self._made: list[tuple[_Sample, FilterOperator]] = []
        self._opened_profile: Any = None
        self._pid = 0

    def forward(self, color: torch.Tensor) -> torch.Tensor:
        """Return the images of colors; see `A`."""
        return self.A(color)

    def A(self, color: torch.Tensor) -> torch.Tensor:  # noqa: N802
        """Return the images (..., 3, height, width) of colors, or gray ones of gray.

        Raises
        ------
        ValueError
            If the tensor has another shape, or is not real and floating-point.
        """

        def image_of(own: torch.Tensor, sample: _Sample) -> torch.Tensor:
            image = _Applied.apply(own, self._operator_of(sample, own), False)
            state = sample.pupil_diameter_mm, sample.focus_dpt
            if any(isinstance(value, torch.Tensor) for value in state):
                values = [torch.as_tensor(value) for value in state]
                image = _OfState.apply(image, own, self, sample, *values)
            return image

        return self._by_sample(color, image_of)

    def A_adjoint(self, image: torch.Tensor) -> torch.Tensor:  # noqa: N802
        """Return the transpose of the operator, applied to images.

        Raises
        ------
        ValueError
            As `A`.
        """

        def color_of(own: torch.Tensor, sample: _Sample) -> torch.Tensor:
            found: torch.Tensor = _Applied.apply(
                own, self._operator_of(sample, own), True
            )
            return found

        return self._by_sample(image, color_of)

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
        from scipy.sparse.linalg import lsqr  # loads slowly

        def color_of(own: torch.Tensor, sample: _Sample) -> torch.Tensor:
            operator = self._operator_of(sample, own)
            matrix = operator.as_linear_operator()

            def solved(array: NDArray[np.float32]) -> NDArray[np.float32]:
                found = lsqr(
                    matrix, array.ravel(), atol=tol, btol=tol, iter_lim=max_iter
                )[0]
                return found.astype(np.float32).reshape(operator.color_shape)

            return _each(own, solved, operator.image_shape, operator.color_shape)

        return self._by_sample(image, color_of)

    def operator(self, sample: int = 0) -> FilterOperator:
        """Return the operator of the depth and state, kept until these change.

        Parameters
        ----------
        sample : int
            Item of a batch, if they have parameters of their own.

        Raises
        ------
        BadMessage
            As `EyeFilter.operator`.
        """
        samples = self._samples()
        return self._operator(samples[range(len(samples))[sample]])

    def _by_sample(
        self,
        given: torch.Tensor,
        function: Callable[[torch.Tensor, _Sample], torch.Tensor],
    ) -> torch.Tensor:
        """Apply a function to a batch, or to each item with parameters of its own."""
        if not isinstance(given, torch.Tensor) or not given.is_floating_point():
            kind = getattr(given, "dtype", type(given).__name__)
            raise ValueError(f"expected a tensor of floats in linear light, got {kind}")
        if given.ndim == 2:  # gray
            return self._by_sample(given[None], function)[0]
        samples = self._samples()
        if samples[0].number is None:
            return function(given, samples[0])
        if given.ndim < 4 or len(given) != len(samples):
            raise ValueError(
                f"expected a batch of {len(samples)} items, which have parameters of "
                f"their own, got {tuple(given.shape)}"
            )
        return torch.stack(
            [function(own, one) for own, one in zip(given, samples, strict=True)]
        )

    def _samples(self) -> list[_Sample]:
        """Return the parameters of all items together, or of each item.

        Raises
        ------
        ValueError
            If they are of different numbers of items.
        """
        values = {
            "profile": self.profile,
            "depth_m": self.depth_m,
            "pupil_diameter_mm": self.pupil_diameter_mm,
            "focus_dpt": self.focus_dpt,
        }
        counts = {
            name: len(value) for name, value in values.items() if _is_many(name, value)
        }
        if len(set(counts.values())) > 1 or 0 in counts.values():
            found = ", ".join(f"{name} of {count}" for name, count in counts.items())
            raise ValueError(f"expected parameters of the same items, got {found}")

        def of_item(number: int | None) -> _Sample:
            own = {
                name: value[number] if name in counts else value
                for name, value in values.items()
            }
            if isinstance(own["depth_m"], torch.Tensor):
                own["depth_m"] = own["depth_m"].numpy(force=True)
            constant = self.gaze_deg, self.render_tolerance
            return _Sample(number, values["depth_m"], constant, **own)

        if not counts:
            return [of_item(None)]
        return [of_item(number) for number in range(next(iter(counts.values())))]

    def _operator_of(self, sample: _Sample, given: torch.Tensor) -> FilterOperator:
        """Return the operator of a sample, for gray if a given tensor is."""
        operator = self._operator(sample)
        return _GrayOperator(operator) if _is_gray(given) else operator

    def _operator(self, sample: _Sample) -> FilterOperator:
        self._leave_parent()
        for known, operator in self._made:
            if sample.is_same(known):
                return operator
        samples = self._samples()
        self._made = [  # the memory of the others goes first
            made for made in self._made if any(map(made[0].is_same, samples))
        ]
        eye_filter = self._opened(sample)
        with sample.named_errors():
            found = eye_filter.operator(
                sample.depth_m,
                pupil_diameter_mm=_number(sample.pupil_diameter_mm),
                focus_dpt=_number(sample.focus_dpt),
                gaze_deg=self.gaze_deg,
                render_tolerance=self.render_tolerance,
            )
        self._made.append((sample.plain(), found))
        return found

    def _derivatives(
        self, color: torch.Tensor, names: list[str], sample: _Sample
    ) -> dict[str, torch.Tensor]:
        """Return the derivatives of images by pupil or focus."""
        if not names:
            return {}
        is_gray = _is_gray(color)
        arrays = color.detach().to("cpu", torch.float32).movedim(-3, -1).numpy()
        if is_gray:
            arrays = np.repeat(arrays, len(LUMINANCE), axis=-1)
        with sample.named_errors():
            found = image_derivatives(
                self._opened(sample),
                np.ascontiguousarray(arrays),
                sample.depth_m,
                names,
                pupil_diameter_mm=_number(sample.pupil_diameter_mm),
                focus_dpt=_number(sample.focus_dpt),
                gaze_deg=self.gaze_deg,
                accuracy=self.accuracy,
            )
        return {
            name: torch.from_numpy(_luminance(own) if is_gray else own).movedim(-1, -3)
            for name, own in found.items()
        }

    def _leave_parent(self) -> None:
        """Forget the filter of the parent process: threads do not survive a fork."""
        if self._pid != os.getpid():
            self._forget()
            self._pid = os.getpid()

    def _opened(self, sample: _Sample) -> EyeFilter:
        """Return the filter, with the profile of a sample."""
        self._leave_parent()
        with sample.named_errors():
            if self._filter is None:
                self._filter = EyeFilter(
                    sample.profile, self.camera, self.settings, worker=self.worker
                )
            elif sample.profile is not self._opened_profile:
                self._filter.set_profile(sample.profile)
        self._opened_profile = sample.profile
        return self._filter

    def close(self) -> None:
        """Release the filter's resources; the next use opens another filter."""
        if self._filter is not None:
            self._filter.close()
        self._forget()

    def _forget(self) -> None:
        self._filter, self._made, self._pid = None, [], 0

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle, without the filter and the operator."""
        return {**self.__dict__, "_filter": None, "_made": [], "_pid": 0}


@dataclass(frozen=True, eq=False)
class _Sample:
    """Parameters of all items of a batch, or of one.

    Attributes
    ----------
    number : int or None
        Number of the item; None for all.
    depths_m : object
        Depth of all items, by which depth is identified.
    constant : tuple
        Parameters that are the same for all items.
    profile, depth_m, pupil_diameter_mm, focus_dpt : object
        As for `SeeThrough`, of this item.
    """

    number: int | None
    depths_m: Any
    constant: tuple[Any, ...]
    profile: Any
    depth_m: Any
    pupil_diameter_mm: Any
    focus_dpt: Any

    def is_same(self, other: _Sample) -> bool:
        """Return whether another sample has the same operator."""
        is_own_depth = self.depth_m is not self.depths_m
        return (
            self.profile is other.profile
            and self.depths_m is other.depths_m
            and (not is_own_depth or self.number == other.number)
            and self.constant == other.constant
            and _number(self.pupil_diameter_mm) == _number(other.pupil_diameter_mm)
            and _number(self.focus_dpt) == _number(other.focus_dpt)
        )

    def plain(self) -> _Sample:
        """Return the sample with numbers instead of tensors, which may change."""
        return replace(
            self,
            pupil_diameter_mm=_number(self.pupil_diameter_mm),
            focus_dpt=_number(self.focus_dpt),
        )

    @contextmanager
    def named_errors(self) -> Iterator[None]:
        """Add the number of the item to errors."""
        try:
            yield
        except (FilterError, ValueError) as error:
            if self.number is None:
                raise
            where = f"samples[{self.number}]"
            if not isinstance(error, FilterError):
                raise ValueError(f"{where}: {error}") from error
            field = where if error.field is None else f"{where}.{error.field}"
            raise type(error)(
                error.message, field=field, allowed=error.allowed
            ) from error


def _is_many(name: str, value: Any) -> bool:
    """Return whether a parameter has a value for each item of a batch."""
    if isinstance(value, torch.Tensor | np.ndarray):
        return value.ndim == (3 if name == "depth_m" else 1)
    # a sequence of depths is one of views, which are filtered together
    return (
        name != "depth_m" and isinstance(value, Sequence) and not isinstance(value, str)
    )


def _is_gray(given: torch.Tensor) -> bool:
    return given.ndim > 2 and given.shape[-3] == 1


def _luminance(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the luminance (..., 1) of images (..., 3)."""
    weighed = image * np.array(LUMINANCE, np.float32)
    found: NDArray[np.float32] = weighed.sum(axis=-1, keepdims=True)
    return found


class _GrayOperator(FilterOperator):
    """The luminance of the images of gray colors."""

    def __init__(self, operator: FilterOperator) -> None:
        self._operator = operator
        self.color_shape = (*operator.color_shape[:-1], 1)
        self.image_shape = (*operator.image_shape[:-1], 1)
        self.shape = math.prod(self.image_shape), math.prod(self.color_shape)

    def forward(self, color: ArrayLike) -> NDArray[np.float32]:
        """Return the image (..., 1) of a color (..., 1)."""
        channels = np.repeat(np.asarray(color), len(LUMINANCE), axis=-1)
        return _luminance(self._operator.forward(channels))

    def adjoint(self, image: ArrayLike) -> NDArray[np.float32]:
        """Return the transpose of the operator times an image (..., 1)."""
        weighed = np.asarray(image) * np.array(LUMINANCE, np.float32)
        found: NDArray[np.float32] = self._operator.adjoint(weighed).sum(
            axis=-1, keepdims=True
        )
        return found


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
        sample: _Sample,
        *_state: torch.Tensor,
    ) -> torch.Tensor:
        ctx.see, ctx.sample = see, sample.plain()
        ctx.save_for_backward(color)
        return image.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[Any, ...]:
        needed = [
            name
            for name, is_needed in zip(STATE, ctx.needs_input_grad[4:], strict=True)
            if is_needed
        ]
        found = ctx.see._derivatives(ctx.saved_tensors[0], needed, ctx.sample)
        by_state = [
            (found[name].to(gradient) * gradient).sum() if name in found else None
            for name in STATE
        ]
        return gradient, None, None, None, *by_state


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
    if tuple(given.shape[-n_items:]) != expected:
        sizes = ", ".join(map(str, expected))
        raise ValueError(
            f"expected a tensor of shape (..., {sizes}), got {tuple(given.shape)}"
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
