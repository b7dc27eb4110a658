"""Corrections of the eye, by their effect on light in the entrance pupil.

worn_lens         contact and intraocular lenses, and the wavefront of any correction
rings             multifocal lenses: diffractive rings, refractive zones, lenslets
progressive       progressive spectacles, and where the line of sight crosses a lens

A *correction* is a `Prescription` or one of its subclasses here, given in the plane of
the device: spectacles at the *vertex distance* ``vertex_mm`` in front of the cornea, a
contact lens on it, an intraocular lens behind it.  Single-vision lenses, and the
carrier of lenslets, are polynomials that are subtracted from the wavefront in the
entrance pupil.  *Rings* are the complex amplitude that a multifocal lens adds to them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
