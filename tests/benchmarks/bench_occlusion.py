"""Occlusion with one and two layers, compared with rays traced through a lens.

Error: PSNR in linear light against rays through a thin lens
(`tests.reference.lens_picture`), over the whole picture, and over the band that light
from both sides of an edge reaches.  The eye has no aberrations but defocus, for that is
what the reference has.  Fragments are not merged, for that has an error of its own,
edges or not; one method has them merged.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from estimator.profiles.parse import parse_profile
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.frame import object_dpt
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.benchmarks.view_sources import linear_color
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db, tangents, texture
from tests.reference.lens_picture import (
    NOTHING,
    RAY_COUNT,
    STEP_PX,
    Lens,
    lens_picture,
)

MINUTES = 3
EYE = {"kind": "prescription", "sphere_dpt": 0.0}
ONE_LAYER = {"hidden_color": None, "hidden_depth_m": None}
METHODS = {
    # method: what of the view is left out, options of the renderer
    "one layer paper": (ONE_LAYER, {"accumulation": "paper", "merge": False}),
    "one layer": (ONE_LAYER, {"merge": False}),
    "two layers paper": ({}, {"accumulation": "paper", "merge": False}),
    "two layers": ({}, {"merge": False}),
    "two layers merged": ({}, {}),
}


SYNTHETIC_FOV_DEG = 14.0
FAR_DPT = 0.2


@dataclass(frozen=True)
class Scene:
    """A view with its hidden layer, and the eye that looks at it."""

    name: str
    view: RgbdView
    pupil_diameter_mm: float
    focus_dpt: float

    @property
    def lens(self) -> Lens:
        """The eye as the reference sees it."""
        left, right, up, down = self.view.tangents
        pitch_mrad = (
            1000.0 * (right - left) / self.view.width_px,
            1000.0 * (up - down) / self.view.height_px,
        )
        return Lens(self.pupil_diameter_mm, self.focus_dpt, pitch_mrad)

    @property
    def distances_dpt(self) -> list[NDArray[np.float64]]:
        """Object distance of both layers; negative where nothing is hidden."""
        view = self.view
        holds = view.hidden_depth_m > 0.0
        hidden_m = np.where(holds, view.hidden_depth_m, np.float32(1.0))
        return [
            object_dpt(view, view.depth_m),
            np.where(holds, object_dpt(view, hidden_m), NOTHING),
        ]

    def traced(self, *, ray_count: int) -> NDArray[np.float64]:
        """What the lens sees of both layers."""
        view = self.view
        colors = [
            linear_color(RgbdView(color, depth_m, view.tangents))
            for color, depth_m in zip(
                view.surface_colors, view.surface_depths_m, strict=True
            )
        ]
        return lens_picture(colors, self.distances_dpt, self.lens, ray_count=ray_count)

    def edge_band(self) -> NDArray[np.bool_]:
        """Pixels (height, width) that light from both sides of an edge reaches."""
        lens, distance_dpt = self.lens, self.distances_dpt[0]
        px_per_dpt = lens.pupil_diameter_mm / 2 / max(lens.pitch_mrad)
        edge = np.zeros(distance_dpt.shape, bool)
        for axis in (0, 1):
            step = np.abs(np.diff(distance_dpt, axis=axis)) * px_per_dpt > STEP_PX
            first, last = [(0, 0)] * 2, [(0, 0)] * 2
            first[axis], last[axis] = (0, 1), (1, 0)
            edge |= np.pad(step, first) | np.pad(step, last)
        blur_px = np.abs(distance_dpt - lens.focus_dpt)[edge] * px_per_dpt
        return distance_transform_edt(~edge) <= blur_px.max() + 1.0


def synthetic_scenes(*, width_px: int, height_px: int) -> list[Scene]:
    """Textured planes and a floor, of known distances, lit apart.

    Near things are bright, far ones dark: what leaks shows.
    """
    rng = np.random.default_rng(1)
    near = texture(rng, height_px, width_px, cell_px=6) * 0.5 + 0.5
    far = texture(rng, height_px, width_px, cell_px=3) * 0.6
    y, x = np.mgrid[:height_px, :width_px]
    across = (x + 0.5) / width_px - 0.5
    half = across < 0.0
    disc = np.hypot(x - width_px / 2, y - height_px / 2) < height_px / 4
    bar = np.abs(x - width_px // 2) <= 1
    down = (y + 0.5) / height_px
    floor_dpt = np.clip(0.3 + 3.0 * (down - 0.3), 0.3, None)
    box = (np.abs(across) < 0.12) & (down > 0.15) & (down < 0.75)
    foot_dpt = floor_dpt[box].max()

    def scene(name, mask, near_dpt, far_dpt, focus_dpt) -> Scene:
        near_m, far_m = (
            np.broadcast_to(1.0 / np.asarray(d, float), mask.shape)
            for d in (near_dpt, far_dpt)
        )
        view = RgbdView(
            np.where(mask[..., None], near, far).astype(np.float32),
            np.where(mask, near_m, far_m).astype(np.float32),
            tangents(width_px, height_px, SYNTHETIC_FOV_DEG),
            "radial",
            hidden_color=far,
            hidden_depth_m=np.where(mask, far_m, 0.0).astype(np.float32),
        )
        return Scene(name, view, 4.0, focus_dpt)

    slant_dpt = FAR_DPT + 0.8 * down
    return [
        scene("blurred edge", half, 2.5, FAR_DPT, FAR_DPT),
        scene("sharp edge", half, 2.5, FAR_DPT, 2.5),
        scene("thin bar", bar, 2.0, FAR_DPT, FAR_DPT),
        scene("focus between", disc, 2.5, slant_dpt, 1.5),
        scene("focus beyond", disc, 3.0, 1.2, 0.2),
        scene("box on a floor", box, foot_dpt, floor_dpt, 0.3),
    ]


def client_scene(name: str, *, width_px: int, height_px: int) -> Scene:
    """A frame of the demo's scenes with what it hides, looked past at the distance."""
    view = scene_view(name, width_px=width_px, height_px=height_px, with_hidden=True)
    return Scene(name, view, 6.0, FAR_DPT)


