"""Programs to copy: the client library, scenes, a demo, benchmarks.

Importing this loads nothing but names.

    filter_client    `FilterClient`: the library
    frame_packer     a frame on its way out
    link             its side of the protocol
    connection       its socket
    shared_memory    memory that it shares with a service on the same machine
    service_process  a service of one's own
    hello            the smallest client
    batch/           data sets through people's eyes
    headset/         a scene in an OpenXR headset, each eye with its own profile
    natural          an eye that follows light and distance
    frame_log        what became of a stream's frames
    arguments          profiles, settings, sizes on command lines
    pyrender_stream  a scene through a running service
    demo             two scenes through six eyes
    latency          how long a frame takes
    socket_floor     and its bytes alone
    scenes/          two scenes, a letter chart
    report/          `ocufilter report`
    web/             a page in a browser
    figures/         figures of an eye, for reports and pages
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
