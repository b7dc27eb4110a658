"""Offline filtering of data sets of color and depth: `ocufilter batch`.

A batch filters each frame of a data set through each profile.  Its frames are divided
into units, which workers run.  A manifest records the frames that are finished.

program        the command
options        command line
profiles       profiles on the command line, and persons drawn for them
description    the batch that a command line describes
eye_options    options that give each image an eye of its own
eye_table      eyes of single images from a table
eyes           eyes of single images, drawn from persons or a bank
source         a frame: its files, camera, depth format, and the state of the eye
views          distances, pupils and foci in which each image is filtered
layouts        detection of the layout of a data set, and videos
datasets       pairs of images, TUM RGB-D, NYU depth v2, Middlebury stereo
work           job and its units, which read, filter and write frames
pools          worker processes on this machine, or on many machines with Ray
manifest       atomic writes, file hashes, and the record of the finished frames
refraction     refraction of the eyes of single images, for their labels
labels         table of the results with their eyes, for training
run            runs the missing frames of a batch
dry_run        estimates time and cost, and what the mode on-axis would lose
video_reading  random access to video frames, in the colors that their tags describe
video_writing  writing and joining of video segments
"""
