"""Transform for PyTorch data sets that filters images through an eye.

    transform = SeenThrough("myopia", vertical_fov_deg=40.0, distance_m=2.0)
    data_set = torchvision.datasets.ImageFolder("letters", transform=transform)

The transform accepts a PIL image, an array [row, column, channel] or a tensor [channel,
row, column], with sRGB values as bytes or as floats from 0 to 1, and returns the same
kind.  Pass a tuple (image, depth in meters) to replace the constant distance.  Each
`DataLoader` worker creates its own eye for its first image, which takes a second or
two.  PyTorch is imported only for tensors.
"""

import os

import numpy as np

from ocufilter import Camera, EyeFilter


class SeenThrough:
    """Filter images through one eye.

    Parameters
    ----------
    profile : str, dict or Path
        Profile, as for `EyeFilter`.
    vertical_fov_deg : float
        Vertical field of view of the images, deg.
    distance_m : float
        Distance of images without depth, m; may be infinite.
    pupil_diameter_mm, focus_dpt : float
        Entrance pupil, mm, and focus, dpt.
    settings : FilterSettings or dict, optional
        Settings of the filter.
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
        """Return the filtered image, of the same type as the input."""
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
        """Return the filter for an image size; a forked process creates its own."""
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
        """Return the state to pickle, without the filters."""
        return {**vars(self), "_filters": {}, "_pid": None}


def decoded(srgb):
    """Return linear light for sRGB floats (IEC 61966-2-1)."""
    curve = ((np.maximum(srgb, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, srgb / 12.92, curve).astype(np.float32)


def encoded(linear):
    """Return sRGB floats for linear light."""
    curve = 1.055 * np.clip(linear, 0.0, 1.0) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve).astype(np.float32)
