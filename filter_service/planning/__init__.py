"""Planner of the PSF cache: the nodes that an eye needs for a given error.

grid              specification of a cache, and limits on its nodes
field_directions  directions of an image's pixels
sampled_use       sampled states of frames, and their interpolation errors
slopes            ray slopes over a pupil, by which PSFs are compared
error_law         image error of blending two PSFs
readable          defocus that frames read at a node
axis_nodes        nodes along one axis
defocus_nodes     nodes of defocus, group by group
spread_loops      compiled loops of defocus_nodes
node_wavefronts   wavefronts of the field nodes in one state
node_blur         geometric blur of nodes
blur_loops        compiled loop of node_blur
nodes             a plan, and interpolation between its nodes
paper_grid        the paper's fixed grids as plans
cost              memory and build time of a plan
plan              entry point of the package
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
