"""The service: a front end with the socket, render workers, and a supervisor.

launch                 startup: signals, ready message
supervisor             starts the processes and restarts those that end
process_startup        startup code shared by these processes
devices                names of the devices that filter
front_end_process      main program of the front end
front_end              event loop of the front end: messages, frames, rate limits
router                 the ROUTER socket
listening_socket       the listening socket
authenticator          ZAP handler: numbers connections and checks their keys
connections            open connections, limited in number
descriptors            file descriptors: limit and reserve
dropped_parts          removal of surplus message parts
rate_limit             rate limits of a connection
served_devices         the devices as the front end sees them
load                   recent load of a device
metrics                counters for Prometheus
status_query           status query to a running service
session_manager        start, resumption and end of sessions; their profiles
session_table          all sessions, with or without a client
session                state of one client: waiting frame, credit, profiles
client_memory          shared memory of clients
frame_queue            queue of frames and their replies
image_positions        validation of a frame's positions in shared memory
render_client          the front end's link to a render worker
fair_queue             fair queuing of frames
render_worker_process  main program of a render worker
render_worker          event loop of a render worker
session_eyes           one filter for each eye of a session
frame_reply            the reply to a frame
shared_memory_frame    the same with images in shared memory
process_channel        messages between the processes
config                 settings file
process_info           version and memory of the process

`ocufilter.service` is a systemd unit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
