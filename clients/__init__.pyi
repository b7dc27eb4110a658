from . import stimuli as stimuli
from .filter_client import FilterClient as FilterClient
from .filter_client import FilteredFrame as FilteredFrame
from .service_process import ServiceProcess as ServiceProcess
from .version import __version__ as __version__
