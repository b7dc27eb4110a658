"""OpenXR API layer through which other programs are seen as an eye would see them.

source           the layer, C: copies each frame, shows the filtered one
helper           the process that filters the frames: sessions, eyes, profiles
eyes             profiles of both eyes, which change while frames are filtered
helper_socket    where the helper listens, and requests to it
wire             messages between both
frame_images     images in their shared memory
submitted_depth  depth that the program submits, checked
manifest         where the loader of OpenXR finds the layer
program          `ocufilter layer`
"""
