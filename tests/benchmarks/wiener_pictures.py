"""Precompensation by Wiener filters, the usual way, and the acuity that it leaves."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from estimator.acuity.observer import log_mar_of
from estimator.acuity.transfer import HIGHEST_CPD, Transfer
from filter_service.camera import Camera
from filter_service.correcting import PictureOperator

REGULARIZATIONS = 10.0 ** np.arange(-4.0, 0.6, 0.25)
MARGIN_PX = 32
TILES = 4, 3
"""Columns and rows of tiles, each with a PSF of its own."""

STEP_CPD = 0.75


def psf_at(operator: PictureOperator, x_px: int, y_px: int) -> NDArray[np.float32]:
    """Image of a point, moved to the middle of the frame."""
    height_px, width_px, _ = operator.color_shape
    point = np.zeros(operator.color_shape, np.float32)
    point[y_px, x_px] = 1.0
    shift = height_px // 2 - y_px, width_px // 2 - x_px
    return np.roll(operator.forward(point), shift, (0, 1))


def _filtered(
    psf: NDArray[np.float32], target: NDArray[np.float32]
) -> Iterator[NDArray[np.float32]]:
    """Pictures of all regularizations, reflected beyond the edges of the frame."""
    height_px, width_px, _ = target.shape
    margins = ((MARGIN_PX, MARGIN_PX), (MARGIN_PX, MARGIN_PX), (0, 0))
    wanted = np.pad(target, margins, mode="reflect")
    middle = MARGIN_PX + height_px // 2, MARGIN_PX + width_px // 2
    kernel = np.roll(np.pad(psf, margins), (-middle[0], -middle[1]), (0, 1))
    h, t = (fft.rfft2(image, axes=(0, 1)) for image in (kernel, wanted))
    for regularization in REGULARIZATIONS:
        ratio = (1.0 + regularization) * h.conj() / (np.abs(h) ** 2 + regularization)
        found = fft.irfft2(t * ratio, s=wanted.shape[:2], axes=(0, 1))
        yield found[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].astype(np.float32)


def by_one_psf(
    operator: PictureOperator, target: NDArray[np.float32]
) -> list[NDArray[np.float32]]:
    """Clipped pictures by the PSF of the middle, one for each regularization."""
    height_px, width_px, _ = target.shape
    psf = psf_at(operator, width_px // 2, height_px // 2)
    return [picture.clip(0.0, 1.0) for picture in _filtered(psf, target)]


def by_tiles(
    operator: PictureOperator, target: NDArray[np.float32]
) -> list[NDArray[np.float32]]:
    """Clipped pictures by the PSFs of tiles, blended linearly between their middles."""
    height_px, width_px, _ = target.shape
    totals = [np.zeros_like(target) for _ in REGULARIZATIONS]
    columns, rows = (
        _hats(size_px, n)
        for size_px, n in zip((width_px, height_px), TILES, strict=True)
    )
    for x_px, across in columns:
        for y_px, along in rows:
            weight = (along[:, None] * across)[..., None].astype(np.float32)
            psf = psf_at(operator, x_px, y_px)
            for total, picture in zip(totals, _filtered(psf, target), strict=True):
                total += weight * picture
    return [total.clip(0.0, 1.0) for total in totals]


def _hats(size_px: int, count: int) -> list[tuple[int, NDArray[np.float64]]]:
    """Middles of tiles along an axis, and their weights, which sum to 1."""
    middles = (np.arange(count) + 0.5) * size_px / count
    place = np.arange(size_px)
    return [
        (int(middle), np.interp(place, middles, np.eye(count)[k]))
        for k, middle in enumerate(middles)
    ]


def log_mar_of_picture(
    seen: NDArray[np.float32], meant: NDArray[np.float32], camera: Camera
) -> float:
    """Acuity of the transfer from a chart that is meant to the image that is seen.

    The transfer is the cross-spectrum over the power of the chart in rings of
    frequency, green light; it is 0 beyond the highest frequency of the pixels.
    """
    meant, seen = (image[..., 1] - image[..., 1].mean() for image in (meant, seen))
    t, y = fft.fft2(meant), fft.fft2(seen)
    pitch_deg = np.degrees(np.array(camera.pixel_pitch_mrad) / 1e3)
    x_cpd, y_cpd = (
        fft.fftfreq(n, p) for n, p in zip(meant.shape[::-1], pitch_deg, strict=True)
    )
    rings = np.rint(np.hypot(y_cpd[:, None], x_cpd) / STEP_CPD).astype(int)
    power = np.bincount(rings.ravel(), (np.abs(t) ** 2).ravel())
    shared = np.bincount(rings.ravel(), (y * t.conj()).real.ravel())
    n_rings = int(0.5 / pitch_deg.max() / STEP_CPD)
    ratio = np.zeros(int(HIGHEST_CPD / STEP_CPD) + 2)
    ratio[:n_rings] = (shared / np.maximum(power, 1e-12 * power.max()))[:n_rings]
    ratio[0] = ratio[1]
    along_cpd = STEP_CPD * np.arange(-len(ratio) + 1, len(ratio))
    radial_cpd = np.hypot(along_cpd[:, None], along_cpd)
    at = np.interp(radial_cpd, STEP_CPD * np.arange(len(ratio)), ratio, right=0.0)
    return log_mar_of(Transfer(along_cpd, at.astype(np.complex128)))
