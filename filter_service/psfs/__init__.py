"""PSFs at the nodes of a plan: computed on demand, packed, interpolated for frames.

eye_for_spec     the eye of a profile over the ranges of a cache
compute_kernels  from nodes to packed kernels; choice of the engine
native_psfs      the engine in C
pack             kernels cropped to boxes, in 16 bits, and tables
store            the PSFs of an eye
frame_layers     interpolation for a state, and the layers of a frame
exact_store      PSFs of a single state, for frames with a render tolerance of 0
frozen_store     PSFs of a single state in 32 bits, for derivatives
field_defocus    change of defocus over the field
store_cache      on-disk cache of eyes and nodes, its folder and contents
store_file       file format of the on-disk cache
picture          image of a kernel

The terms of `filter_service.planning` apply here too.  The others are:

kernel
    A PSF integrated over pixels and cropped to a box, with unit sum.  The store holds
    its weights in 16 bits, in steps of the largest weight.
reach
    The extent of a kernel's box: the columns left and right of the center element, and
    the rows above and below it.
rings
    Zones of a diffractive, multifocal or lenslet correction.  They multiply the pupil
    function by a complex amplitude, which depends on the distance from the nearest
    center.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
