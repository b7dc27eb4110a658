"""What people wear to see better, as what it does to light in the entrance pupil.

worn_lens         a lens on or in the eye: power, its own aberration, where it sits
rings             several foci at once: diffractive rings, refractive zones
kinoform          light in the orders of a diffractive profile, by scalar theory
lens_plane        where on a spectacle lens one looks through
lenslets          spectacles with lenslets around a clear middle
progressive       spectacles whose power changes with the direction of gaze
intraocular       from the plane of an intraocular lens to that of the pupil
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
