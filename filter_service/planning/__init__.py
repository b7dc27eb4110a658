"""Planner of the PSF cache: the nodes that an eye needs for a given error.

grid              specification of a cache, its limits and field directions
state_samples     sampled states of frames, and the law of errors
defocus_nodes     nodes of defocus, their blur, and the paper's grid
node_wavefronts   wavefronts of the field nodes in one state; slopes
nodes             a plan, its neighbors, and the nodes that frames read
cost              memory and build time of a plan
plan              entry point of the package; nodes of the other axes

Terms
-----
axes
    The variables that PSFs are interpolated in: azimuth h and elevation v of the field
    direction, pupil diameter, accommodation and total defocus.
state
    A pupil diameter and an accommodation of the eye.  In `PupilStates`, a state also
    has a field direction, a wavelength and a total defocus.
node
    A value on an axis at which PSFs are computed.  Without an axis, the word means a
    node of total defocus.
interval
    The range between two neighboring nodes of an axis.
group
    The nodes of total defocus of one field direction in one state.
PSF index
    Node n and channel c (red, green, blue) have the PSF with the index 3 n + c.
readable range
    The total defocus that frames read in a group.  Nodes cover this range only.
limited group
    A group that ends before its readable range does, where the blur reaches the radius
    of the largest kernel.
layer
    An object vergence for which a frame interpolates its own PSFs.
focus
    The object distance that the eye looks at.  A lens with several foci has one for
    each of its powers: the total defocus at which its light is sharp.
slopes
    Gradients of a wavefront at sample points of the pupil, in px: the landing points of
    rays relative to the chief ray.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
