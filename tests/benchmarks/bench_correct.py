"""Pictures solved for viewers: time, retinal error, acuity, and Wiener filters.

Viewers of -1 and -2 dpt, with astigmatism and with keratoconus look at letters and at a
photograph of scikit-image, far away, through 4 mm, and the second also through 3 mm.
Solved: for their state, and for ranges of 0.5 mm and 0.25 dpt, judged by the mean over
them and at one corner, 0.5 mm and 0.25 dpt off.  Wiener filters with one PSF and with
one per tile get the regularization that is best in each case, are clipped, and have the
same target.  A viewer of -1 dpt also looks at pictures solved for what another eye
sees.  Acuity is that of the transfer from the chart to the retina, up to the frequency
of the pixels.
"""

import time
from contextlib import ExitStack
from itertools import groupby, product

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from skimage import data

from filter_service.camera import Camera
from filter_service.color_encoding import srgb_curve
from filter_service.correcting import correct, nearest_picture
from filter_service.correcting.correction import compressed, psnr_db
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.shared_builder import open_inline_builder
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.harness import Row, Run, memory_mb
from tests.benchmarks.wiener_pictures import by_one_psf, by_tiles, log_mar_of_picture

MINUTES = 3


def prescription(sphere_dpt: float, **more) -> dict:
    """Body of a profile."""
    return {"kind": "prescription", "sphere_dpt": sphere_dpt} | more


VIEWERS = {
    "-1 dpt": prescription(-1.0),
    "-2 dpt": prescription(-2.0),
    "astigmatism": prescription(0.0, cylinder_dpt=-2.0, axis_deg=30.0),
    "keratoconus": {"kind": "preset", "name": "keratoconus"},
}
TARGETS = {
    "-3 dpt": prescription(-3.0),
    "cataract": {
        "kind": "preset",
        "name": "emmetropia",
        "age_years": 70,
        "straylight": {"cataract": "nuclear"},
    },
    "emmetropia": {"kind": "preset", "name": "emmetropia"},
}
PUPILS_MM = 3.0, 4.0
SHOWN = (("letters", 1.0), ("letters", 0.5), ("photograph", 0.5))
"""Pictures and contrasts that are solved."""

PUPIL_RANGE_MM, FOCUS_RANGE_DPT = 0.5, 0.25
SMALL, SMALL_FOV_DEG = (240, 135), 4.5
SHOWN_BUDGETS = (1.0, None), (0.3, 0.5)
"""Contrasts and brightnesses of what another eye sees."""

WIDE_FOV_DEG = 30.0
LARGE, LARGE_FOV_DEG = (480, 270), 9.0
LINES = (
    ("N K H S", 0.34, 0.01),
    ("Z O V R C D", 0.17, 0.39),
    ("S N D H K O R Z", 0.10, 0.61),
    ("V C O Z S N D R H K", 0.06, 0.77),
)
"""Text, height and top of the lines of the chart, relative to the picture's height."""


def letters(size: tuple[int, int]) -> np.ndarray:
    """Black letters on white, linear light."""
    large = Image.new("L", (4 * size[0], 4 * size[1]), 255)
    draw = ImageDraw.Draw(large)
    for text, height, top in LINES:
        font = ImageFont.load_default(size=round(height * large.height))
        place = large.width / 2, top * large.height
        draw.text(place, text, fill=0, font=font, anchor="ma")
    shown = np.asarray(large.resize(size, Image.Resampling.BOX), np.float32) / 255.0
    return np.repeat(shown[..., None], 3, axis=2)


def photograph(size: tuple[int, int]) -> np.ndarray:
    """A part of a photograph, linear light."""
    part = Image.fromarray(data.astronaut()[100:388]).resize(size)
    return srgb_curve(np.asarray(part, np.float64) / 255.0).astype(np.float32)


PICTURES = {"letters": letters, "photograph": photograph}


