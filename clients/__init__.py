"""The client library, the command line, and the programs of its commands.

Importing this package loads nothing but names.

    filter_client    `FilterClient`: the client library
    frame_packer     packing of frames for the wire
    link             the client's side of the protocol
    connection       the client's socket
    shared_memory    memory shared with a service on the same machine
    service_process  a service in a child process
    hello            a minimal client
    batch/           `ocufilter batch`: data sets filtered offline
    headset/         a scene in an OpenXR headset, each eye with its own profile
    natural_eye      pupil and focus that follow light and distance
    frame_log        statistics of a stream's frames
    arguments        profiles, settings and sizes on command lines
    pyrender_stream  a scene streamed through a running service
    demo             two scenes through six eyes
    scenes/          two scenes and a letter chart
    report/          `ocufilter report`
    commands/        the command line, `ocufilter`
    web/             `ocufilter web`: a page in a browser
    figures/         figures of an eye, for reports and web pages
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
