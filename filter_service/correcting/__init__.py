"""Pictures solved for a viewer, and lenses for scenes.

correction   `correct`: target, viewers and their states, and the solved picture
lens_search  `best_lens`: the lens with which scenes are nearest to their targets
lens_scene   scenes for a lens, their states, and the error of their images
solver       the picture whose images through linear operators are nearest to targets
sensitivity  differences weighted by neural contrast sensitivity
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
