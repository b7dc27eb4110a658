from .jobs import BuildJob as BuildJob
from .jobs import BuiltStore as BuiltStore
from .jobs import LookAt as LookAt
from .limits import BuildLimits as BuildLimits
from .worker_handle import WorkerHandle as WorkerHandle
