"""Worker process for figures of an eye and for point-spread functions.

Estimating and tracing an eye holds the GIL for tenths of a second, which in the page's
own process would block its event loop and its frames.
"""

from __future__ import annotations

import asyncio
import io
import json
import math
import multiprocessing
import os
from collections.abc import Awaitable, Callable, Sequence
from functools import lru_cache
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from clients.figures import (
    EyeStudy,
    PupilWavefront,
    cross_section_figure,
    draw_acuity_of_several,
    draw_mtf,
    draw_mtf_of_several,
    draw_through_focus_acuity,
    draw_wavefront_map,
    wavefront_range_um,
)
from clients.figures.curves import blur_arcmin, draw_field_map
from clients.figures.style import new_figure
from clients.web.comparison import joined_png
from clients.web.picture import png_of
from clients.web.sight import sight_numbers
from estimator import (
    EyeOptics,
    Rings,
    compute_psfs,
    parse_profile,
    prepare_eye,
    thread_count,
)
from filter_service import FilterError

THREADS_VARIABLE = "OCUFILTER_THREADS"
DOTS_PER_INCH = 220
FIGURE_TITLES = {
    "wavefront": "Wavefront",
    "field": "Field",
    "section": "Section",
    "acuity": "Acuity",
    "contrast": "Contrast",
}
OVERLAID = {"acuity": draw_acuity_of_several, "contrast": draw_mtf_of_several}
"""Figures of two eyes in one diagram; others are beside each other."""

AXIS_PT = 8.0

SIDE_PX = 129
SHOWN_PX = 516
WAVELENGTHS_NM = (618.0, 536.0, 453.0)
"""Red, green and blue of the display that shows the picture."""

PUPILS_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
FOCUS_RANGE_DPT = (0.0, 8.0)
FIELD_DEG = ((-45.0, 45.0), (-35.0, 35.0))
MIN_SIDE_ARCMIN = 12.0
SIDE_RATIO = 3.2
"""Ratio of the image side to the radius of the blur."""

RINGS_SIDE_RATIO = 2.2
"""Ratio of the image side to the radius of the light of another focus."""

GAMMA = 0.45
"""Exponent of the displayed light, which makes faint parts visible."""

WHITE_PERCENT = 99.9
"""Percentile of the light that is shown as white; scaled to the peak, the rest would be
black."""

ARCMIN_PER_MRAD = 60.0 * math.degrees(1e-3)
NICE_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300)

NICENESS = 10
"""Pictures have priority over figures."""


Ask = Callable[..., Awaitable[Any]]
"""`FigureWorker.ask` for one page."""


class FigureFailed(Exception):
    """Raised when the function fails or the worker process ends."""


class FigureWorker:
    """One worker process.

    A newer request of the same page and kind replaces one that is still waiting.
    """

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], int] = {}
        self._lock = asyncio.Lock()
        self._is_over = False
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        # not a daemon: a report starts its own worker
        self._process = context.Process(
            target=_serve_requests, args=(theirs, thread_count())
        )
        self._process.start()
        theirs.close()

    async def ask(
        self,
        page: str,
        kind: str,
        function: Callable[..., Any],
        *args: Any,
        **options: Any,
    ) -> Any:
        """Return the function's result; None if a newer request superseded it.

        Raises
        ------
        FigureFailed
            If the function failed or the process ended.
        """
        key = (page, kind)
        number = self._newest.get(key, 0) + 1
        self._newest[key] = number
        async with self._lock:  # one at a time, so that waiting requests can be dropped
            if self._newest.get(key) != number:
                return None
            return await asyncio.to_thread(self._exchange, (function, args, options))

    def _exchange(
        self, request: tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]
    ) -> Any:
        try:
            self._connection.send(request)
            result, error_text = self._connection.recv()
        except (EOFError, OSError):
            if not self._is_over:
                self._start()
            raise FigureFailed(
                "The process that draws figures ended and was restarted"
            ) from None
        if error_text is not None:
            raise FigureFailed(error_text)
        return result

    def forget(self, page: str) -> None:
        """Drop a page's requests."""
        for key in [key for key in self._newest if key[0] == page]:
            del self._newest[key]

    def close(self) -> None:
        """Terminate the process, whatever it is drawing."""
        self._is_over = True  # a pending request must not restart the process
        self._process.terminate()
        self._process.join()


