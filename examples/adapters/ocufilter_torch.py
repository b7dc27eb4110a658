"""A transform for PyTorch data sets: pictures as a person sees them.

    transform = SeenThrough("myopia", vertical_fov_deg=40.0, distance_m=2.0)
    data_set = torchvision.datasets.ImageFolder("letters", transform=transform)

A picture may be a PIL image, an array [row, column, channel] or a tensor [channel, row,
column] of bytes or of floats from 0 to 1, sRGB as torchvision has them; what comes out
is of the same kind.  A tuple of picture and depth in meters replaces the distance.
Each worker of a `DataLoader` makes an eye of its own for its first picture, which takes
a second or two.  PyTorch is imported only where a tensor comes in.
"""

import os

import numpy as np

from filter_service import Camera, EyeFilter


class SeenThrough:
    """Filters pictures through one eye.

    Parameters
    ----------
    profile : str, dict or Path
        As `EyeFilter` takes it.
    vertical_fov_deg : float
        How high the pictures are seen.
    distance_m : float
        Of pictures that come without depth; infinity is far away.
    pupil_diameter_mm, focus_dpt : float
        State of the eye.
    settings : FilterSettings or dict, optional
    """

    def __init__(
        self,
        profile,
        *,
        vertical_fov_deg,
        distance_m=np.inf,
        pupil_diameter_mm=4.0,
        focus_dpt=0.0,
        settings=None,
    ):
        self.profile, self.settings = profile, settings or {}
        self.vertical_fov_deg, self.distance_m = vertical_fov_deg, distance_m
        self.state = {"pupil_diameter_mm": pupil_diameter_mm, "focus_dpt": focus_dpt}
        self._filters, self._pid = {}, None

    def __call__(self, picture):
        """Return the picture, seen."""
        picture, depth_m = picture if isinstance(picture, tuple) else (picture, None)
        is_tensor = type(picture).__module__.partition(".")[0] == "torch"
        color = np.asarray(picture)
        seen = self._seen(color.transpose(1, 2, 0) if is_tensor else color, depth_m)
        if is_tensor:
            import torch

            return torch.from_numpy(np.ascontiguousarray(seen.transpose(2, 0, 1)))
        if isinstance(picture, np.ndarray):
            return seen
        from PIL import Image

        return Image.fromarray(seen)

    def _seen(self, color, depth_m):
        height_px, width_px = color.shape[:2]
        if depth_m is None:
            depth_m = np.full((height_px, width_px), self.distance_m)
        is_bytes = color.dtype == np.uint8
        seen = self._filter_of(width_px, height_px).filter(
            np.ascontiguousarray(color if is_bytes else decoded(color)),
            np.asarray(depth_m, np.float32),
            output="srgb8" if is_bytes else "linear",
            whole=True,
            **self.state,
        )
        return seen.color if is_bytes else encoded(seen.color)

    def _filter_of(self, width_px, height_px):
        """Return the filter for a size; those of another process do not work here."""
        if self._pid != os.getpid():
            self._filters, self._pid = {}, os.getpid()
        size = width_px, height_px
        if size not in self._filters:
            camera = Camera.from_fov(
                self.vertical_fov_deg, width_px=width_px, height_px=height_px
            )
            self._filters[size] = EyeFilter(self.profile, camera, self.settings)
        return self._filters[size]

    def __getstate__(self):
        """Return what goes to a worker: all but the filters."""
        return {**vars(self), "_filters": {}, "_pid": None}


def decoded(srgb):
    """Return linear light of sRGB floats (IEC 61966-2-1)."""
    curve = ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, srgb / 12.92, curve).astype(np.float32)


def encoded(linear):
    """Return sRGB floats of linear light."""
    curve = 1.055 * np.clip(linear, 0.0, 1.0) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve).astype(np.float32)
