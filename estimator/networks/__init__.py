"""The trained networks; torch and training live elsewhere.

card       what a network's card says: columns, ranges, error
inference  loading and asking them
weights    the files that `python -m training.export` writes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