class Viewer:
    """The operators of an eye for a far display."""

    def __init__(self, closing, builder, profile, camera):
        shape = camera.height_px, camera.width_px
        self.far_m = np.full(shape, np.inf, np.float32)
        self.near_m = np.full(shape, 1.0 / FOCUS_RANGE_DPT, np.float32)
        settings = {
            "pupil_range_mm": (min(PUPILS_MM) - 0.5, max(PUPILS_MM) + 0.5),
            "object_range_dpt": (0.0, FOCUS_RANGE_DPT),
        }
        self._eye = closing.enter_context(
            EyeFilter(profile, camera, settings, builder=builder)
        )
        color = np.zeros((*shape, 3), np.uint8)
        state = {"pupil_diameter_mm": PUPILS_MM[0], "focus_dpt": 0.0}
        self._relaxed_dpt = self._eye.filter(color, self.far_m, **state).focus_dpt
        self._ranges: dict[float, list] = {}

    def operator(self, pupil_mm, off_dpt=0.0):
        """Operator of a pupil, and of a focus that is nearer by so much."""
        depth_m, focus_dpt = self.far_m, 0.0
        if off_dpt < 0.0:
            depth_m = self.near_m
        elif off_dpt > 0.0:
            focus_dpt = self._relaxed_dpt + off_dpt
        return self._eye.operator(
            depth_m, pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt
        )

    def range(self, pupil_mm):
        """Operators that `correct` uses for the ranges."""
        if pupil_mm not in self._ranges:
            self._ranges[pupil_mm] = [
                self.operator(pupil_mm),
                self.operator(pupil_mm - PUPIL_RANGE_MM),
                self.operator(pupil_mm + PUPIL_RANGE_MM),
                self.operator(pupil_mm, FOCUS_RANGE_DPT),
                self.operator(pupil_mm, -FOCUS_RANGE_DPT),
            ]
        return self._ranges[pupil_mm]


def compared(camera, viewer, pupil_mm, picture, contrast):
    """Yield a method's name, its time in s, and PSNRs and acuities as a dict."""
    operators = viewer.range(pupil_mm)
    corner = viewer.operator(pupil_mm + PUPIL_RANGE_MM, FOCUS_RANGE_DPT)
    image = PICTURES[picture]((camera.width_px, camera.height_px))
    target = compressed(image, contrast=contrast, brightness=None)
    judges = {"nominal": operators[:1], "range": operators, "corner": [corner]}

    def judged(pictures_of):
        """Best PSNR by each judge of the pictures for it; acuity of the nominal one."""
        found = {}
        for judge, seen_by in judges.items():
            scores = []
            for x in pictures_of[judge]:
                seen = [op.forward(x) for op in seen_by]
                scores.append((psnr_db(seen, target), seen[0]))
            best_db, seen = max(scores, key=lambda score: score[0])
            found[f"{judge}_db"] = best_db
            if judge == "nominal" and picture == "letters":
                found["log_mar"] = log_mar_of_picture(seen, image, camera)
        return found

    plain = target.clip(0.0, 1.0)
    yield "none", 0.0, judged({judge: [plain] for judge in judges})
    begin_s = time.perf_counter()
    nominal = nearest_picture(operators[:1], [target], start=target)
    solve_s = time.perf_counter() - begin_s
    robust = nearest_picture(operators, [target] * len(operators), start=target)
    pictures = {judge: [robust.color] for judge in judges}
    pictures["nominal"] = [nominal.color]
    bound_db = -10.0 * np.log10(max(nominal.lower_bound, 1e-30))
    yield "solved", solve_s, judged(pictures) | {"bound_db": bound_db}
    for name, filters in (("Wiener, one PSF", by_one_psf), ("Wiener, tiles", by_tiles)):
        begin_s = time.perf_counter()
        candidates = filters(operators[0], target)
        filter_s = (time.perf_counter() - begin_s) / len(candidates)
        yield name, filter_s, judged(dict.fromkeys(judges, candidates))


