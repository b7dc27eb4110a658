"""The build worker: a process that estimates eyes and plans the nodes of their PSFs.

A *build* turns a profile, settings and a camera into a *store*: the estimated eye and
the nodes (states of pupil and focus, field directions, defocus) of its PSFs.  A
*ticket* identifies a build.

jobs                requests, limits and results of the worker
from_profile        the build itself
eye_bank            prebuilt eyes on disk
worker              main program of the worker process
worker_handle       starts the process, queues builds, recovers from crashes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
