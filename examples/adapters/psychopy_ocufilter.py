"""A stimulus for PsychoPy: a picture as a person sees it.

    stimulus = visual.SeenImageStim(
        window, image="room.png", profile="keratoconus", verticalFov=20, distance=0.57
    )
    stimulus.setEye(pupilDiameter=5, focus=1.75)

It is an `ImageStim` whose picture goes through an eye first.  Depth in meters, as an
array or a file, replaces the distance.  Shown at its vertical field of view, it gives
an observer without refractive error the retinal image of the other eye, as far as
diffraction and the observer's own aberrations allow.

`pip install examples/adapters` registers it with PsychoPy, as `visual.SeenImageStim`.
The filter is imported with the first stimulus: an unused plugin costs nothing.
"""

from pathlib import Path

import numpy as np
from psychopy.visual import ImageStim


class SeenImageStim(ImageStim):
    """A picture seen through an eye.

    Parameters
    ----------
    win : psychopy.visual.Window
    image : str, Path or (height, width, 3) uint8 sRGB
    profile : str, dict or Path
        As `filter_service.EyeFilter` takes it.
    verticalFov : float
        Of the picture, deg.
    distance, depth : float, or (height, width) or a file
        Meters; one of them.
    pupilDiameter, focus : float
        Millimeters and diopters.
    kwargs
        As `ImageStim` has them.
    """

    def __init__(
        self,
        win,
        image,
        profile,
        verticalFov,
        distance=None,
        depth=None,
        pupilDiameter=4.0,
        focus=0.0,
        **kwargs,
    ):
        from filter_service import Camera, EyeFilter
        from filter_service.image_files import read_color, read_depth

        is_file = isinstance(image, str | Path)
        self._color = read_color(Path(image)) if is_file else np.asarray(image)
        height_px, width_px = self._color.shape[:2]
        if (distance is None) == (depth is None):
            raise ValueError("distance and depth: expected one of them")
        if depth is None:
            depth = np.full((height_px, width_px), distance, np.float32)
        elif isinstance(depth, str | Path):
            depth = read_depth(Path(depth))
        self._depth_m = np.asarray(depth, np.float32)
        camera = Camera.from_fov(verticalFov, width_px=width_px, height_px=height_px)
        self._eye = EyeFilter(profile, camera)
        super().__init__(win, image=self._seen(pupilDiameter, focus), **kwargs)

    def setEye(self, pupilDiameter, focus):
        """Show the picture in another state of the eye."""
        self.setImage(self._seen(pupilDiameter, focus), log=False)

    def setProfile(self, profile, pupilDiameter, focus):
        """Show the picture through another eye."""
        self._eye.set_profile(profile)
        self.setEye(pupilDiameter, focus)

    def _seen(self, pupil_diameter_mm, focus_dpt):
        """Return the picture as PsychoPy has arrays: -1 to 1, bottom row first."""
        seen = self._eye.filter(
            self._color,
            self._depth_m,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            whole=True,
        )
        return np.flipud(seen.color).astype(np.float32) / 127.5 - 1.0
