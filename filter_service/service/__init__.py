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

supervisor           startup; starts the processes and restarts those that exit
config               settings file, with the names of devices
process_channel      messages between the processes; their startup and memory
front_end            event loop of the front end: messages, frames; its main program
router               the ROUTER socket: authentication, removal of surplus parts
connections          open connections: their number, rate and descriptors; the listener
served_devices       the front end's state of each device
session_manager      start, resumption and end of sessions; their profiles
session              state of one client: queued frame, credit, profiles; all sessions
client_memory        shared memory and shared textures of clients
frame_queue          fair queuing of frames, and their replies
render_client        the front end's link to a render worker; positions of images
metrics              counters for Prometheus
status_query         status query to a running service
render_worker_process  main program of a render worker
render_worker        event loop of a render worker
profile_reader       the process that reads large profiles
session_eyes         one filter for each eye of a session
frame_reply          the reply to a frame

`ocufilter.service` is a systemd unit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
