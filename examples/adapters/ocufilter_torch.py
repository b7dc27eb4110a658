"""Transform for PyTorch data sets that filters images through an eye.

    transform = SeenThrough("myopia", vertical_fov_deg=40.0, distance_m=2.0)
    data_set = torchvision.datasets.ImageFolder("letters", transform=transform)

The transform accepts a PIL image, an array [..., row, column, channel] or a tensor
[..., channel, row, column], with sRGB values as bytes or as floats from 0 to 1, and
returns the same kind.  Gray images have one channel or none: [row, column].  Pass a
tuple (image, depth in meters) to replace the constant distance.  Gradients pass through
tensors of floats.  Each `DataLoader` worker creates its own eye for its first image,
which takes up to a second.

Another eye, pupil or focus for one image, or a sequence of them for a batch [image,
...], are arguments of the call:

    transform(image, profile=bank[number], pupil_diameter_mm=3.5)
"""

import numpy as np
import torch

from ocufilter import Camera
from ocufilter.torch import SeeThrough


class SeenThrough:
    """Filter images through an eye.

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
        self.vertical_fov_deg, self.distance_m = vertical_fov_deg, distance_m
        self.settings = settings or {}
        self.eye = {
            "profile": profile,
            "pupil_diameter_mm": pupil_diameter_mm,
            "focus_dpt": focus_dpt,
        }
        self._layers = {}

    def __call__(self, picture, **eye):
        """Return the filtered image, of the same type as the input.

        Parameters
        ----------
        picture : PIL image, array or tensor, or (picture, depth in meters)
        **eye
            ``profile``, ``pupil_diameter_mm`` or ``focus_dpt`` of this call.
        """
        picture, depth_m = picture if isinstance(picture, tuple) else (picture, None)
        if isinstance(picture, torch.Tensor):
            return self._seen(picture, depth_m, eye)
        color = torch.from_numpy(np.array(picture))
        if color.ndim > 2:
            color = color.movedim(-1, -3)
        seen = self._seen(color, depth_m, eye)
        if color.ndim > 2:
            seen = seen.movedim(-3, -1)
        seen = seen.contiguous().numpy()
        if isinstance(picture, np.ndarray):
            return seen
        from PIL import Image

        return Image.fromarray(seen)

    def _seen(self, color, depth_m, eye):
        layer, distance_m = self._layer_of(*color.shape[-2:])
        for name, value in (self.eye | eye).items():
            if name not in self.eye:
                raise TypeError(f"unknown {name!r}; expected one of: {[*self.eye]}")
            setattr(layer, name, value)
        layer.depth_m = distance_m if depth_m is None else np.float32(depth_m)
        if color.dtype != torch.uint8:
            return encoded(layer(decoded(color)))
        seen = encoded(layer(decoded(color / 255.0)))
        return (255.0 * seen).round().to(torch.uint8)

    def _layer_of(self, height_px, width_px):
        """Return the layer for an image size, and its constant depth."""
        size = height_px, width_px
        if size not in self._layers:
            camera = Camera.from_fov(
                self.vertical_fov_deg, width_px=width_px, height_px=height_px
            )
            depth_m = np.full(size, self.distance_m, np.float32)
            layer = SeeThrough(
                camera=camera, depth_m=depth_m, settings=self.settings, **self.eye
            )
            self._layers[size] = layer, depth_m
        return self._layers[size]


def decoded(srgb):
    """Return linear light for sRGB floats (IEC 61966-2-1)."""
    curve = ((srgb.clamp(min=0.0) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, curve)


def encoded(linear):
    """Return sRGB floats for linear light."""
    # The power's slope at 0 is infinite, and would make gradients NaN.
    curve = 1.055 * linear.clamp(0.0031308, 1.0) ** (1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear.clamp(min=0.0), curve)
