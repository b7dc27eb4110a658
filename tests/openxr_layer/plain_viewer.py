"""`ocufilter headset` that shows its scene unfiltered.

    python -m tests.openxr_layer.plain_viewer --scene room.glb --frames 30

Its arguments are the command's.
"""

import sys

from clients.commands.program import main
from clients.headset import program
from clients.headset.stereo_filter import FilteredStereoFrame
from clients.headset.stereo_gaze import images_of


class Unfiltered:
    """Filter that returns each picture as it is."""

    def __init__(self, settings, *_):
        self.settings = settings

    def change(self, eye, profile):
        """There are no eyes."""

    def see(self, frame):
        return FilteredStereoFrame(
            frame,
            tuple(images_of(picture)[0] for picture in frame.pictures),
            (None, None),
        )

    def known(self, picture):
        return picture

    def restart(self):
        """Nothing is kept."""

    def close(self):
        """Nothing is held."""


if __name__ == "__main__":
    program.LocalFilter = Unfiltered
    sys.argv.insert(1, "headset")
    main()
