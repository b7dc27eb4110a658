from .library import PATH as PATH
from .library import Loops as Loops
from .library import loops as loops
