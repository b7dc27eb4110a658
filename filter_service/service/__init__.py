"""The service: one loop that owns the socket.

launch        starting: signals, the line that says it is ready
server        the loop
session       one client: its filter, its credit
frame_reply   a waiting frame and its answer
mailbox       the ROUTER socket
config        the settings file
process_info  version and memory
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
