"""An eye given by surfaces and media, in one state or in several of its accommodation.

Between the states every number changes smoothly: along a line between two states, a
parabola through three, a cubic spline through more.  Laws that are quadratic in the
accommodation, such as that of the Arizona eye, are therefore exact with three states.
"""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from estimator.optics.surfaces import EyeSurfaces


class StatesDiffer(ValueError):
    """The states of an eye do not have the same parts."""


@dataclass(frozen=True)
class SurfaceModel:
    """Surfaces of an eye over its accommodation.

    Attributes
    ----------
    relaxed : EyeSurfaces
    accommodations_dpt : (n,)
        Nominal accommodations of the other states, ascending from above 0; they only
        place the states.
    accommodated : tuple of EyeSurfaces (n,)
        Those states, with the parts of the relaxed eye.
    """

    relaxed: EyeSurfaces
    accommodations_dpt: tuple[float, ...] = ()
    accommodated: tuple[EyeSurfaces, ...] = field(default=())

    @property
    def largest_dpt(self) -> float:
        """Return the nominal accommodation of the last state."""
        return self.accommodations_dpt[-1] if self.accommodations_dpt else 0.0

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of all numbers, with the kinds of forms and media."""
        content = self.accommodations_dpt, [_plain(eye) for eye in self._states]
        return hashlib.sha256(repr(content).encode()).hexdigest()

    @cached_property
    def _states(self) -> tuple[EyeSurfaces, ...]:
        return (self.relaxed, *self.accommodated)

    @cached_property
    def _weights(self) -> CubicSpline:
        nodes = np.array([0.0, *self.accommodations_dpt])
        return CubicSpline(nodes, np.eye(nodes.size), bc_type="not-a-knot")

    def at(self, nominal_dpt: float) -> EyeSurfaces:
        """Return the eye at a nominal accommodation.

        Raises
        ------
        StatesDiffer
            A part of a state is missing in another one, or of another kind.
        """
        return self.at_each([nominal_dpt])[0]

    def at_each(self, nominal_dpt: Sequence[float]) -> list[EyeSurfaces]:
        """Return the eyes at several nominal accommodations.

        The parts of the states are compared once, which takes most of the time.

        Raises
        ------
        StatesDiffer
            A part of a state is missing in another one, or of another kind.
        """
        if not self.accommodated:
            return [self.relaxed] * len(nominal_dpt)
        return _blended(self._states, self._weights(np.asarray(nominal_dpt)), "")


def _plain(value: Any) -> Any:
    """Return a value as lists and dicts that name the classes of its parts."""
    if dataclasses.is_dataclass(value):
        parts = {
            f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)
        }
        return {"class": type(value).__name__, **parts}
    if isinstance(value, Mapping):
        return {key: _plain(value[key]) for key in sorted(value)}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def _blended(
    values: Sequence[Any], weights: NDArray[np.float64], name: str
) -> list[Any]:
    """Return weighted sums of values, part by part: one for each row of weights."""
    first, count = values[0], len(weights)
    if any(type(value) is not type(first) for value in values):
        kinds = ", ".join(type(value).__name__ for value in values)
        raise StatesDiffer(f"{name}: differs in kind between the states ({kinds})")
    if isinstance(first, float):
        return _numbers(values, weights, name)
    if isinstance(first, np.ndarray):
        return list(np.tensordot(weights, np.stack(values), axes=1))
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        parts = {
            part.name: _part(values, weights, part.name, name)
            for part in dataclasses.fields(first)
        }
        return [
            dataclasses.replace(first, **{key: part[k] for key, part in parts.items()})
            for k in range(count)
        ]
    if isinstance(first, Mapping):
        _check_equal([sorted(value) for value in values], name)
        parts = {
            key: _blended([v[key] for v in values], weights, f"{name}.{key}")
            for key in first
        }
        return [{key: part[k] for key, part in parts.items()} for k in range(count)]
    if isinstance(first, tuple):
        _check_equal([len(value) for value in values], name)
        entries = [
            _blended(entries, weights, f"{name}[{i}]")
            for i, entries in enumerate(zip(*values, strict=True))
        ]
        return [tuple(entry[k] for entry in entries) for k in range(count)]
    _check_equal(values, name)
    return [first] * count


def _part(
    values: Sequence[Any], weights: NDArray[np.float64], part: str, name: str
) -> list[Any]:
    parts = [getattr(value, part) for value in values]
    path = f"{name}.{part}" if name else part
    if part == "radius_mm" and not np.isfinite(parts).all():
        # a surface that flattens to a plane is continuous in its curvature
        curvatures = [tuple(1.0 / r for r in radii) for radii in parts]
        return [
            tuple(1.0 / c if c else math.inf for c in blended)
            for blended in _blended(curvatures, weights, path)
        ]
    return _blended(parts, weights, path)


def _numbers(
    values: Sequence[float], weights: NDArray[np.float64], name: str
) -> list[float]:
    first = values[0]
    if all(value == first for value in values):  # exact, and inf stays inf
        return [first] * len(weights)
    if not np.isfinite(values).all():
        raise StatesDiffer(f"{name}: is given in some states only")
    return (weights @ np.array(values)).tolist()


def _check_equal(values: Sequence[Any], name: str) -> None:
    if any(value != values[0] for value in values):
        shown = ", ".join(f"{value!r:.40}" for value in values)
        raise StatesDiffer(f"{name}: differs between the states ({shown})")
