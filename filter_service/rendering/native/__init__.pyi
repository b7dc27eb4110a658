from .library import library as library
from .library import library_path as library_path
from .renderer import NativeRenderer as NativeRenderer