def _serve_requests(connection: Connection, n_threads: int) -> None:
    """Handle requests until the parent process ends, on as many threads as it has."""
    os.environ.setdefault(THREADS_VARIABLE, str(n_threads))
    os.nice(NICENESS)
    while True:
        try:
            connection.send(_call(*connection.recv()))
        except (EOFError, OSError):
            return


def _call(
    function: Callable[..., Any], args: tuple[Any, ...], options: dict[str, Any]
) -> tuple[Any, str | None]:
    """Return a result, or an error message, as some exceptions cannot be pickled."""
    try:
        return function(*args, **options), None
    except (ValueError, FilterError) as error:
        return None, str(error)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"


@lru_cache(maxsize=8)
def _study(body: str) -> EyeStudy:
    return EyeStudy.of(json.loads(body))


def eye_figures(
    name: str,
    bodies: Sequence[str],
    labels: Sequence[str],
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
) -> bytes:
    """Return a figure of one or two eyes as a PNG: overlaid curves, or two pictures.

    Parameters
    ----------
    name : one of `FIGURE_TITLES`
    bodies : profile of each eye as JSON
    labels : name of each eye
    """
    if len(bodies) == 2 and name in OVERLAID:
        figure = new_figure(150.0, 95.0)
        studies = [_study(body) for body in bodies]
        OVERLAID[name](
            figure.subplots(), studies, labels=labels, pupil_mm=pupil_diameter_mm
        )
        return _png(figure)
    state = {"pupil_diameter_mm": pupil_diameter_mm, "focus_dpt": focus_dpt}
    if name == "wavefront":
        waves = [_wavefront(body, **state) for body in bodies]
        state["range_um"] = max(wavefront_range_um(w.zernike_um) for w in waves)
        if len(bodies) > 1:
            labels = [f"{label} (same colors)" for label in labels]
    pictures = [eye_figure(name, body, **state) for body in bodies]
    return pictures[0] if len(pictures) == 1 else joined_png(pictures, labels)


