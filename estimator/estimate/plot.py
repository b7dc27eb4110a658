"""Plot of an estimated eye's cross-section with traced rays."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.estimation import EstimatedEye
from estimator.optics import prescription as rx
from estimator.optics.raytrace import RayStatus, trace_rays
from estimator.optics.surfaces import EyeSurfaces, Surface, rotation_matrix
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import nm_from_index, norms, zernike_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HALF_HEIGHTS_MM = (5.5, 5.2, 4.5, 4.5)
"""Height above the axis up to which each surface is drawn."""

N_POINTS = 201
N_RAYS = 11
OBJECT_SIDE_MM = 5.0
"""Distance in front of the cornea, or of a lens, from which rays are drawn."""

LENS, LENS_HALF_HEIGHT_MM = "tab:blue", 8.0
IMPLANT, IMPLANT_HALF_HEIGHT_MM = "implant", 3.0
"""Medium of an intraocular lens, and half the diameter of its optic."""


def surface_line_mm(
    surface: Surface, *, half_height_mm: float, n_points: int = N_POINTS
) -> NDArray[np.float64]:
    """Return points (n, 2) of a surface in the plane x = 0 of its axes, as (z, y).

    Points beyond a closed conic's rim are omitted.
    """
    y_mm = np.linspace(-half_height_mm, half_height_mm, n_points)
    x_mm = np.zeros_like(y_mm)
    radius_y_mm = surface.radius_mm[1]
    root = 1.0 - (1.0 + surface.conic_constant) * (y_mm / radius_y_mm) ** 2
    inside = root >= 0.0
    x_mm, y_mm, root = x_mm[inside], y_mm[inside], root[inside]
    sag_mm = y_mm**2 / radius_y_mm / (1.0 + np.sqrt(root))
    sag_mm = sag_mm + _offset_mm(surface, y_mm)
    turn = rotation_matrix(rotation_deg=0.0, tilt_deg=surface.tilt_deg)
    points = np.stack([x_mm, y_mm, sag_mm], axis=-1) @ turn.T
    return np.stack(
        [points[:, 2] + surface.z_mm, points[:, 1] + surface.decentration_mm[1]],
        axis=-1,
    )


def _offset_mm(surface: Surface, y_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    if surface.offset_mm is None:
        return np.zeros_like(y_mm)
    angle_rad = math.radians(surface.rotation_deg)
    heights = y_mm / surface.offset_radius_mm
    values = zernike_values(
        heights * math.sin(angle_rad), heights * math.cos(angle_rad)
    )
    return values @ (np.asarray(surface.offset_mm) / norms())


def plot_eye(found: EstimatedEye, path: Path, *, focus_dpt: float = 0.0) -> None:
    """Plot the eye's vertical section, rays from infinity, and its coefficients.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    from matplotlib.figure import Figure  # loads slowly

    focused = found.focused(focus_dpt)
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    section, bars = figure.subplots(1, 2, width_ratios=(3, 2))
    draw_section(
        section, focused.surfaces, pupil_diameter_mm=found.profile.pupil_diameter_mm
    )
    section.set_title(
        f"{found.name}: {focused.parameters.eye_length_mm:.2f} mm long, "
        f"M {found.refraction_dpt:+.2f} dpt, focus {focused.focus_dpt:.2f} dpt",
        parse_math=False,  # a name may contain $
    )
    _draw_coefficients(bars, found)
    figure.savefig(path, dpi=130)


def draw_section(
    axes: "Axes",
    eye: EyeSurfaces,
    *,
    pupil_diameter_mm: float,
    lens: rx.Prescription | None = None,
) -> None:
    """Draw the vertical section of an eye and rays from infinity into matplotlib axes.

    Parameters
    ----------
    pupil_diameter_mm : float
        Diameter of the ray bundle in front of the cornea.
    lens : Prescription, optional
        Thin lens in front of the eye that the rays pass.
    """
    medium = ""
    for surface, half_height_mm in zip(eye.surfaces, HALF_HEIGHTS_MM, strict=True):
        is_implant = IMPLANT in (medium, surface.medium_after)
        medium = surface.medium_after
        if is_implant:
            half_height_mm = IMPLANT_HALF_HEIGHT_MM
        line = surface_line_mm(surface, half_height_mm=half_height_mm)
        color, width = (LENS, 1.8) if is_implant else ("0.2", 1.3)
        axes.plot(line[:, 0], line[:, 1], color=color, lw=width)
    _draw_retina(axes, eye)
    for sign in (-1.0, 1.0):
        y_mm = sign * np.array([pupil_diameter_mm / 2.0 / 1.13, 5.6])
        axes.plot([eye.stop_z_mm] * 2, y_mm, color="tab:brown", lw=2.5)
    if lens is not None:
        _draw_lens(axes, lens)
    for path in ray_paths_mm(eye, pupil_diameter_mm=pupil_diameter_mm, lens=lens):
        axes.plot(path[:, 2], path[:, 1], color="tab:red", lw=0.6)
    axes.set_aspect("equal")
    axes.set_xlabel("z, mm (into the eye)")
    axes.set_ylabel("y, mm (up)")


