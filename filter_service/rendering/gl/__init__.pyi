from .compile_passes import compile_passes as compile_passes
from .renderer import FilterRenderer as FilterRenderer
