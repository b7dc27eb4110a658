"""Surface forms other than conics, biconics and offset terms, one module each.

base               compiled sag of a biconic and of offset terms
even_asphere       even powers of the distance from the axis
two_conics         biconic with a conic constant in each meridian
toroid             conic profile revolved about an axis across it
separate_profiles  sum of two conic profiles, one along x and one along y

A form is a frozen dataclass whose fields are numbers or tuples of numbers, with

kind : str
    Its name in files.
sag(packed, row, x, y, out) -> bool
    Compiled function that writes z, dz/dx, dz/dy in the axes of the surface and returns
    whether the form is defined at (x, y).  Its parameters start at column FORM_NUMBERS.
numbers() -> tuple of float
    The parameters, at most N_FORM_NUMBERS.
added_curvature(curvatures) -> float
    Mean curvature at the vertex in addition to that of the radii.

To add a form, write its module and add its class to `FORMS`, the table that compiled
code, files and paraxial optics use.  Afterwards delete numba's cache, which does not
detect changes in other files (`find . -name '*.nb?' -delete`).
"""

from typing import Any, ClassVar, Protocol

from estimator.optics.forms.even_asphere import EvenAsphere
from estimator.optics.forms.separate_profiles import SeparateProfiles
from estimator.optics.forms.toroid import Toroid
from estimator.optics.forms.two_conics import TwoConics


class Form(Protocol):
    """Interface of the classes in `FORMS`."""

    sag: ClassVar[Any]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""


FORMS: tuple[type[Form], ...] = (EvenAsphere, TwoConics, Toroid, SeparateProfiles)
