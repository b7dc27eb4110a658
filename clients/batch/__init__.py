"""`ocufilter batch`: data sets of colour and depth through people's eyes.

program            the command
options            its command line
job                what decides the pictures
source             one frame: its files, camera and depth
layouts            which layout a data set has
layout_pairs       folders of colour and depth
layout_tum         TUM RGB-D
layout_nyu         NYU depth v2
layout_middlebury  stereo with disparities
layout_video       videos
states             pupil and focus of each frame
exact_filter       pictures that do not depend on those before
work               frames in, files and records out
worker             the process that does it
process_pool       one for each core
ray_pool           or on many machines
whole_files        there whole or not at all
manifest           what was done
run                what is missing is done
dry_run            how long it would take
video_reading      frames by their numbers
video_writing      segments, and one video of them
"""
