"""The worker process: from a profile to an eye and the nodes of its PSFs.

jobs            what is asked for and what comes back
limits          what every build keeps to
read_profile    a profile's body, checked
from_profile    the work itself
worker          the process
worker_handle   the service's end of it
inline_worker   a worker without a process
head_start      work begun before it is asked for
compile_builds  every loop compiled before the first build
helper_process  another program beside, while it is needed
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
