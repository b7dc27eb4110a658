"""Rendering: filter a frame with the PSFs of the cache.

engine           interface of the frame engines
request_checks   checks of a request against its store
filtered_view    result of a frame, for all engines
white_level      reference light for contrast
perfect_eye      store that changes nothing, for testing engines
frame            preparation of a view: filled depth, extended edges
gaze             gaze of a frame, clamped to the prepared range
image_cells      cells of the image that share kernels
cell_maps        maps from their pixels to those of stored kernels
map_loops        compiled loops of cell_maps
frame_states     state kept while pupil, focus and gaze do not change
frame_use        request of a frame, and the PSFs that it needs
frame_kernels    recipes of a frame's kernels
kernel_loops     compiled loops of frame_kernels
kernel_tables    kernel records in the layout of the passes
table_loops      compiled loops of kernel_tables
pair_loops       kernels that a frame uses, and those predicted for the next
srgb             conversion between encoded images and linear light
media_effects    effects of ocular media and spectacles
haze             straylight of the ocular media
haze_loops       compiled loops of haze
spectacles       spectacle magnification
spectacle_loops  compiled loop of spectacles
plan_once        warm-up of frame planning
gl/              engine of compute shaders
native/          engine of compiled loops
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
