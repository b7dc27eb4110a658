"""The lens that is best for a scene, and the best correction of the eye alone.

Eyes of -2 dpt, with astigmatism, with keratoconus, after LASIK, and of 60 years look
through 3 and 5 mm at letters and a photograph of scikit-image, far away; two of them at
a courtyard with depth, relaxed; the last one also at letters and, through 5 mm, at the
photograph both far away and at 0.4 m, through single-vision and progressive lenses.
The lens of the search is compared with the one of the highest visual Strehl ratio:
error by the measure of the search, retinal PSNR, visual Strehl ratio and acuity for far
objects.  A grid of 26 lenses 0.1 dpt around the result (power vector at the pupil)
shows whether it is a minimum.
"""

from contextlib import ExitStack
from dataclasses import replace
from itertools import product

import numpy as np
from PIL import Image

from clients.figures.study import EyeStudy
from estimator.optics.prescription import (
    Prescription,
    format_prescription,
    power_vector,
)
from filter_service.camera import Camera
from filter_service.correcting import BestLens, LensScene, best_lens
from filter_service.correcting.lens_scene import Sight
from filter_service.correcting.lens_search import (
    RELAXING_ADD_DPT,
    lens_from_power_vector,
)
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.shared_builder import open_inline_builder
from filter_service.given_profile import as_profile
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.bench_correct import (
    PICTURES,
    SMALL,
    SMALL_FOV_DEG,
    prescription,
)
from tests.benchmarks.harness import Row, Run, memory_mb
from tests.source_tree import ROOT

EYES = {
    "-2 dpt": prescription(-2.0),
    "astigmatism": prescription(0.0, cylinder_dpt=-2.0, axis_deg=30.0),
    "keratoconus": {"kind": "preset", "name": "keratoconus"},
    "post-LASIK": {"kind": "preset", "name": "post_lasik"},
    "60 years": prescription(0.0, age_years=60),
}
MINUTES = 3.5
PUPILS_MM = 3.0, 5.0
IN_COURTYARD = (("-2 dpt", 3.0), ("keratoconus", 5.0))
COURTYARD_FOV_DEG, COURTYARD_MM, SKY_MM = 50.0, 1000.0, 65535
NEAR_M, READING_DEG = 0.4, (0.0, -30.0)
PROGRESSIVE = {"kind": "progressive", "vertex_mm": 12.0}
GRID_DPT = 0.1
ON_AXIS = {"mode": "on-axis"}


def chart(picture: str, distance_m: float = np.inf) -> RgbdView:
    """Letters or a photograph at a distance."""
    camera = Camera.from_fov(SMALL_FOV_DEG, width_px=SMALL[0], height_px=SMALL[1])
    depth_m = np.full(SMALL[::-1], distance_m, np.float32)
    return RgbdView(PICTURES[picture](SMALL), depth_m, camera.tangents)


def courtyard() -> RgbdView:
    """The scene of the examples, in half its size."""
    folder = ROOT / "examples" / "data"
    color = Image.open(folder / "courtyard.jpg").resize(SMALL, Image.Resampling.BOX)
    millimeters = np.array(Image.open(folder / "courtyard_depth.png"))[::2, ::2]
    millimeters = millimeters[: SMALL[1], : SMALL[0]]
    depth_m = np.where(millimeters == SKY_MM, np.inf, millimeters / COURTYARD_MM)
    camera = Camera.from_fov(COURTYARD_FOV_DEG, width_px=SMALL[0], height_px=SMALL[1])
    return RgbdView(np.array(color), depth_m.astype(np.float32), camera.tangents)


def cases(*, is_quick: bool):
    """Yield the name of an eye and of scenes, the scenes, the lens and settings."""
    eyes, pupils_mm = list(EYES), PUPILS_MM
    if is_quick:
        eyes, pupils_mm = eyes[:1], pupils_mm[:1]
    for name, pupil_mm in product(eyes, pupils_mm):
        for picture in PICTURES:
            scene = LensScene(view=chart(picture), pupil_diameter_mm=pupil_mm)
            yield name, pupil_mm, f"{picture}, far", [scene], {}, ON_AXIS
        if is_quick:
            continue
        if (name, pupil_mm) in IN_COURTYARD:
            scene = LensScene(
                view=courtyard(), pupil_diameter_mm=pupil_mm, focus_dpt=0.0
            )
            yield name, pupil_mm, "courtyard", [scene], {}, {}
        if name == "60 years":
            for picture in PICTURES if pupil_mm == max(PUPILS_MM) else ["letters"]:
                both = [
                    LensScene(view=chart(picture), pupil_diameter_mm=pupil_mm),
                    LensScene(
                        view=chart(picture, NEAR_M),
                        pupil_diameter_mm=pupil_mm,
                        gaze_deg=READING_DEG,
                    ),
                ]
                setting = f"{picture}, far and {NEAR_M:g} m"
                yield name, pupil_mm, setting, both, {}, ON_AXIS
                setting += ", progressive"
                yield name, pupil_mm, setting, both, PROGRESSIVE, ON_AXIS


