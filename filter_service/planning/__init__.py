"""Which PSFs an eye needs for a stated error.

grid              what a cache is for, and where its nodes may lie
field_directions  directions of an image's pixels
sampled_use       what frames will ask for, sampled
slopes            ray slopes over a pupil, which PSFs differ by
error_law         what blending two PSFs costs
readable          defocus that frames read at a node
axis_nodes        nodes along one axis
defocus_nodes     nodes of defocus, group by group
spread_loops      their compiled loop
node_wavefronts   wavefronts of a state's field nodes
node_blur         geometric blur of nodes
blur_loops        its compiled loop
nodes             a plan, and reading between its nodes
paper_grid        the paper's fixed grids as plans
cost              memory and time of a plan
plan              the entry
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