def scene_rows(renderer, scene: Scene, repeats: int) -> list[Row]:
    """Return two rows of each method: the whole picture, and the band around edges."""
    view = scene.view
    start_s = time.perf_counter()
    truth = scene.traced(ray_count=RAY_COUNT)
    trace_ms = 1e3 * (time.perf_counter() - start_s)
    band = scene.edge_band()
    handle = renderer.load(_store(scene))

    def rows(method, times_ms, image, **more) -> list[Row]:
        return [
            row_of(
                *("occlusion", method, scene.name),
                f"{view.width_px}x{view.height_px} {scene.pupil_diameter_mm:g} mm",
                *(
                    times_ms,
                    name,
                    error,
                    f"{RAY_COUNT} rays a pixel through a thin lens",
                ),
                **more,
            )
            for name, error in (
                ("psnr_db", psnr_db(image, truth)),
                ("edge_psnr_db", psnr_db(image[band], truth[band])),
            )
        ]

    # How far the reference itself is off: it changes by this with half the rays.
    fewer = scene.traced(ray_count=RAY_COUNT // 2)
    found = rows("half the rays", [trace_ms / 2], fewer)
    for method, (left_out, options) in METHODS.items():
        shown, times_ms = replace(view, **left_out), []
        for _ in range(2 + repeats):
            start_s = time.perf_counter()
            seen = renderer.render(
                shown,
                handle,
                pupil_diameter_mm=scene.pupil_diameter_mm,
                focus_dpt=scene.focus_dpt,
                **options,
            )
            times_ms.append(1e3 * (time.perf_counter() - start_s))
        color = seen.color.astype(np.float64)
        found += rows(method, times_ms[2:], color, used_mb=renderer.memory_mb)
    handle.release()
    return found


def _store(scene: Scene):
    held = [d[d >= 0.0] for d in scene.distances_dpt]
    spec = grid_spec(
        width_px=scene.view.width_px,
        height_px=scene.view.height_px,
        tangents=scene.view.tangents,
        pupil_range_mm=(scene.pupil_diameter_mm,) * 2,
        focus_range_dpt=(scene.focus_dpt,) * 2,
        object_range_dpt=(0.0, max(float(d.max()) for d in held if d.size)),
        diffraction=False,
        chromatic=False,
    )
    return build_psf_store(parse_profile(EYE), spec)


def measure(run: Run) -> list[Row]:
    """Return the rows of all scenes, or of four small ones."""
    renderer = NativeRenderer()
    if run.is_quick:
        scenes = synthetic_scenes(width_px=96, height_px=54)[:4]
    else:
        scenes = synthetic_scenes(width_px=320, height_px=180)
        scenes += [
            client_scene(name, width_px=640, height_px=360)
            for name in ("courtyard", "primitives")
        ]
    repeats = 3 if run.is_quick else 7
    return [row for scene in scenes for row in scene_rows(renderer, scene, repeats)]
