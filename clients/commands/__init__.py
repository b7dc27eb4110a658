"""The command line, one module per command.

console          output, errors, progress
setting_options  command-line options generated from `FilterSettings`
display_file     measured spectra of a display
program          the `ocufilter` program: dispatch and errors
programs         demo, headset, layer, report, batch, web, doctor
checkout         bench and paper
serve            the service, and ahead-of-time compilation of its loops
status           state of a running service
latency          latency and error of frames through a running service
keys             client keys of the service
eyes             on-disk cache of eyes
filter_image     filtering of one image
plan_text        a PSF plan as text
estimate         an eye from a profile
wavefront        aberrations of an eye in one direction of the visual field
field            aberrations over the visual field
psf              PSFs of an eye
doctor_checks    checks of this machine
doctor_probes    probes that run in processes of their own
"""
