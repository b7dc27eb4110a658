"""PsychoPy stimulus that shows an image filtered through an eye.

    stimulus = visual.SeenImageStim(
        window, image="room.png", profile="keratoconus", verticalFov=20, distance=0.57
    )
    stimulus.setEye(pupilDiameter=5, focus=1.75)

`SeenImageStim` is an `ImageStim` that filters its image first.  Pass depth in meters,
as an array or a file, instead of a constant distance.  If the stimulus is shown at its
vertical field of view, an observer without refractive error receives the retinal image
of the simulated eye, limited by diffraction and the observer's own aberrations.

Where ocufilter is installed, `pip install examples/adapters` registers the class as
`psychopy.visual.SeenImageStim`.  The filter is imported with the first stimulus, so an
unused plugin costs nothing.
"""

from pathlib import Path

import numpy as np
from psychopy.visual import ImageStim


class SeenImageStim(ImageStim):
    """Image filtered through an eye.

    Parameters
    ----------
    win : psychopy.visual.Window
        Window to draw in.
    image : str, Path or (height, width, 3) uint8 sRGB
        Image to filter.
    profile : str, dict or Path
        Profile, as for `ocufilter.EyeFilter`.
    verticalFov : float
        Vertical field of view of the image, deg.
    distance : float, optional
        Distance of the image, m.
    depth : (height, width), str or Path, optional
        Depth, m, instead of the distance.
    pupilDiameter, focus : float
        Entrance pupil, mm, and focus, dpt.
    kwargs
        Further arguments of `ImageStim`.

    Raises
    ------
    ValueError
        Neither or both of `distance` and `depth` are given.
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
        from filter_service.image_files import read_color, read_depth
        from ocufilter import Camera, EyeFilter

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
        """Filter the image again, with another pupil and focus."""
        self.setImage(self._seen(pupilDiameter, focus), log=False)

    def setProfile(self, profile, pupilDiameter, focus):
        """Filter the image again, through another eye."""
        self._eye.set_profile(profile)
        self.setEye(pupilDiameter, focus)

    def _seen(self, pupil_diameter_mm, focus_dpt):
        """Return the filtered image as a PsychoPy array: -1 to 1, bottom row first."""
        seen = self._eye.filter(
            self._color,
            self._depth_m,
            pupil_diameter_mm=pupil_diameter_mm,
            focus_dpt=focus_dpt,
            whole=True,
        )
        return np.flipud(seen.color).astype(np.float32) / 127.5 - 1.0
