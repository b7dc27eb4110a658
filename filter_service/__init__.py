"""The filter: computes the retinal image of RGB-D frames, in process or as a service.

`EyeFilter` filters in process; `service` serves clients by the wire protocol.
Importing this package loads no submodules, which keeps clients light.

    settings         definition of every setting of a filter
    displays         wavelengths and spectra of red, green and blue
    camera           pinhole camera, and which cameras share PSFs
    rgbd_view        color, depth and camera of one view
    texture_view     the same in textures of the caller
    filter_protocol  common protocol of `EyeFilter` and `clients.FilterClient`
    view_state       state of an eye; eye and state of a view
    given_profile    profiles as programs give them
    stage_times      times of a frame's stages
    messages         types of the wire protocol (PROTOCOL.md)
    protocol_schema  JSON Schema of the message headers
    errors           exceptions
    keys             keys of clients on other machines
    shared_memory    shared memory for images
    heap             memory of a process, and freed memory returned to the system
    log_lines        log of the service
    validation       validation of values against annotated types
    progress         progress of long tasks on stderr
    waiting          waits that report progress, with a limit of the time without it
    constants        constants shared by Python and GLSL
    image_files      color and depth files; .npy files within limits
    atomic_files     atomic file writes
    pictures         colors and depth of pictures, PGM and PPM, upright and in sRGB
    exr_files        OpenEXR files
    band_files       images of many wavelengths: ENVI, .npy, .mat
    bounded_images   image decoders with memory limits
    color_encoding   color profiles and codes, and conversion to sRGB
    peripheral_resolution  detail that the retina could resolve
    gl_device        selection of the OpenGL device
    command_line     shared parts of commands: start, output, errors, numbers
    serve            `ocufilter serve`
    version          version of the installed package
    one_blas_thread  NumPy's BLAS on one thread
    blas_threads     the same for a while
    gl/              OpenGL context and shaders
    native/          compiled loops in C
    planning/        PSFs that an eye needs for a given error
    psfs/            the PSF cache
    rendering/       the renderer: from a frame and PSFs to the output image
    building/        the build worker, which estimates eyes
    filtering/       `EyeFilter`: streams of frames, in process
    correcting/      pictures solved for a viewer
    wire/            the types of messages
    service/         front end, render workers and supervisor
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
