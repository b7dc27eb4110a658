"""Rendering: filter a frame with the PSFs of the cache.

Terms, in addition to the rendering terms of ``CONVENTIONS.md``:

- kernel: weights of one PSF in a box of pixels, for red, green and blue
- reach: distance from a kernel's center to the left, right, upper and lower side of
  its box, px
- spread: radius of the uniform disc with the same sum of squared weights, px
- node: field direction for which PSFs are cached
- tap: one cached kernel in a weighted sum of kernels, as in a filter tap
- cell: square of the image whose pixels share kernels
- interval: range between two adjacent layers; fragments interpolate linearly between
  the kernels at its two ends
- pair: a cell and an interval; each pair that a frame uses has one kernel
- merge: replace a square of 2, 4 or 8 similar pixels by one fragment
- level: binary logarithm of a merged square's edge in px, as with mipmaps
- texel, atlas: element of a kernel on the GPU; buffer or texture with the kernels of a
  frame
- block: the fragments of 8 x 8 pixels, stored together
- window: rectangle of the blocks whose fragments may reach a bin
- margin: amount that is added to a bound, against rounding

Modules:

engine           interface of the frame engines: requests, results, checks
perfect_eye      store that changes nothing, for testing engines
frame            preparation of a view: missing depth, edges, merging
image_cells      cells of the image that share kernels, and their maps
frame_states     stores of engines, with layers and cells of the last frame
frame_kernels    plan of a frame's kernels, and the PSFs that it needs
band_copies      copies of images of many bands to frames of three, and back
media_effects    effects of ocular media and spectacles; straylight
edge_kinds       bright pixels, and the edges that send their light
edge_light       light of bright pixels beyond their kernels
light_kernels    kernels of their light, its visibility and addition
tails            light of all other pixels beyond their kernels
gl/              engine of compute shaders
native/          engine of compiled loops
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