def comparison_rows(builder, cases):
    """Rows of all methods, and lists of all of their measures."""
    for (fov_deg, name), of_viewer in groupby(cases, key=lambda case: case[:2]):
        camera = Camera.from_fov(fov_deg, width_px=SMALL[0], height_px=SMALL[1])
        with ExitStack() as closing:
            viewer = Viewer(closing, builder, VIEWERS[name], camera)
            for _, _, pupil_mm, picture, contrast in of_viewer:
                case = f"{name}, {pupil_mm:g} mm"
                setting = f"{picture}, contrast {contrast:g}, {fov_deg:g} deg"
                for method, seconds, found in compared(
                    camera, viewer, pupil_mm, picture, contrast
                ):
                    details = {"method": method, "case": case, "setting": setting}
                    over_db = -20.0 * np.log10(contrast)
                    for judge in ("nominal", "range", "corner"):
                        details[f"{judge}_db"] = round(found[f"{judge}_db"], 2)
                    details["nominal_over_contrast_db"] = round(
                        found["nominal_db"] - over_db, 2
                    )
                    for key, digits in (("bound_db", 2), ("log_mar", 3)):
                        if key in found:
                            details[key] = round(found[key], digits)
                    row = Row(
                        *("correct", method, case, setting, 1, 1e3 * seconds),
                        *(1e3 * seconds, memory_mb(), "retinal psnr_db"),
                        *(found["nominal_db"], "the target"),
                    )
                    yield row, details


def shown_rows(builder):
    """Rows of a viewer of -1 dpt who sees what another eye sees."""
    camera = Camera.from_fov(LARGE_FOV_DEG, width_px=LARGE[0], height_px=LARGE[1])
    far_m = np.full(LARGE[::-1], np.inf, np.float32)
    with ExitStack() as closing:
        viewer = Viewer(closing, builder, VIEWERS["-1 dpt"], camera).operator(4.0)
    for (name, target_eye), picture, (contrast, brightness) in product(
        TARGETS.items(), PICTURES, SHOWN_BUDGETS
    ):
        image = PICTURES[picture](LARGE)
        plain = compressed(image, contrast=contrast, brightness=brightness)
        found = correct(
            RgbdView(image, far_m, camera.tangents),
            VIEWERS["-1 dpt"],
            target_eye=target_eye,
            pupil_diameter_mm=4.0,
            focus_dpt=0.0,
            contrast=contrast,
            brightness=brightness,
            builder=builder,
        )
        reference = "what the eye sees"
        if found.lower_bound > 0.0:
            bound_db = -10.0 * np.log10(found.lower_bound)
            reference += f"; no picture is above {bound_db:.1f} dB"
        setting = f"{picture}, contrast {contrast:g}"
        for method, psnr, seconds in (
            ("scene displayed", psnr_db([viewer.forward(plain)], found.target), 0.0),
            ("target displayed", found.psnr_before_db, 0.0),
            ("solved", found.psnr_after_db, found.solve_s),
        ):
            yield Row(
                *("correct", method, f"-1 dpt sees {name}", setting, 1),
                *(1e3 * seconds, 1e3 * seconds, memory_mb(), "retinal psnr_db", psnr),
                reference,
            )


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, and all measures of the compared pictures."""
    cases = [
        (fov_deg, name, pupil_mm, *shown)
        for fov_deg, name, pupil_mm, every in (
            *((SMALL_FOV_DEG, name, 4.0, SHOWN) for name in VIEWERS),
            (SMALL_FOV_DEG, "-2 dpt", 3.0, SHOWN),
            *(
                (WIDE_FOV_DEG, name, 4.0, SHOWN[2:])
                for name in ("-2 dpt", "keratoconus")
            ),
        )
        for shown in every
    ]
    cases.sort(key=lambda case: (case[0], list(VIEWERS).index(case[1])))
    with ExitStack() as closing:
        builder = open_inline_builder(closing, engine="native")
        rows = [] if run.is_quick else list(shown_rows(builder))
        comparison = list(
            comparison_rows(builder, cases[:1] if run.is_quick else cases)
        )
    rows += [row for row, _ in comparison]
    return rows, {"comparison": [found for _, found in comparison]}
