"""`ocufilter latency`: latency and error of frames through a running service.

stream   frames on a fixed schedule, and their times
measure  one stream for each case, the error of what came back, text, JSON and plot
"""
