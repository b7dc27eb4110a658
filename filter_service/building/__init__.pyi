from .jobs import BuildJob as BuildJob
from .jobs import BuildLimits as BuildLimits
from .jobs import BuiltStore as BuiltStore
from .worker_handle import WorkerHandle as WorkerHandle
