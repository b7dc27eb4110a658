"""The ray tracer of `estimator` over batches of eyes, differentiable, on any device.

`circle.zernike_of_eyes` is what losses need: the coefficients on the axis, on a given
circle.

The eye and its chief ray are always float64; ``ray_dtype`` is that of the bundle.
Rays are solved without a graph. Gradients come from Fermat's principle on axis, and
from one Newton step through the graph elsewhere; second derivatives are not available.
Automatic mixed precision must be off around all of it.
"""
