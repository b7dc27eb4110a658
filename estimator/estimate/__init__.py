"""Estimation of an eye from a measurement.

estimation         entry point: refined, by network, or by pattern search
given_surfaces     an eye that a profile gives by its surfaces
problem            compared coefficients and the model of them
prior              prior distribution of eyes, by refraction
bounded_fit        least squares with bounds
plausible          properties of an eye that are unusual in people
measured_residual  residual of the estimate, kept as a phase
table              start eyes of a fit
eye_table.json  the table
network_guess      start eye from the eye network
pattern_search     pattern search of the earlier work
plot               plot of an estimated eye
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