class Judge:
    """Images and acuity of an eye through a lens, in a first scene."""

    def __init__(self, builder, profile, scene: LensScene, target, settings):
        self._builder, self._profile, self._scene = builder, profile, scene
        pupil_mm = (scene.pupil_diameter_mm,) * 2
        self._sights = {m: Sight(scene, m) for m in ("retina", "luminance")}
        for sight in self._sights.values():
            sight.target = target
        objects_dpt = self._sights["retina"].objects_dpt
        self._settings = {
            "pupil_range_mm": pupil_mm,
            "focus_range_dpt": objects_dpt[:1] * 2,
            "object_range_dpt": objects_dpt,
            **settings,
        }

    def errors_db(self, lens: Prescription) -> dict[str, float]:
        """Errors of the relaxed eye through spectacles, by the two measures."""
        profile = replace(
            as_profile(self._profile), correction=lens, add_dpt=RELAXING_ADD_DPT
        )
        sight = self._sights["retina"]
        with EyeFilter(
            profile, self._scene.view.camera, self._settings, builder=self._builder
        ) as eye:
            seen = eye.filter(
                self._scene.view,
                pupil_diameter_mm=self._scene.pupil_diameter_mm,
                focus_dpt=sight.objects_dpt[0],
                output="linear",
                merge=False,
                bright_pixels=False,
                render_tolerance=0.0 if sight.is_flat else 1.0,
                whole=True,
            )
        return {
            m: 10.0 * np.log10(s.error(seen.color)) for m, s in self._sights.items()
        }

    def grid_gain_db(self, found: BestLens) -> float:
        """How much better the best lens of a grid about the result is."""
        lens = found.best.prescription
        middle = np.array(power_vector(lens, depth_mm=3.05))
        errors_db = []
        for offset in product((-GRID_DPT, 0.0, GRID_DPT), repeat=3):
            moved = tuple((middle + offset).tolist())
            tried = lens_from_power_vector(moved, vertex_mm=lens.vertex_mm)
            errors_db.append(self.errors_db(tried)["luminance"])
        middle_db = errors_db.pop(len(errors_db) // 2)
        return middle_db - min(errors_db)

    def sharpness(self, lens: Prescription) -> tuple[float, float]:
        """Acuity, logMAR, and visual Strehl ratio of a far point through a lens."""
        profile = replace(
            as_profile(self._profile), correction=lens, add_dpt=RELAXING_ADD_DPT
        )
        study = EyeStudy.of(profile)
        acuity = study.wavefront(self._scene.pupil_diameter_mm).predicted
        if acuity is None:
            return np.nan, np.nan
        return acuity.log_mar, acuity.visual_strehl_ratio


def compared(builder, name, pupil_mm, setting, scenes, lens, settings):
    """Yield rows of both lenses, with details."""
    found = best_lens(EYES[name], scenes, lens=lens, settings=settings, builder=builder)
    judge = Judge(builder, EYES[name], scenes[0], found.target, settings)
    milliseconds = 1e3 * found.search_s
    for method, trial in (("visual Strehl", found.start), ("scene", found.best)):
        text = format_prescription(trial.prescription)
        if trial.add_dpt:
            text += f" add {trial.add_dpt:.2f}"
        details = {"method": method, "eye": name, "pupil_mm": pupil_mm}
        details |= {"scenes": setting, "lens": text}
        details["error_db"] = round(trial.error_db, 2)
        if not trial.add_dpt:
            errors_db = judge.errors_db(trial.prescription)
            log_mar, ratio = judge.sharpness(trial.prescription)
            details["psnr_db"] = round(-errors_db["retina"], 2)
            details["log_mar"] = round(log_mar, 3)
            details["visual_strehl_ratio"] = round(ratio, 3)
        if method == "scene":
            details["rounding_loss_db"] = round(found.rounding_loss_db, 2)
            details["lenses"] = len(found.trials)
            details["search_s"] = round(found.search_s, 1)
            if len(scenes) == 1 and settings:
                details["grid_gain_db"] = round(judge.grid_gain_db(found), 3)
        row = Row(
            *("best_lens", method, f"{name}, {pupil_mm:g} mm", setting),
            *(len(found.trials), milliseconds, milliseconds, memory_mb()),
            *("error_db", trial.error_db, text),
        )
        yield row, details


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, and the lenses that were found."""
    with ExitStack() as closing:
        builder = open_inline_builder(closing, engine="native")
        found = [
            pair
            for case in cases(is_quick=run.is_quick)
            for pair in compared(builder, *case)
        ]
    return [row for row, _ in found], {"lenses": [details for _, details in found]}
