"""Client library, command line, and the programs behind its commands.

The package imports its modules only when their names are used.

    filter_client    `FilterClient`: the client library
    frame_packer     packing of frames for the wire
    link             client side of the protocol
    connection       socket of the client
    shared_memory    images in memory shared with a service on the same machine
    service_process  service in a child process
    hello            minimal client
    batch/           `ocufilter batch`: offline filtering of data sets
    stimuli/         optotypes, gratings, noise and text of exact angular size
    headset/         `ocufilter headset`: a scene in an OpenXR headset
    natural_eye      eye whose pupil and focus follow light and distance
    provenance       version, profile and state of the eye in the metadata of pictures
    frame_log        statistics of streams
    latency/         latency of frames through a running service
    pyrender_stream  streaming of a scene through a running service
    pyrender_renderer  frames of pyrender scenes, and of files that trimesh loads
    demo             `ocufilter demo`: two scenes through six eyes
    scenes/          scenes, a letter chart, and their rendering
    scenarios        two states of one person in a scene, such as with two lenses
    report/          `ocufilter report`
    commands/        command line `ocufilter`
    web/             `ocufilter web`: a page in a browser
    figures/         figures of an eye, for reports and web pages
    version          version of the installed package
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
