"""OpenXR API layer through which other programs are seen as an eye would see them.

source        the layer, C: copies each frame, shows the filtered one
helper        the process that filters the frames: sessions, eyes, profiles
wire          messages between both, the socket of the helper, requests to it
frame_images  images and submitted depth in their shared memory
quads         quad layers, drawn into the pictures of the views
program       `ocufilter layer`, and where the loader of OpenXR finds the layer
"""
