"""Corrections of the eye, by their effect on light in the entrance pupil.

worn_lens         lens on or in the eye: power, own aberration, position
rings             simultaneous foci: diffractive rings, refractive zones
kinoform          light in the orders of a diffractive profile, by scalar theory
lens_plane        point of a spectacle lens that the line of sight crosses
lenslets          spectacles with lenslets around a clear center
progressive       spectacles whose power changes with the direction of gaze
intraocular       conversion from the plane of an intraocular lens to the pupil
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
