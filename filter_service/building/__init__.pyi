from .jobs import BuildJob as BuildJob
from .jobs import BuiltStore as BuiltStore
from .limits import BuildLimits as BuildLimits
from .worker_handle import WorkerHandle as WorkerHandle
