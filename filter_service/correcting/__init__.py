"""Pictures solved for a viewer, whose own eye turns them into what was meant.

correction   `correct`: target, viewers and their states, and the solved picture
solver       the picture whose images through linear operators are nearest to targets
sensitivity  differences weighted by neural contrast sensitivity
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
