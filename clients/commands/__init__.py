"""The command line, one module per command.

console          output, errors, progress
setting_options  command-line options generated from `FilterSettings`
display_file     measured spectra of a display
program          the `ocufilter` program: dispatch and errors
programs         demo, headset, report, batch, web
checkout         bench and paper
serve            the service
status           state of a running service
keys             client keys of the service
eyes             on-disk cache of eyes
prepare          ahead-of-time compilation of the loops
filter_image     one image
plan_text        a PSF plan as text
estimate         an eye from a profile
wavefront        aberrations of an eye in one direction
field            aberrations over the visual field
psf              PSFs of an eye
doctor           diagnosis of this machine
doctor_checks    the individual checks
doctor_probes    probes that run in their own process
"""
