"""The command line: one file a command.

console          output, errors, progress
setting_options  options made from `FilterSettings`
display_file     a display's measured spectra
programs         demo and bench: programs of the clients and the checkout
serve            the service
status           what a running one says of itself
keys             who may connect to it
eyes             whose PSFs are kept on disk
prepare          loops compiled ahead
filter_image     one picture
plan_text        a plan in words
estimate         an eye from a profile
wavefront        its aberrations
field            those of its whole visual field
psf              its PSFs
doctor           what works here
doctor_checks    each thing tried
doctor_probes    trials in a process of their own
"""