def _draw_lens(axes: "Axes", lens: rx.Prescription) -> None:
    """Draw the symbol of a thin lens: arrowheads point outward for positive power."""
    z_mm = -lens.vertex_mm
    axes.plot([z_mm] * 2, [-LENS_HALF_HEIGHT_MM, LENS_HALF_HEIGHT_MM], color=LENS, lw=2)
    markers = ("v", "^") if _vertical_power_dpt(lens)[0] >= 0.0 else ("^", "v")
    for y_mm, marker in zip(
        (-LENS_HALF_HEIGHT_MM, LENS_HALF_HEIGHT_MM), markers, strict=True
    ):
        axes.plot([z_mm], [y_mm], marker, color=LENS, markersize=5)


def _vertical_power_dpt(lens: rx.Prescription) -> tuple[float, float]:
    """Return the power along the vertical at the lens, and that across it."""
    m_dpt, j0_dpt, j45_dpt = rx.power_vector(replace(lens, vertex_mm=0.0))
    return m_dpt - j0_dpt, j45_dpt


def _draw_retina(axes: "Axes", eye: EyeSurfaces) -> None:
    retina = eye.retina
    radius_mm = abs(float(np.ravel(retina.radius_mm)[-1]))
    stretch = 1.0 + retina.conic_constant
    if stretch <= 0.0:
        y_mm = np.linspace(-11.0, 11.0, N_POINTS)
        root = np.sqrt(1.0 - stretch * (y_mm / radius_mm) ** 2)
        z_mm = retina.z_mm - y_mm**2 / radius_mm / (1.0 + root)
    else:
        angles = np.linspace(-0.7 * math.pi, 0.7 * math.pi, N_POINTS)
        along_mm, across_mm = radius_mm / stretch, radius_mm / math.sqrt(stretch)
        z_mm = retina.z_mm - along_mm * (1.0 - np.cos(angles))
        y_mm = across_mm * np.sin(angles)
    axes.plot(z_mm, y_mm, color="0.2", lw=1.3)


def _draw_coefficients(axes: "Axes", found: EstimatedEye) -> None:
    index = np.arange(3, found.zernike_um.size)
    measured_um = found.zernike_um - found.residual_um
    axes.bar(index - 0.2, measured_um[3:], 0.4, label="measured", color="0.6")
    axes.bar(index + 0.2, found.zernike_um[3:], 0.4, label="eye", color="tab:blue")
    labels = ["{},{}".format(*nm_from_index(int(j))) for j in index]
    axes.set_xticks(index, labels, rotation=90, fontsize=7)
    axes.set_ylabel("um")
    axes.set_title(f"mean error {found.mean_abs_error_um:.1e} um")
    axes.legend()


def ray_paths_mm(
    eye: EyeSurfaces,
    *,
    pupil_diameter_mm: float,
    lens: rx.Prescription | None = None,
    n_rays: int = N_RAYS,
) -> list[NDArray[np.float64]]:
    """Return paths (n_points, 3) of rays from infinity to the retina, plane x = 0.

    Rays that do not pass are omitted.

    Parameters
    ----------
    lens : Prescription, optional
        Thin lens that the rays pass first.
    """
    heights_mm = np.linspace(-0.5, 0.5, n_rays) * pupil_diameter_mm
    start_mm, direction = np.zeros((2, n_rays, 3))
    start_mm[:, 1], start_mm[:, 2] = heights_mm, -OBJECT_SIDE_MM
    direction[:, 2] = 1.0
    infinity_mm = start_mm.copy()
    if lens is not None:
        along_dpt, across_dpt = _vertical_power_dpt(lens)
        start_mm[:, 2] = -lens.vertex_mm
        infinity_mm[:, 2] -= lens.vertex_mm
        direction[:, 0] = -heights_mm / 1000.0 * across_dpt
        direction[:, 1] = -heights_mm / 1000.0 * along_dpt
    traced = trace_rays(
        eye,
        start_mm=start_mm,
        direction=direction,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
    )
    passed = traced.status_index == RayStatus.TRACED
    return [
        np.concatenate([infinity[None], start[None], points])
        for infinity, start, points in zip(
            infinity_mm[passed], start_mm[passed], traced.points_mm[passed], strict=True
        )
    ]
