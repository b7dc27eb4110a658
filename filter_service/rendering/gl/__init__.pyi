from .renderer import FilterRenderer as FilterRenderer
from .renderer import compile_passes as compile_passes
