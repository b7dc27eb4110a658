"""Surface forms other than conics, biconics and offset terms.

To add a form, write its class and add it to `FORMS`, the table that files and paraxial
optics use.  Write its sag and slopes as a header `form_<kind>.h` in
`estimator/native/source`, and add the function to the table of `forms.h`, in the same
order.
"""

from dataclasses import dataclass
from typing import ClassVar


class Form:
    """A form: its kind in files, its parameters, and its curvature at the vertex.

    Subclasses are frozen dataclasses whose fields are numbers or tuples of numbers.
    """

    kind: ClassVar[str]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row.

        They are at most N_FORM_NUMBERS, from column FORM_NUMBERS on.
        """
        return ()

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, added to the curvature of the radii."""
        del curvatures
        return 0.0


@dataclass(frozen=True)
class EvenAsphere(Form):
    """z = biconic + a2 r² + a4 r⁴ + a6 r⁶ + ...

    Attributes
    ----------
    coefficients : tuple of at most 12 floats
        (a2, a4, ...), in mm^(1-n) for r^n, as for the Even Asphere of Zemax.
    """

    kind: ClassVar[str] = "even_asphere"

    coefficients: tuple[float, ...]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.coefficients

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 2.0 * self.coefficients[0] if self.coefficients else 0.0


@dataclass(frozen=True)
class SeparateProfiles(Form):
    """z = p(x; Rx, kx) + p(y; Ry, ky) with conic profiles p.

    Attributes
    ----------
    conic_constants : (kx, ky)
        They replace the conic constant of the surface.
    """

    kind: ClassVar[str] = "separate_profiles"

    conic_constants: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.conic_constants


@dataclass(frozen=True)
class Toroid(Form):
    """z = Rx - sqrt((Rx - p(y))² - x²), p the conic of radius Ry, as in Zemax.

    The radii and the conic constant are attributes of the surface.
    """

    kind: ClassVar[str] = "toroid"


@dataclass(frozen=True)
class TwoConics(Form):
    """z = (cx x² + cy y²) / (1 + sqrt(1 - (1+kx) cx² x² - (1+ky) cy² y²)), c = 1 / R.

    An ellipsoid with the semi-axes ax, ay and az has the radii ax² / az and ay² / az
    and the conic constants ax² / az² - 1 and ay² / az² - 1.

    Attributes
    ----------
    conic_constants : (kx, ky)
        They replace the conic constant of the surface.
    """

    kind: ClassVar[str] = "two_conics"

    conic_constants: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.conic_constants


FORMS: tuple[type[Form], ...] = (EvenAsphere, TwoConics, Toroid, SeparateProfiles)
