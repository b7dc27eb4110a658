"""The filter: pictures through a person's eye, in process or as a service.

Importing this loads nothing but names: clients stay light.

    settings         every setting of a filter, once
    displays         the wavelengths of red, green and blue
    camera           a pinhole, and which cameras share PSFs
    rgbd_view        colour, depth and camera of one view
    view_state       through whose eye it is seen
    messages         the wire protocol's types (PROTOCOL.md)
    protocol_schema  their headers as JSON Schema
    errors           the exceptions
    keys             who may connect from other machines
    slots            memory that processes share
    log_lines        the service's log
    checked          values against annotated types
    progress         how far long work is, said on stderr
    constants        numbers that Python and GLSL share
    image_files      pictures and depth in files
    whole_files      files that are written as a whole or not at all
    bounded_images   the decoders, within limits of memory
    gl_device        which device OpenGL works on, as a user names it
    threads          numba's thread layer
    one_blas_thread  numpy on one thread
    gl/              the OpenGL context and its shaders
    native/          loops in C
    planning/        which PSFs an eye needs for a stated error
    psfs/            the PSF cache: built, packed, kept
    rendering/       from a frame and the cache to the picture
    building/        the worker process that makes caches
    filtering/       `EyeFilter`: streams of frames through eyes
    wire/            messages, field by field
    service/         sockets, sessions and the loop
    commands/        the command line
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
