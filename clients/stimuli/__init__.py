"""Stimuli of vision science in linear light, of exact size in minutes of arc.

    from ocufilter import stimuli

    display = stimuli.Display(width_px=128, height_px=128, pixel_arcmin=0.5)
    letter = stimuli.sloan_letters("K", height_arcmin=25.0, display=display)

display    `Display`: pixels of a picture, their visual angle, and the white level
stimulus   `Stimulus`: light of a picture, its parameters and measured contrast
coverage   shares of pixels inside shapes
letters    Sloan letters, Landolt C, tumbling E, reading text
patterns   gratings, Gabors, edges, noise
sets       lists of stimuli from the options of the command line
options    options of `ocufilter stimuli`
program    the command: stimuli, and how they look through eyes
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
