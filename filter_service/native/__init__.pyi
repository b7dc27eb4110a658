from .library import compiled_library as compiled_library
from .library import library_path as library_path
