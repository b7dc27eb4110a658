"""The service: a front end with the socket, render workers, and a supervisor.

launch          startup: signals, ready message
keeper          supervisor: starts the processes and restarts those that end
child           startup code shared by these processes
devices         names of the devices that filter
door_process    main program of the front end
door            event loop of the front end: messages, frames, rate limits
mailbox         the ROUTER socket
listening       the listening socket
authenticator   ZAP handler: numbers connections and checks their keys
connections     open connections, limited in number
descriptors     file descriptors: limit and reserve
dropped_parts   removal of surplus message parts
rate_limit      rate limits of a connection
served_devices  the devices as the front end sees them
load            recent load of a device
metrics         counters for Prometheus
asking          status query to a running service
reception       start, resumption and end of sessions; their profiles
guests          all sessions, with or without a client
session         state of one client: waiting frame, credit, profiles
sharing         shared memory of clients
frame_desk      queue of frames and their replies
places          validation of a frame's positions in shared memory
render_end      render client: the front end's link to a render worker
turns           fair queuing of frames
render_process  main program of a render worker
render_loop     event loop of a render worker
session_eyes    one filter for each eye of a session
frame_reply     the reply to a frame
frame_in_slots  the same with images in shared memory
link            messages between the processes
config          settings file
process_info    version and memory of the process

`ocufilter.service` is a systemd unit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
