"""From a frame and the cache to the filtered picture.

engine         what every frame engine offers
frame_options  what a frame asks for, checked
filtered_view  what every engine answers
white_level    light against which contrast counts
perfect_eye    a store that changes nothing, to try engines with
frame          a view made ready: depth filled, colour finite
gaze           where the eye looks, within what was prepared
image_cells    cells of the image that share kernels
cell_maps      from their pixels to those of stored kernels
map_loops      compiled loops over those maps
frame_states   what stays while pupil, focus and gaze stay
frame_use      what a frame asks for, and which PSFs that needs
frame_kernels  recipes of a frame's kernels
kernel_loops   their compiled loops
kernel_tables  the same as the passes read it
table_loops    its compiled loops
pair_loops     which kernels a frame uses, and the next one will
srgb           pictures as they are stored, and linear light
media_effects  what media and spectacles do, where a profile asks for it
haze           light that the media scatter, over a picture
haze_loops     its compiled loops
spectacles     the size of what is seen through them
spectacle_loops  its compiled loop
plan_once      what plans need, loaded ahead
reference      numpy twins of the passes
gl/            the engine of compute shaders
native/        the engine of compiled loops
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
