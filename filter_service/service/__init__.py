"""The service: filters frames for clients on one ZeroMQ socket.

It runs as several processes:

- The *front end* owns the socket and the sessions.  It validates messages, limits their
  rate and schedules frames.
- Each *device*, a GPU or the processor, has a *render worker*, which owns the eyes of
  its sessions and filters their frames.
- The *supervisor* starts these processes and restarts those that exit.

A *session* is the state of one client: its credit (the number of frames that it may
have unanswered), the profiles of its eyes, and its shared memory, in *slots*.  It
belongs to one device, and can be resumed for `session_keep_s` after a disconnect.

launch                 startup: signals, ready message
supervisor             starts the processes and restarts those that exit
process_startup        startup code shared by these processes
devices                device names in the settings
front_end_process      main program of the front end
front_end              event loop of the front end: messages, frames, rate limits
router                 the ROUTER socket
listening_socket       the listening socket
authenticator          ZAP handler: numbers connections and checks their keys
connections            open connections, limited in number
descriptors            file descriptors: limit and reserve
dropped_parts          removal of surplus message parts
rate_limit             rate limits of a connection
served_devices         the front end's state of each device
load                   recent load of a device
metrics                counters for Prometheus
status_query           status query to a running service
session_manager        start, resumption and end of sessions; their profiles
session_table          all sessions, with or without a client
session                state of one client: queued frame, credit, profiles
client_memory          shared memory of clients
client_textures        textures of clients
texture_socket         datagram socket for their descriptors
frame_queue            queue of frames and their replies
image_positions        validation of a frame's positions in shared memory
render_client          the front end's link to a render worker
fair_queue             fair queuing of frames
render_worker_process  main program of a render worker
render_worker          event loop of a render worker
profile_reader         the process that reads large profiles
session_eyes           one filter for each eye of a session
frame_reply            the reply to a frame
shared_memory_frame    the same, with images in shared memory
texture_frame          the same, with images in textures
process_channel        messages between the processes
config                 settings file
process_info           memory of the process

`ocufilter.service` is a systemd unit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
