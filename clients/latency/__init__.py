"""`ocufilter latency`: latency and error of frames through a running service.

stream   frames on a fixed schedule, and their times
measure  one stream for each case, and the error of what came back
report   text, JSON and plot
"""
