"""From a measurement to the eye behind it.

estimation      the entry: refined, by network, or searched
problem         what is compared, and the model that answers
prior           eyes as people have them, by their refraction
bounded_fit     least squares within bounds
plausible       what of the eye would be unusual in a person
measured_rest   what the eye leaves of its measurement: a phase
table           eyes at which fits start
make_table      the program that makes them
eye_table.json  what it wrote
network_guess   the eye network's start
pattern_search  the search of the earlier work
plot            a picture of an estimated eye
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
