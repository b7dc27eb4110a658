"""The service: a door with the socket, a process that filters, a keeper of both.

launch          starting: signals, the line that says it is ready
keeper          the supervisor: starts the processes, restarts those that end
child           what those processes have in common
devices         what filters side by side, as the settings name it
door_process    the process of the door
door            its loop: sessions, credit, answers while a frame is filtered
mailbox         the ROUTER socket
listening       the socket that it listens on
authenticator   the ZAP handler: numbers connections, checks their keys
connections     open connections, with a limit to their number
descriptors     file descriptors: the limit, and a reserve
dropped_parts   the rest of a message that has too many parts
rate_limit      how many messages a connection may send
served_devices  the devices as the door knows them
load            how busy one was of late
metrics         counters for Prometheus
asking          a question to a running service
reception       who comes and who goes
guests          all sessions, with a client or without
session         one client: its waiting frame, its credit, its profiles
sharing         memory that clients share
frame_desk      frames on their way, and their answers
places          whether a frame's images lie where they may
render_end      the door's end of what follows
turns           whose frame is next: fair queuing
render_process  the process that filters
render_loop     its loop
session_eyes    a filter for each eye of a session
frame_reply     a frame and its answer
frame_in_slots  with its images in shared memory
link            messages between the processes
config          the settings file
process_info    version and memory

`ocufilter.service` is a unit for systemd.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
