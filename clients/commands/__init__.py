"""The command line: its program, and the commands without a separate package.

program        the `ocufilter` program and the table of its commands
options        options that commands share: settings, profiles, sizes
service        status, latency, keys and eyes: a running service and its folders
filter_image   filter: one image
filter_bands   bands: one image of many wavelengths
correct_image  correct: a picture solved for a viewer
best_lens      best-lens: spectacles or a contact lens for a scene
scenario       scenario: two states of one person
eye            estimate and field: an eye and its visual field
wavefront      wavefront: aberrations in one direction
psf            psf: the point-spread function in one direction
coefficients   coefficients in other orders, as wavefront and estimate print them
eye_bank       bank: prebuilt eyes of many persons
image_quality  mtf, acuity, refraction and through-focus: an eye in lists of states
state_options  options of such lists
checkout       bench and paper, which need a checkout
doctor         doctor: checks of this machine
doctor_probes  probes that run in separate processes

`filter_service.command_line` runs every command, and prints its errors.
"""
