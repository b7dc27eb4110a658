"""Surface forms other than conics, biconics and offset terms, one module each.

even_asphere       even powers of the distance from the axis
two_conics         biconic with a conic constant in each meridian
toroid             conic profile revolved about an axis across it
separate_profiles  sum of two conic profiles, one along x and one along y

A form is a frozen dataclass whose fields are numbers or tuples of numbers, with

kind : str
    Its name in files.
numbers() -> tuple of float
    The parameters, at most N_FORM_NUMBERS, in the packed row from FORM_NUMBERS on.
added_curvature(curvatures) -> float
    Mean curvature at the vertex in addition to that of the radii.

To add a form, write its module and add its class to `FORMS`, the table that files and
paraxial optics use.  Write its sag and slopes as a header `form_<kind>.h` in
`estimator/native/source`, and add the function to the table of `forms.h`, in the same
order.
"""

from typing import Protocol

from estimator.optics.forms.even_asphere import EvenAsphere
from estimator.optics.forms.separate_profiles import SeparateProfiles
from estimator.optics.forms.toroid import Toroid
from estimator.optics.forms.two_conics import TwoConics


class Form(Protocol):
    """Interface of the classes in `FORMS`."""

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""


FORMS: tuple[type[Form], ...] = (EvenAsphere, TwoConics, Toroid, SeparateProfiles)
