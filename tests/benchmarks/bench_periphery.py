"""Merging that follows the gaze: time and work saved, errors and flicker.

The courtyard, the primitives and a photograph with depth, as in a headset (96 degrees)
and on a desktop (50 degrees, vertically), through three eyes, 8-bit sRGB in and out.
The viewer looks straight ahead; pupil and focus change with every frame.  Frames with
the option `peripheral_merging` alternate with those without, so that both meet the same
load; ``time_ratio`` is the median of their pairs.  Evaluations are those of the splat
pass (splat_work); the engine gl filters the courtyard through two eyes.

Errors, against frames without merging: PSNR in linear light, and where the difference
would be detected: its contrast in octaves around 8, 4, 2 and 1 c/deg, relative to the
local mean (a Gaussian of half a degree), over the threshold of Virsu & Rovamo 1979 in
the fovea, which grows by 0.031 decades per degree from the gaze at 1 c/deg (Virsu et
al. 1982) and by 0.043 above (`filter_service/rendering/frame.py`).
``detected_percent`` are the pixels beyond the margin above the threshold, and
``direct_percent`` those of the default if the viewer looked at each of them directly.

Flicker, in two scenes as in a headset: the same picture while only the gaze moves, the
difference of consecutive frames by the same measure: tracker errors of 1 degree RMS,
pursuit at 10 deg/s and 72 Hz, and the frame after a saccade of 15 degrees
(``flicker``).
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from estimator.profiles.parse import parse_profile
from filter_service.constants import DETECTION_MARGIN_DEG
from filter_service.gl.gpu import Gpu
from filter_service.planning.grid import unit_direction
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import PsfStore, build_psf_store
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer
from filter_service.rendering.native.frame_record import FrameRecord
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.frame_runs import states_towards
from tests.benchmarks.gpu_cases import EYES, FOCUS_DPT, PUPIL_MM
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.photograph import motorcycle
from tests.benchmarks.rows import row_of
from tests.benchmarks.splat_work import splat_work
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db, tangents

MINUTES = 3
SCENES = ("courtyard", "primitives", "photograph")
SIZES = {"1832x1920": ((1832, 1920), 96.0), "1280x720": ((1280, 720), 50.0)}
HEADSET = "1832x1920"
GL_CASES = (("courtyard", "emmetropia"), ("courtyard", "-6 dpt"))
"""A frame takes seconds on llvmpipe, whose memory does not suffice for keratoconus."""

QUICK_SIZES = {"96x100": ((96, 100), 96.0)}
GL_SIZES = (HEADSET, *QUICK_SIZES)
FLICKER_SCENES = {HEADSET: ("courtyard", "photograph"), "96x100": ("courtyard",)}
QUICK_SCENES = SCENES[:2]
"""Those without a photograph, which comes with scikit-image."""

GAZE_DEG = (0.0, 0.0)
LUMINANCE = (0.2126, 0.7152, 0.0722)
FOVEAL_SENSITIVITY = {8.0: 246.0, 4.0: 334.0, 2.0: 334.0, 1.0: 260.0}
"""By c/deg, at 10 cd/m2 (Virsu & Rovamo 1979)."""

DECADES_PER_DEG = {8.0: 0.043, 4.0: 0.043, 2.0: 0.043, 1.0: 0.031}
SIGMA_CYCLES = 0.265
"""Standard deviation of a Gaussian that halves a grating, in its periods."""

DARKEST = 0.002
"""Of white: the light that a display leaves in black."""


@dataclass(frozen=True)
class PeripheryRow(Row):
    """Time and error of frames, and what they save; ratios are to the default."""

    time_ratio: float
    fragment_ratio: float
    entry_ratio: float
    texel_ratio: float
    evaluation_ratio: float | None
    near_db: float
    detected_percent: float
    direct_percent: float


@dataclass(frozen=True)
class Scene:
    """A picture, the eye's PSFs for it, and its name."""

    eye: str
    name: str
    size: str
    view: RgbdView
    store: PsfStore

    @property
    def pixels_per_deg(self) -> float:
        """On the axis."""
        up, down = self.view.tangents[2:]
        return float(np.radians(self.view.height_px / (up - down)))

    def eccentricity_deg(self, gaze_deg: tuple[float, float]) -> NDArray[np.float64]:
        """Angles (h, w) of the pixels from a gaze."""
        left, right, up, down = self.view.tangents
        width, height = self.view.width_px, self.view.height_px
        x = left + (np.arange(width) + 0.5) / width * (right - left)
        y = up + (np.arange(height) + 0.5) / height * (down - up)
        sources = np.stack(np.broadcast_arrays(x, y[:, None], -1.0), axis=-1)
        sources /= np.linalg.norm(sources, axis=-1, keepdims=True)
        cosine = np.minimum(sources @ unit_direction(*gaze_deg), 1.0)
        return np.degrees(np.arccos(cosine))


