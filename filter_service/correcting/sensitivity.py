"""Differences between retinal images, weighted by neural contrast sensitivity."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from estimator.acuity.transfer import HIGHEST_CPD, neural_sensitivity
from filter_service.camera import Camera

ROWS_AND_COLUMNS = (0, 1)


class SensitivityWeight:
    """A linear filter of retinal images by neural contrast sensitivity.

    The sensitivity is relative to its maximum: at most 1, about a fifth for uniform
    light, and 0 beyond 60 cycles per degree.  Images continue by reflection at their
    edges, and every channel counts alike.

    Parameters
    ----------
    camera : Camera
        Camera of the images, whose pitch on the axis sets the frequencies.
    """

    def __init__(self, camera: Camera) -> None:
        pitches_deg = [np.degrees(mrad / 1000.0) for mrad in camera.pixel_pitch_mrad]
        x_cpd, y_cpd = (
            np.arange(count) / (2.0 * count * pitch_deg)
            for count, pitch_deg in zip(
                (camera.width_px, camera.height_px), pitches_deg, strict=True
            )
        )
        radial_cpd = np.hypot(y_cpd[:, None], x_cpd)
        relative = neural_sensitivity(radial_cpd)
        relative /= neural_sensitivity(np.arange(0.0, HIGHEST_CPD, 0.1)).max()
        relative[radial_cpd > HIGHEST_CPD] = 0.0
        self._relative = relative[..., None].astype(np.float32)

    def forward(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the weighted cosine transform (height, width, 3) of an image.

        The transform is orthonormal: its sum of squares is that of the filtered image.
        """
        found: NDArray[Any] = fft.dctn(image, axes=ROWS_AND_COLUMNS, norm="ortho")
        return found * self._relative

    def adjoint(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the transpose of `forward`, applied to such a transform."""
        weighted = values * self._relative
        found: NDArray[Any] = fft.idctn(weighted, axes=ROWS_AND_COLUMNS, norm="ortho")
        return found
