"""Estimation of an eye from a measurement.

estimation         entry point: refined, by network, or by pattern search
given_surfaces     an eye that a profile gives by its surfaces
surgery            an estimated eye with an implant, or with a new front of its cornea
model              the eye of any profile
problem            prior, compared coefficients, and the pattern search of earlier work
bounded_fit        least squares with bounds
measured_residual  residual of the estimate, kept as a phase
eye_table.json     start eyes of a fit
biometry           lengths and powers of an eye
plot               plot of an estimated eye
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
