"""Filtering of color and depth data sets: `ocufilter batch`.

program            the command
options            its command line
job                the parameters that determine the pictures
source             one frame: its files, camera and depth
layouts            detection of a data set's layout
layout_pairs       folders of color and depth
layout_tum         TUM RGB-D
layout_nyu         NYU depth v2
layout_middlebury  stereo with disparities
layout_video       videos
states             pupil and focus of each frame
exact_filter       filter whose pictures do not depend on previous frames
work               runs units: frames in, files and records out
worker             worker process that runs units
process_pool       a worker process per core
ray_pool           workers on many machines
atomic_files       atomic writes and file hashes
manifest           record of the finished frames
run                runs the missing frames
dry_run            time and cost estimate
video_reading      random access to video frames
video_writing      video segments, and joining them
"""
