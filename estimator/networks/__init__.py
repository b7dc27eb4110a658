"""Inference with the trained networks, without PyTorch; `training` trains them.

inference  cards of the networks, loading and evaluation, by ONNX Runtime
weights/   cards and ONNX files, written by `python -m training.export`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
