from .library import PATH as PATH
from .library import Core as Core
from .library import Library as Library
from .library import LibraryUnavailable as LibraryUnavailable
from .library import core as core
from .library import in_use as in_use
from .library import selected as selected
from .library import shared_threads as shared_threads
