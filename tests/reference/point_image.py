"""Image of a point in a frame: PSFs of exactly its direction, distance and state.

Ground truth for the light of one pixel in a filtered frame.  Nothing is interpolated,
cropped to a box, quantized or fitted.  Each color has the float64 quadrature of
`psf_integral` on the wavefront of the pixel, integrated over pixels with the local
scale of the pixel's direction, and is placed by the chief ray of its color.  The last
`EDGE_LIGHT_RATIO` of the light, far from the spot, follows from the closed form of the
light that is diffracted at the edge of the pupil.  All but `LEFT_OUT_RATIO` of the
light is within the image.

Wavefronts (`EyeOptics.wavefronts`), chief rays (`EyeOptics.chief_ray_shift_mrad`) and
the geometry of the pinhole camera (`estimator.optics.pinhole`) are those of the
product, on purpose: this is the truth for the way from an eye to a frame, not for the
eye.  The packages `psfs`, `planning` and `rendering` of `filter_service` are not used.

References
----------
M. Born & E. Wolf, Principles of Optics, 7th ed., section 8.9: far from the geometric
image, diffracted light comes from the edge of the aperture.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.optics import pinhole
from estimator.optics.zernike import zernike_gradient
from tests.reference.psf_integral import reference_kernel

LEFT_OUT_RATIO = 2e-4
"""Share of the light of a point outside the square of its image."""

EDGE_LIGHT_RATIO = 2e-3
"""Share of the light that follows from the closed form of edge light, which omits the
fringes.  Pixels of 1 mrad average them: the sum of the absolute differences from the
quadrature is 2e-5 to 4e-5 of the light for pupils of 3 to 6 mm."""

EDGE_POINTS = 3000
EDGE_STEP_PX = 0.5
"""Points along the edge, and step of distance from it: five to a pixel at 200 px."""


@dataclass(frozen=True)
class PointWavefront:
    """Wavefront of a point in one color, and the scale of the image at its place.

    Attributes
    ----------
    zernike_um : (n_terms,)
        On the circle; tilt displaces the image from the pixel of the point.
    circle_diameter_mm : float
    pupil_ellipse : (5,)
        See `estimator.psf.compute.compute_psf_batch`.
    wavelength_nm : float
    pixel_from_mrad : (2, 2)
    """

    zernike_um: NDArray[np.float64]
    circle_diameter_mm: float
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: float
    pixel_from_mrad: NDArray[np.float64]

    def shifted(self, shift_mrad: NDArray[np.float64]) -> "PointWavefront":
        """Return the wavefront with an image displaced along the pupil axes."""
        zernike_um = self.zernike_um.copy()
        # W = shift . u, of which 2 rho sin and 2 rho cos have the indices 1 and 2.
        zernike_um[[2, 1]] += shift_mrad * (self.circle_diameter_mm / 4.0)
        return replace(self, zernike_um=zernike_um)

    def edge(self, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (count, 2) of the edge, mm, and their normals times length.

        The normals point outward; their length is the step along the edge, mm.
        """
        center_x, center_y, major, minor, angle = self.pupil_ellipse
        t = 2.0 * math.pi * (np.arange(count) + 0.5) / count
        turn = np.array(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        )
        points = np.stack([major * np.cos(t), minor * np.sin(t)], axis=-1) @ turn.T
        normals = np.stack([minor * np.cos(t), major * np.sin(t)], axis=-1) @ turn.T
        step = 2.0 * math.pi / count
        return points + np.array([center_x, center_y]), step * normals

    def rays_mrad(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the visual angles (n, 2) to which points of the pupil send light."""
        radius_mm = self.circle_diameter_mm / 2.0
        x, y = (points_mm / radius_mm).T
        gradient = zernike_gradient(x, y, n_terms=self.zernike_um.size)
        return gradient @ self.zernike_um / radius_mm

    def spot_px(self) -> float:
        """Return the largest distance of a ray from the pixel of the point."""
        edge_mm, _ = self.edge(256)
        center_mm = np.array(self.pupil_ellipse[:2])
        within = np.linspace(0.0, 1.0, 17)[:, None, None]
        points_mm = center_mm + within * (edge_mm - center_mm)
        rays_mrad = self.rays_mrad(points_mm.reshape(-1, 2))
        return float(np.linalg.norm(rays_mrad @ self.pixel_from_mrad.T, axis=1).max())

    def edge_light_px(self, ratio: float) -> float:
        """Return the distance from the spot beyond which a share of the light falls.

        A circular pupil of diameter D sends 2 lambda / (pi² D r) beyond an angle r.
        """
        narrowest_mm = 2.0 * float(self.pupil_ellipse[3])
        mrad = 2.0 * self.wavelength_nm / 1e3 / (math.pi**2 * narrowest_mm * ratio)
        return mrad * float(np.linalg.norm(self.pixel_from_mrad, ord=2))

    def edge_light(self, radius_px: int) -> NDArray[np.float64]:
        """Return the light (2R+1, 2R+1) diffracted at the edge, beside the spot.

        An element ds of the edge, with normal n and slope s, sends the share
        ``lambda ds / (4 pi² A d²)`` per distance d to each of the places s + d n and
        s - d n, where A is the area of the pupil.
        """
        points_mm, normals = self.edge(EDGE_POINTS)
        lengths_mm = np.linalg.norm(normals, axis=1)
        rays_px = self.rays_mrad(points_mm) @ self.pixel_from_mrad.T
        along_px = (normals / lengths_mm[:, None]) @ self.pixel_from_mrad.T
        area_mm2 = math.pi * self.pupil_ellipse[2] * self.pupil_ellipse[3]
        scale = self.wavelength_nm / 1e3 / (4.0 * math.pi**2 * area_mm2)  # mrad mm
        step_mrad = EDGE_STEP_PX / float(np.linalg.norm(self.pixel_from_mrad, ord=2))
        least = float(np.linalg.norm(self.pixel_from_mrad, ord=-2))
        end_mrad = (math.sqrt(2.0) * (radius_px + 1) + self.spot_px()) / least
        ends_mrad = step_mrad * np.arange(1, math.ceil(end_mrad / step_mrad) + 1)
        light = 1.0 / ends_mrad[:-1] - 1.0 / ends_mrad[1:]
        middle_mrad = (ends_mrad[:-1] + ends_mrad[1:]) / 2.0
        side = 2 * radius_px + 1
        image = np.zeros(side * side)
        for sign in (1.0, -1.0):
            x, y = (
                np.rint(rays_px[:, None, c] + sign * middle_mrad * along_px[:, None, c])
                for c in range(2)
            )
            inside = (np.abs(x) <= radius_px) & (np.abs(y) <= radius_px)
            place = (radius_px - y) * side + radius_px + x  # rows grow downward
            each = scale * lengths_mm[:, None] * light
            image += np.bincount(
                place[inside].astype(np.int64), each[inside], side * side
            )
        return image.reshape(side, side)

    def image(
        self, *, max_radius_px: int | None = None, workers: int = 1
    ) -> NDArray[np.float64]:
        """Return the share (2R+1, 2R+1) of the light in each pixel around the point.

        Parameters
        ----------
        max_radius_px : int, optional
            Largest R; by default all but `LEFT_OUT_RATIO` of the light is within R.
        workers : int
            Threads.
        """
        spot_px = self.spot_px()
        core_px, radius_px = (
            math.ceil(spot_px + self.edge_light_px(ratio)) + 1
            for ratio in (EDGE_LIGHT_RATIO, LEFT_OUT_RATIO)
        )
        if max_radius_px is not None:
            radius_px = min(radius_px, max_radius_px)
            core_px = min(core_px, radius_px)
        image = self.edge_light(radius_px)
        inner = slice(radius_px - core_px, radius_px + core_px + 1)
        image[inner, inner] = reference_kernel(
            self.zernike_um,
            pupil_diameter_mm=self.circle_diameter_mm,
            pupil_ellipse=self.pupil_ellipse,
            wavelength_nm=self.wavelength_nm,
            pixel_from_mrad=self.pixel_from_mrad,
            radius_px=core_px,
            workers=workers,
        )
        return image


def point_wavefronts(
    eye,
    camera,
    x_px: int,
    y_px: int,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    object_dpt: float,
    wavelengths_nm: tuple[float, ...],
    is_on_axis: bool = False,
    lateral_color: bool = False,
) -> list[PointWavefront]:
    """Return the wavefront of a pixel's center in each color.

    Parameters
    ----------
    eye : EyeOptics
    camera : Camera
        Whose axis is the eye's: the gaze is (0, 0).
    x_px, y_px : int
        Column and row of the pixel.
    focus_dpt, object_dpt : float
        Distances of focus and of the point from the entrance pupil.
    wavelengths_nm : (3,)
        Red, green, blue.
    is_on_axis : bool
        Whether the filter has the PSFs and the scale of the axis everywhere.
    lateral_color : bool
        Whether red and blue are displaced against green.
    """
    size_px = camera.width_px, camera.height_px
    h_deg = v_deg = 0.0
    if not is_on_axis:
        h_deg, v_deg = (
            float(angle)
            for angle in pinhole.direction_deg(
                *pinhole.tangents_at(
                    x_px + 0.5, y_px + 0.5, tangents=camera.tangents, size_px=size_px
                )
            )
        )
    place = {
        "h_deg": np.full(3, h_deg),
        "v_deg": np.full(3, v_deg),
        "accommodation_dpt": np.full(
            3, eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_diameter_mm)
        ),
        "wavelength_nm": np.array(wavelengths_nm, float),
    }
    state = place | {"pupil_diameter_mm": np.full(3, pupil_diameter_mm)}
    total_dpt = eye.total_defocus_dpt(**state) + eye.vergence.vergence_dpt(object_dpt)
    found = eye.wavefronts(**state, total_defocus_dpt=total_dpt)
    scale = pinhole.pixel_from_mrad(
        h_deg, v_deg, tangents=camera.tangents, size_px=size_px
    )
    points = [
        PointWavefront(
            np.array(found.zernike_um[k], float),
            float(found.circle_diameter_mm[k]),
            np.array(found.pupil_ellipse[k], float),
            float(wavelengths_nm[k]),
            scale,
        )
        for k in range(3)
    ]
    if not lateral_color:
        return points
    shift_mrad = eye.chief_ray_shift_mrad(**place)
    return [
        point.shifted(own - shift_mrad[1])
        for point, own in zip(points, shift_mrad, strict=True)
    ]
