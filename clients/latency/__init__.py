"""`ocufilter latency`: latency and error of frames through a running service.

stream   frames on a fixed schedule, and their times
measure  one stream for each case, the error of the results, text, JSON and plot
"""
