"""What references and baselines filter: an eye in a state, and the pixels of a view."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfBatch, compute_psf_batch
from filter_service.planning.grid import GridSpec, field_deg
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rgbd_view import RgbdView

ANGLE_BIN_DEG = 0.2
DISTANCE_BIN_DPT = 0.005


@dataclass(frozen=True)
class EyeState:
    """An eye before a camera, at one pupil and focus.

    Attributes
    ----------
    eye : EyeOptics
    spec : GridSpec
        Camera, gaze, wavelengths, and whether PSFs follow the field; its grid settings
        do not matter here.
    pupil_diameter_mm, focus_dpt : float
    """

    eye: EyeOptics
    spec: GridSpec
    pupil_diameter_mm: float
    focus_dpt: float

    def wavefront_arguments(
        self, h_deg: NDArray, v_deg: NDArray, distance_dpt: NDArray
    ) -> dict[str, NDArray]:
        """Arguments (3 n) of `EyeOptics.wavefronts` for n places, channel fastest."""
        h_deg, v_deg, distance_dpt = (
            np.repeat(np.ravel(values).astype(float), 3)
            for values in np.broadcast_arrays(h_deg, v_deg, distance_dpt)
        )
        state = {
            "h_deg": h_deg,
            "v_deg": v_deg,
            "pupil_diameter_mm": np.full(h_deg.size, self.pupil_diameter_mm),
            "accommodation_dpt": np.full(
                h_deg.size,
                self.eye.accommodation_dpt(
                    self.focus_dpt, pupil_diameter_mm=self.pupil_diameter_mm
                ),
            ),
            "wavelength_nm": np.tile(self.spec.channel_wavelengths_nm, h_deg.size // 3),
        }
        at_infinity_dpt = self.eye.total_defocus_dpt(**state)
        added_dpt = self.eye.vergence.vergence_dpt(distance_dpt)
        return state | {"total_defocus_dpt": at_infinity_dpt + added_dpt}

    def exact_psfs(
        self,
        h_deg: NDArray,
        v_deg: NDArray,
        distance_dpt: NDArray,
        *,
        samples_per_px: int = 1,
        max_radius_px: int = 255,
    ) -> PsfBatch:
        """PSFs (3 n) of n places in the field, channel fastest.

        Parameters
        ----------
        samples_per_px : int
            Finer rasters, for baselines that resample PSFs.
        """
        arguments = self.wavefront_arguments(h_deg, v_deg, distance_dpt)
        found = self.eye.wavefronts(**arguments)
        scale = self.spec.pixel_from_mrad(arguments["h_deg"], arguments["v_deg"])
        return compute_psf_batch(
            found.zernike_um,
            pupil_diameter_mm=found.circle_diameter_mm,
            pupil_ellipse=found.pupil_ellipse,
            wavelength_nm=arguments["wavelength_nm"],
            pixel_from_mrad=samples_per_px * scale,
            diffraction=self.spec.settings.diffraction,
            max_radius_px=max_radius_px * samples_per_px,
        )


@dataclass(frozen=True)
class Sources:
    """Pixels of a view in scan order.

    Attributes
    ----------
    color : (n, 3)
        Linear light.
    h_deg, v_deg, distance_dpt : (n,)
        Place in the visual field; directions are 0 where PSFs do not follow it.
    """

    color: NDArray[np.float64]
    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    distance_dpt: NDArray[np.float64]

    def near_first(self) -> NDArray[np.int64]:
        """Order (n,) in which sources hide each other; ties in scan order."""
        return np.argsort(-self.distance_dpt, kind="stable")


def linear_color(view: RgbdView) -> NDArray[np.float64]:
    """Linear light (height, width, 3) of a view."""
    if view.color.dtype == np.uint8:
        return linear_from_srgb(view.color)
    return view.color.astype(np.float64)


@dataclass(frozen=True)
class Window:
    """Part of a picture whose filtered pixels are wanted.

    Attributes
    ----------
    x, y, width_px, height_px : int
        First column and row, and how many.
    """

    x: int
    y: int
    width_px: int
    height_px: int

    def of(self, picture: NDArray) -> NDArray:
        """Cut it out of a picture (height, width, ...)."""
        return picture[self.y :, self.x :][: self.height_px, : self.width_px]

    def distance_px(self, rows: NDArray, columns: NDArray) -> NDArray[np.int64]:
        """How many columns or rows pixels lie outside, the larger of both; 0 inside."""
        beside = np.maximum(self.x - columns, columns - (self.x + self.width_px - 1))
        above = np.maximum(self.y - rows, rows - (self.y + self.height_px - 1))
        return np.maximum(np.maximum(beside, above), 0)


def view_sources(view: RgbdView, spec: GridSpec) -> Sources:
    """Colour, direction and distance of every pixel."""
    depth_m, _ = fill_missing_depth(view.depth_m)
    distance_dpt = object_dpt(view, depth_m).ravel()
    h_deg = v_deg = np.zeros(distance_dpt.size)
    if spec.follows_field:
        y, x = np.mgrid[0 : view.height_px, 0 : view.width_px]
        h_deg, v_deg = (
            angle.ravel()
            for angle in field_deg(
                spec.camera, x + 0.5, y + 0.5, gaze_deg=spec.settings.gaze_deg
            )
        )
    return Sources(linear_color(view).reshape(-1, 3), h_deg, v_deg, distance_dpt)


def binned(sources: Sources) -> Sources:
    """Sources whose PSFs are those of the middle of their bin; colours stay."""

    def middle(values: NDArray, step: float) -> NDArray[np.float64]:
        return np.round(values / step) * step

    return replace(
        sources,
        h_deg=middle(sources.h_deg, ANGLE_BIN_DEG),
        v_deg=middle(sources.v_deg, ANGLE_BIN_DEG),
        distance_dpt=middle(sources.distance_dpt, DISTANCE_BIN_DPT),
    )