def _png(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


def _wavefront(
    body: str, *, pupil_diameter_mm: float, focus_dpt: float
) -> PupilWavefront:
    """Return the wavefront of an eye for the distance that it looks at."""
    return _study(body).wavefront(
        pupil_diameter_mm, object_dpt=focus_dpt, focus_dpt=focus_dpt
    )


def eye_figure(
    name: str,
    body: str,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    range_um: float | None = None,
) -> bytes:
    """Return a figure of one eye as a PNG.

    Parameters
    ----------
    name : one of `FIGURE_TITLES`
    body : str
        The profile as JSON, which is the cache key of the eye.
    range_um : float, optional
        Upper end of the color scale of a wavefront.
    """
    study = _study(body)
    if name == "field":
        figure = _field_figure(study)
    elif name == "section":
        figure = cross_section_figure(study)
    elif name == "acuity":
        figure = new_figure(95.0, 90.0)
        axes = figure.subplots()
        draw_through_focus_acuity(axes, study, pupils_mm=[pupil_diameter_mm])
    elif name == "contrast":
        figure = new_figure(95.0, 75.0)
        draw_mtf(figure.subplots(), study)
    else:
        seen = _wavefront(
            body, pupil_diameter_mm=pupil_diameter_mm, focus_dpt=focus_dpt
        )
        figure = new_figure(95.0, 75.0)
        draw_wavefront_map(
            figure.subplots(),
            seen.zernike_um,
            radius_mm=seen.circle_diameter_mm / 2.0,
            eye_side=study.profile.eye_side,
            title=f"Focused at {focus_dpt:.2f} dpt",
            range_um=range_um,
        )
    return _png(figure)


def predicted_sight(body: str, **state: float) -> dict[str, Any]:
    """Return the acuity of an eye at a distance: see `sight_numbers`."""
    return sight_numbers(_study(body), **state)


def _field_figure(study: EyeStudy) -> Figure:
    """Return refraction and blur over the visual field, from the person's view."""
    figure = new_figure(90.0, 98.0)
    upper, lower = figure.subplots(2, 1)
    m_dpt = study.field.power_dpt.T[0]
    draw_field_map(
        upper,
        m_dpt,
        title="Refraction M",
        label="dpt",
        middle=float(m_dpt[m_dpt.size // 2]),
    )
    blur = blur_arcmin(study)
    draw_field_map(lower, blur, title="Blur, focused far", label="arcmin, RMS")
    for axes in (upper, lower):
        axes.set_ylabel("up, deg", fontsize=AXIS_PT)
    lower.set_xlabel("right, deg", fontsize=AXIS_PT)
    return figure


@lru_cache(maxsize=8)
def _eye(body: str) -> EyeOptics:
    eye, _ = prepare_eye(
        parse_profile(json.loads(body)),
        pupil_diameters_mm=PUPILS_MM,
        focus_range_dpt=FOCUS_RANGE_DPT,
        wavelengths_nm=WAVELENGTHS_NM,
        field_range_deg=FIELD_DEG,
    )
    return eye


def point_spread(
    body: str,
    *,
    direction_deg: tuple[float, float],
    object_dpt: float,
    pupil_diameter_mm: float,
    focus_dpt: float,
) -> tuple[bytes, dict[str, Any]]:
    """Return an image (PNG) of the point-spread function, and its measures.

    Parameters
    ----------
    body : str
        The profile as JSON, which is the cache key of the eye.
    direction_deg : (float, float)
        Azimuth and elevation in the eye's field.
    """
    eye = _eye(body)
    pupil_mm = eye.usable_pupil_mm(pupil_diameter_mm)
    accommodation_dpt = eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm)
    kernels, side_arcmin = _kernels(
        eye, direction_deg, object_dpt, pupil_mm, accommodation_dpt
    )
    light = np.stack(kernels, axis=-1)
    picture = _picture(light / np.percentile(light, WHITE_PERCENT), side_arcmin)
    facts = {
        "h_deg": direction_deg[0],
        "v_deg": direction_deg[1],
        "object_dpt": object_dpt,
        "half_light_arcmin": half_light_px(kernels[1]) * side_arcmin / SIDE_PX,
    }
    return png_of(picture), facts


def _kernels(
    eye: EyeOptics,
    direction_deg: tuple[float, float],
    object_dpt: float,
    pupil_mm: float,
    accommodation_dpt: float,
) -> tuple[list[NDArray[np.float32]], float]:
    """Return the PSF of each color, and the side of their images in arcmin."""
    h_deg, v_deg = (
        min(max(angle, low), high)
        for angle, (low, high) in zip(direction_deg, FIELD_DEG, strict=True)
    )
    state_in_field: dict[str, Any] = {
        "h_deg": h_deg,
        "v_deg": v_deg,
        "pupil_diameter_mm": pupil_mm,
        "accommodation_dpt": accommodation_dpt,
        "wavelength_nm": np.array(WAVELENGTHS_NM),
    }
    defocus_dpt = eye.total_defocus_dpt(**state_in_field)
    defocus_dpt = defocus_dpt + eye.vergence.vergence_dpt(object_dpt)
    waves = eye.wavefronts(**state_in_field, total_defocus_dpt=defocus_dpt)
    rings = eye.rings and eye.rings.seen_from(h_deg, v_deg)
    rings_mrad = _rings_reach_mrad(rings, pupil_mm / 2.0)
    side_arcmin = _side_arcmin(
        waves.zernike_um, waves.circle_diameter_mm, rings_mrad=rings_mrad
    )
    pixel_pitch_mrad = side_arcmin / SIDE_PX / ARCMIN_PER_MRAD
    return [
        _kernel(
            waves.zernike_um[k : k + 1],
            rings,
            pupil_diameter_mm=float(waves.circle_diameter_mm[k]),
            pupil_ellipse=waves.pupil_ellipse[k],
            wavelength_nm=wavelength_nm,
            pixel_pitch_mrad=pixel_pitch_mrad,
            radius_px=SIDE_PX // 2,
        )
        for k, wavelength_nm in enumerate(WAVELENGTHS_NM)
    ], side_arcmin


def _rings_reach_mrad(rings: Rings | None, radius_mm: float) -> float:
    """Return the deflection by rings toward their foci, or the total by lenslets."""
    if rings is None:
        return 0.0
    if rings.lattice_mm is not None:
        return float(rings.reach_mrad(radius_mm, WAVELENGTHS_NM[0]))
    return float(np.abs(rings.main_dpt(WAVELENGTHS_NM[0])).max() * radius_mm)


def _kernel(
    zernike_um: NDArray[np.float64], rings: Rings | None, **state: Any
) -> NDArray[np.float32]:
    """Return one PSF, by the wave method where possible.

    A combination of both methods has visible seams where light is faint.
    """
    try:
        found = compute_psfs(
            zernike_um, method="fourier", accuracy="fine", pupil_screen=rings, **state
        )
    except ValueError:  # too steep: the blur is far wider than the effect of rings
        found = compute_psfs(zernike_um, **state)
    return found[0].kernel


def _side_arcmin(
    zernike_um: NDArray[Any], diameter_mm: NDArray[Any], *, rings_mrad: float
) -> float:
    """Return the image side for the widest color, rounded up to a fixed scale.

    The blur's radius at the edge of the pupil is about that of its RMS slope: sqrt(2)
    times the slope that the second-order terms make.
    """
    radius_mm = np.asarray(diameter_mm) / 2.0
    spread = np.sqrt((np.asarray(zernike_um)[:, 3:] ** 2).sum(axis=1))
    reach_mrad = 4.0 * math.sqrt(3.0) * spread / radius_mm
    widest_mrad = SIDE_RATIO * float(reach_mrad.max())
    wanted = max(widest_mrad, RINGS_SIDE_RATIO * rings_mrad) * ARCMIN_PER_MRAD
    steps = math.ceil(4.0 * math.log2(max(wanted, MIN_SIDE_ARCMIN)))
    return 2.0 ** (steps / 4.0)


def half_light_px(kernel: NDArray[np.float32]) -> float:
    """Return the radius about the centroid that contains half of the light, px."""
    y, x = np.indices(kernel.shape)
    total = kernel.sum()
    middle_x, middle_y = (x * kernel).sum() / total, (y * kernel).sum() / total
    radius = np.hypot(x - middle_x, y - middle_y).ravel()
    order = np.argsort(radius)
    within = np.cumsum(kernel.ravel()[order]) / total
    return float(radius[order][np.searchsorted(within, 0.5)])


def _picture(light: NDArray[np.floating[Any]], side_arcmin: float) -> NDArray[np.uint8]:
    """Return light (n, n, 3), 0 to 1, enlarged, with a scale bar."""
    shown = np.round(255.0 * np.clip(light, 0.0, 1.0) ** GAMMA).astype(np.uint8)
    image = Image.fromarray(shown).resize(
        (SHOWN_PX, SHOWN_PX), Image.Resampling.BICUBIC
    )
    length = max(a for a in NICE_ARCMIN if a <= 0.4 * side_arcmin)
    draw = ImageDraw.Draw(image)
    length_px, edge, low = length / side_arcmin * SHOWN_PX, 24, SHOWN_PX - 28
    draw.line([(edge, low), (edge + length_px, low)], fill="white", width=4)
    font = ImageFont.load_default(26)
    draw.text((edge, low - 38), f"{length} arcmin", fill="white", font=font)
    return np.asarray(image)
