"""Forms of surfaces besides conics, biconics and offset terms, one file each.

base               compiled sag of a biconic and of offset terms, which forms build on
even_asphere       even powers of the distance from the axis
two_conics         biconic with a conic constant in each meridian
toroid             conic profile revolved about an axis across it
separate_profiles  sum of two conic profiles, one along x and one along y

A form is a frozen dataclass whose fields are numbers or tuples of numbers, with

kind : str
    Its name in files.
sag(packed, row, x, y, out) -> bool
    Compiled; writes z, dz/dx, dz/dy in the axes of the surface and returns whether the
    form is defined there.  It reads its numbers from column FORM_NUMBERS on.
numbers() -> tuple of float
    At most N_FORM_NUMBERS of them.
added_curvature(curvatures) -> float
    Mean curvature that the form adds at the vertex to that of the radii.

To add a form, write its file and add its class to `FORMS`: compiled code, files and
first-order optics read this table.  Delete numba's cache afterwards, which does not
notice changes in other files (`find . -name '*.nb?' -delete`).
"""

from typing import Any, ClassVar, Protocol

from estimator.optics.forms.even_asphere import EvenAsphere
from estimator.optics.forms.separate_profiles import SeparateProfiles
from estimator.optics.forms.toroid import Toroid
from estimator.optics.forms.two_conics import TwoConics


class Form(Protocol):
    """What every form of the table has."""

    sag: ClassVar[Any]

    def numbers(self) -> tuple[float, ...]:
        """Return the numbers of the packed row."""

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""


FORMS: tuple[type[Form], ...] = (EvenAsphere, TwoConics, Toroid, SeparateProfiles)