def view_of(name: str, size_px: tuple[int, int], fov_deg: float) -> RgbdView:
    """Return a scene, or the middle of the photograph, at a size and field of view."""
    width_px, height_px = size_px
    if name != "photograph":
        return scene_view(name, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    color, depth_m = motorcycle(width_px, height_px)
    top, left = (color.shape[0] - height_px) // 2, (color.shape[1] - width_px) // 2
    part = slice(top, top + height_px), slice(left, left + width_px)
    return RgbdView(
        color[part].copy(), depth_m[part].copy(), tangents(*size_px, fov_deg)
    )


def scenes_of(names: tuple[str, ...], sizes: dict, eyes: dict) -> Iterator[Scene]:
    """Yield each scene through each eye."""
    for size, (size_px, fov_deg) in sizes.items():
        views = {name: view_of(name, size_px, fov_deg) for name in names}
        for eye, profile in eyes.items():
            spec = grid_spec(
                width_px=size_px[0],
                height_px=size_px[1],
                tangents=views["courtyard"].tangents,
                pupil_range_mm=(4.0, 5.0),
                focus_range_dpt=(0.0, 1.0),
                mode="dynamic",
            )
            traced, _ = eye_for_spec(parse_profile(profile), spec)
            store = build_psf_store(traced, spec)
            for name, view in views.items():
                yield Scene(eye, name, size, view, store)


@contextmanager
def merged_for_a_display() -> Iterator[None]:
    """Merge linear output of the native engine as if it were encoded: no rounding."""
    plain = FrameRecord.set_merging

    def encoded(self, *arguments, **values):
        plain(self, *arguments, **{**values, "is_encoded": True})

    FrameRecord.set_merging = encoded
    try:
        yield
    finally:
        FrameRecord.set_merging = plain


def detectability(
    image: NDArray, other: NDArray, eccentricity_deg, pixels_per_deg: float
) -> NDArray[np.float64]:
    """Largest contrast (h, w) of a difference over the threshold."""
    rest = (image - other) @ LUMINANCE
    mean = gaussian_filter(other @ LUMINANCE, 0.5 * pixels_per_deg)
    worst = np.zeros_like(rest)
    for cpd, sensitivity in FOVEAL_SENSITIVITY.items():
        low = gaussian_filter(rest, SIGMA_CYCLES * pixels_per_deg / cpd)
        contrast = np.abs(rest - low) / np.maximum(mean, DARKEST)
        decades = DECADES_PER_DEG[cpd] * eccentricity_deg
        worst = np.maximum(worst, contrast * sensitivity * 10.0**-decades)
        rest = low
    return worst


class Errors:
    """Errors of the native engine's frames of a scene."""

    def __init__(self, scene: Scene, renderer: NativeRenderer, handle) -> None:
        self.scene, self._renderer, self._handle = scene, renderer, handle
        self._exact = self.frame(merge=False)
        self._default = self.frame()

    def frame(self, **options) -> NDArray[np.float64]:
        """Return a frame in linear light."""
        options = {"gaze_deg": GAZE_DEG, **options}
        with merged_for_a_display():
            seen = self._renderer.render(
                self.scene.view,
                self._handle,
                pupil_diameter_mm=PUPIL_MM,
                focus_dpt=FOCUS_DPT,
                **options,
            )
        return seen.color.astype(np.float64)

    def measure(self, **options) -> dict[str, float]:
        """Return the errors of frames with some options, as in `PeripheryRow`."""
        image = self.frame(**options)
        angle_deg = self.scene.eccentricity_deg(GAZE_DEG)
        scale = self.scene.pixels_per_deg
        far, near = angle_deg >= DETECTION_MARGIN_DEG, angle_deg < DETECTION_MARGIN_DEG
        seen = detectability(image, self._exact, angle_deg, scale)
        direct = detectability(self._default, self._exact, 0.0, scale)
        return {
            "error": psnr_db(image, self._exact),
            "near_db": psnr_db(image[near], self._exact[near]),
            "detected_percent": 100.0 * float(np.mean(seen[far] > 1.0)),
            "direct_percent": 100.0 * float(np.mean(direct[far] > 1.0)),
        }

    def flicker(self) -> Iterator[dict]:
        """Yield the differences of consecutive frames for each movement of the gaze."""
        rng = np.random.default_rng(1)
        around = [tuple(angles) for angles in rng.normal(0.0, 1.0, (6, 2)).tolist()]
        movements = {  # gazes as told, and where the viewer looks
            "tracker error of 1 deg RMS": (around, [GAZE_DEG] * len(around)),
            "pursuit at 10 deg/s": ([(k * 10.0 / 72.0, 0.0) for k in range(6)], None),
            "saccade of 15 deg": ([(0.0, 0.0), (15.0, 0.0)], None),
        }
        for name, (told, true) in movements.items():
            last, detected, db = None, [], []
            for gaze_deg, own_deg in zip(told, true or told, strict=True):
                image = self.frame(gaze_deg=gaze_deg, peripheral_merging=True)
                if last is not None:
                    angle_deg = self.scene.eccentricity_deg(own_deg)
                    scale = self.scene.pixels_per_deg
                    seen = detectability(image, last, angle_deg, scale)
                    detected.append(100.0 * float(np.mean(seen > 1.0)))
                    db.append(psnr_db(image, last))
                last = image
            yield {
                "bench": "periphery",
                "case": self.scene.eye,
                "setting": f"{self.scene.size} {self.scene.name}",
                "movement": name,
                "detected_percent": float(np.mean(detected)),
                "worst_percent": max(detected),
                "psnr_db": min(db),
            }


def timed(renderer, handle, scene: Scene, count: int, gpu: Gpu | None = None):
    """Return frame times (2, n), ms, and the last frames with their evaluations."""
    states = states_towards(scene.store.spec, PUPIL_MM, FOCUS_DPT, 2 * (count + 1))
    times_ms, last = ([], []), [None, None]
    for k, state in enumerate(states):
        is_on = k % 2
        start_s = time.perf_counter()
        seen = renderer.render(
            scene.view,
            handle,
            output="srgb8",
            gaze_deg=GAZE_DEG,
            peripheral_merging=bool(is_on),
            **state,
        )
        times_ms[is_on].append(1e3 * (time.perf_counter() - start_s))
        if k >= len(states) - 2:
            size_px = scene.view.width_px, scene.view.height_px
            work = gpu and splat_work(gpu, size_px, seen.entry_count)
            last[is_on] = seen, work and work.evaluation_count
    return np.array(times_ms)[:, 1:], last


def rows_of(scene: Scene, engines: dict, *, is_quick: bool) -> Iterator[PeripheryRow]:
    """Yield the rows of a scene: each engine without and with the option."""
    measured: list[dict[str, float]] = []
    for method, (renderer, gpu) in engines.items():
        is_left_out = (
            scene.name,
            scene.eye,
        ) not in GL_CASES or scene.size not in GL_SIZES
        if gpu and is_left_out:
            continue
        handle = renderer.load(scene.store)
        if not measured:  # the native engine is first
            errors = Errors(scene, renderer, handle)
            measured = [errors.measure(peripheral_merging=on) for on in (False, True)]
        count = 2 if is_quick or gpu else 5
        times_ms, last = timed(renderer, handle, scene, count, gpu)
        for is_on in (0, 1):
            (seen, work), (plain, plain_work) = last[is_on], last[0]
            found = dict(measured[is_on])
            yield row_of(
                *("periphery", method, scene.eye),
                f"{scene.size} {scene.name} {'on' if is_on else 'off'}",
                *(times_ms[is_on], "psnr_db", found.pop("error"), "without merging"),
                kind=PeripheryRow,
                time_ratio=float(np.median(times_ms[is_on] / times_ms[0])),
                fragment_ratio=seen.fragment_count / plain.fragment_count,
                entry_ratio=seen.entry_count / plain.entry_count,
                texel_ratio=seen.kernel_texel_count / plain.kernel_texel_count,
                evaluation_ratio=work and work / plain_work,
                **found,
            )
        handle.release()


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return the rows of all scenes and eyes, or of small scenes and one eye."""
    eyes = {"emmetropia": EYES["emmetropia"]} if run.is_quick else EYES
    gpu, native = Gpu(), NativeRenderer()
    engines = {"native": (native, None), "gl": (FilterRenderer(gpu), gpu)}
    rows: list[Row] = []
    flicker: list[dict] = []
    names, sizes = (QUICK_SCENES, QUICK_SIZES) if run.is_quick else (SCENES, SIZES)
    for scene in scenes_of(names, sizes, eyes):
        rows += rows_of(scene, engines, is_quick=run.is_quick)
        if scene.eye == "emmetropia" and scene.name in FLICKER_SCENES.get(
            scene.size, ()
        ):
            handle = native.load(scene.store)
            flicker += Errors(scene, native, handle).flicker()
            handle.release()
    return rows, {"flicker": flicker}
