"""The trained networks; PyTorch is needed only in `training`.

card       cards of the networks: columns, ranges, error
inference  loading and evaluation
weights    the files that `python -m training.export` writes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
