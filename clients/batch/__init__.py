"""Offline filtering of data sets of color and depth: `ocufilter batch`.

A batch filters each frame of a data set through each profile.  Its frames are divided
into units, which workers run.  A manifest records the frames that are finished.

program            the command
options            command line
job                parameters that determine the images
source             a frame: its files, camera and depth format
layouts            detection of the layout of a data set, and videos
layout_pairs       folders of color and depth
layout_tum         TUM RGB-D
layout_nyu         NYU depth v2
layout_middlebury  Middlebury stereo, with disparities
states             pupil and focus of each frame
exact_filter       filter whose images do not depend on previous frames
work               runs units: reads, filters and writes frames
process_pool       worker processes on this machine
ray_pool           workers on many machines, with Ray
atomic_files       atomic writes and file hashes
manifest           record of the finished frames
run                runs the missing frames of a batch
dry_run            estimate of time and cost
video_reading      random access to video frames
video_color        colors, orientation and pixel shape of video frames
video_writing      writing and joining of video segments
"""
