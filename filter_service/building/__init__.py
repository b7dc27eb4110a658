"""Builder: the worker process that turns profiles into eyes and nodes of their PSFs.

jobs                requests and results of the worker
limits              limits of every build
read_profile        validation of a profile's body
from_profile        the build itself
worker              main program of the worker process
worker_handle       the service's interface to the worker process
inline_worker       a worker without a process
background_warm_up  warm-up before the first build
compile_builds      compilation of all loops before the first build
helper_process      subprocesses that end with their parent
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
