"""An eye given by surfaces that focuses by changing between the states of its profile.

Light is traced through the surfaces as they are: no typical aberration, periphery or
chromatic correction is added.

A profile gives the surfaces and media in one state or in several of accommodation.
Between the states every number changes smoothly: along a line between two states, a
parabola through three, a cubic spline through more.  Formulas that are quadratic in
the accommodation, as in the Arizona eye, are therefore exact with three states.
"""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.accommodation import (
    N_FOCUS,
    N_TABLE,
    ResidualPhase,
    TabulatedFocusing,
)
from estimator.eye.focusing import FocusedSurfaces, FocusTable, table_pupils_mm
from estimator.eye.tracing import TraceFailed, refraction_of_packed, seen_refraction_dpt
from estimator.optics import prescription as rx
from estimator.optics.interpolation import CubicSpline
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.raytrace import obstruction
from estimator.optics.surfaces import EyeSurfaces, media_indices, pack_eye
from estimator.optics.units import REFERENCE_WAVELENGTH_NM


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
        return CubicSpline(nodes, np.eye(nodes.size))

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
    match value:
        case Mapping():
            return {key: _plain(value[key]) for key in sorted(value)}
        case tuple():
            return [_plain(entry) for entry in value]
        case np.ndarray():
            return value.tolist()
        case _ if dataclasses.is_dataclass(value):
            names = [part.name for part in dataclasses.fields(value)]
            parts = {name: _plain(getattr(value, name)) for name in names}
            return {"class": type(value).__name__, **parts}
    return value


def _blended(
    values: Sequence[Any], weights: NDArray[np.float64], name: str
) -> list[Any]:
    """Return weighted sums of values, part by part: one for each row of weights."""
    first, count = values[0], len(weights)
    if any(type(value) is not type(first) for value in values):
        kinds = ", ".join(type(value).__name__ for value in values)
        raise StatesDiffer(f"{name}: differs in kind between the states ({kinds})")
    match first:
        case float():
            return _numbers(values, weights, name)
        case np.ndarray():
            return list(np.tensordot(weights, np.stack(values), axes=1))
        case Mapping():
            _check_equal([sorted(value) for value in values], name)
            parts = {
                key: _blended([v[key] for v in values], weights, f"{name}.{key}")
                for key in first
            }
            return [{key: part[k] for key, part in parts.items()} for k in range(count)]
        case tuple():
            _check_equal([len(value) for value in values], name)
            entries = [
                _blended(entries, weights, f"{name}[{i}]")
                for i, entries in enumerate(zip(*values, strict=True))
            ]
            return [tuple(entry[k] for entry in entries) for k in range(count)]
        case _ if dataclasses.is_dataclass(first) and not isinstance(first, type):
            parts = {
                part.name: _part(values, weights, part.name, name)
                for part in dataclasses.fields(first)
            }
            return [
                dataclasses.replace(first, **{n: part[k] for n, part in parts.items()})
                for k in range(count)
            ]
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


def _entrance_pupil_mm(eye: EyeSurfaces) -> float:
    return entrance_pupil_mm(eye, wavelength_nm=REFERENCE_WAVELENGTH_NM)


class SurfaceEye(TabulatedFocusing[FocusedSurfaces]):
    """An eye given by surfaces that can focus, at any pupil.

    Parameters
    ----------
    rest : ResidualPhase, optional
        Phase added to the traced eye.

    Raises
    ------
    TraceFailed
        Light does not pass the relaxed eye.
    """

    def __init__(
        self,
        model: SurfaceModel,
        *,
        pupil_diameter_mm: float = 4.0,
        amplitude_dpt: float = math.inf,
        correction: rx.Prescription | None = None,
        rest: ResidualPhase | None = None,
    ):
        self._rest = rest
        self.model = model
        self.pupil_diameter_mm = pupil_diameter_mm
        self.entrance_pupil_mm = _entrance_pupil_mm(model.relaxed)
        if not math.isfinite(self.entrance_pupil_mm):
            raise TraceFailed("the eye has no entrance pupil: the stop images to none")
        count = N_TABLE if model.accommodated else 1
        self._tabulate(
            np.linspace(0.0, model.largest_dpt, count),
            correction=correction,
            amplitude_dpt=amplitude_dpt,
        )

    def _obstruction(self, pupil_diameter_mm: float) -> str:
        reason = obstruction(
            self.model.relaxed,
            radius_mm=pupil_diameter_mm / 2.0,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )
        return f" ({reason})" if reason else ""

    def _refractions_dpt(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        eyes = [self.model.at(nominal_dpt) for nominal_dpt in nodes.tolist()]
        return refraction_of_packed(
            np.stack([pack_eye(eye) for eye in eyes]),
            np.stack([media_indices(eye, REFERENCE_WAVELENGTH_NM) for eye in eyes]),
            pupil_z_mm=[_entrance_pupil_mm(eye) for eye in eyes],
            pupil_diameter_mm=self.pupil_diameter_mm,
        )

    def _new_focus_table(self) -> FocusTable:
        """Trace the table."""
        pupils_mm = np.array(table_pupils_mm(self.pupil_diameter_mm))
        some = np.unique(np.linspace(0, self._nodes.size - 1, N_FOCUS).astype(int))
        columns = []
        for nominal_dpt in self._nodes[some].tolist():
            eye = self.model.at(nominal_dpt)
            columns.append(
                seen_refraction_dpt(
                    np.repeat(pack_eye(eye)[None], pupils_mm.size, axis=0),
                    media_indices(eye, REFERENCE_WAVELENGTH_NM),
                    pupil_z_mm=_entrance_pupil_mm(eye),
                    pupil_diameter_mm=pupils_mm,
                )
            )
        found_dpt = np.stack(columns, axis=1)
        if not np.isfinite(found_dpt).all(axis=1).any():
            raise TraceFailed(
                f"light does not fill a pupil of {pupils_mm[0]:g} mm in every state"
                + self._obstruction(pupils_mm[0])
            )
        return FocusTable(pupils_mm, self._accommodations_dpt[some], found_dpt)

    def states_at(self, accommodations_dpt: ArrayLike) -> Sequence[FocusedSurfaces]:
        """Return states (P,) at accommodations within the amplitude.

        Their ``focus_dpt`` is the focus through the eye's own pupil.
        """
        wanted_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
        return [
            FocusedSurfaces(
                surfaces=self.model.at(nominal_dpt),
                focus_dpt=self.sharpest_dpt(
                    accommodation_dpt, pupil_diameter_mm=self.pupil_diameter_mm
                ),
                accommodation_dpt=accommodation_dpt,
                notes=(),
            )
            for nominal_dpt, accommodation_dpt in zip(
                self._nodes_at(wanted_dpt).tolist(), wanted_dpt.tolist(), strict=True
            )
        ]
