"""The light of a stimulus, its parameters, and the contrast that its pixels have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.stimuli.display import Display
from filter_service import RgbdView
from filter_service.color_encoding import srgb8_of

ROUNDING = 1e-9
"""Rounding error of light."""


@dataclass(frozen=True)
class Stimulus:
    """A gray picture in linear light.

    Attributes
    ----------
    name : str
        Name from its parameters, for a file.
    light : (height, width), float32
        Linear light; 0 is black, 1 is white.
    display : Display
        Pixels and their visual angle.
    parameters : dict
        Parameters by name.
    notes : tuple of str
        Problems of the sampling.
    fitted : dict
        What is fitted to the light: ``fundamental_contrast`` of gratings and Gabors,
        the amplitude over the mean of the sinusoid of their frequency.
    """

    name: str
    light: NDArray[np.float32]
    display: Display
    parameters: Mapping[str, Any]
    notes: tuple[str, ...] = field(default=())
    fitted: Mapping[str, float] = field(default_factory=dict)

    @property
    def linear_rgb(self) -> NDArray[np.float32]:
        """Linear light (height, width, 3)."""
        return np.repeat(self.light[..., None], 3, axis=2)

    @property
    def srgb(self) -> NDArray[np.uint8]:
        """8-bit sRGB (height, width, 3)."""
        return srgb8_of(self.linear_rgb)

    @property
    def margin_arcmin(self) -> float | None:
        """Width of the background around the stimulus; None if it fills the picture."""
        light = self.light
        differs = light != light[0, 0]
        if not differs.any() or differs[[0, -1]].any() or differs[:, [0, -1]].any():
            return None
        margins_px = []
        for along, side_px in enumerate(light.shape):
            found = np.flatnonzero(differs.any(axis=1 - along))
            margins_px += [int(found[0]), side_px - 1 - int(found[-1])]
        return min(margins_px) * self.display.pixel_arcmin

    def view(self, distance_m: float) -> RgbdView:
        """Return what an eye sees at a distance: the linear light, and its depth."""
        depth_m = np.full(self.light.shape, distance_m, np.float32)
        return RgbdView(self.linear_rgb, depth_m, self.display.camera.tangents)

    def described(self) -> dict[str, Any]:
        """Return parameters, what the pixels measure, and notes, for JSON."""
        light = self.light.astype(np.float64)
        low, high = float(light.min()), float(light.max())
        total = low + high
        measured = {
            "mean_light": float(light.mean()),
            "least_light": low,
            "most_light": high,
            "michelson_contrast": (high - low) / total if total > 0.0 else 0.0,
            **self.fitted,
        }
        if (white_nit := self.display.white_nit) is not None:
            for name in ("mean", "least", "most"):
                measured[f"{name}_nit"] = white_nit * measured[f"{name}_light"]
        return {
            "name": self.name,
            **self.parameters,
            "measured": measured,
            "notes": list(self.notes),
        }


def stimulus(
    name: str,
    light: NDArray[np.float64],
    display: Display,
    parameters: Mapping[str, Any],
    notes: tuple[str, ...] = (),
    fitted: Mapping[str, float] | None = None,
) -> Stimulus:
    """Return a stimulus, or raise if its light is beyond black or white.

    Raises
    ------
    ValueError
        If it is.  The message names the range of the light.
    """
    low, high = float(light.min()), float(light.max())
    if low < -ROUNDING or high > 1.0 + ROUNDING:
        raise ValueError(
            f"the light of {name} is {low:.4g} to {high:.4g}; allowed: 0 (black) to 1 "
            "(white), by less contrast or another mean or background"
        )
    clipped = np.clip(light, 0.0, 1.0).astype(np.float32)
    return Stimulus(name, clipped, display, dict(parameters), notes, fitted or {})
