"""Lenses compared with closed forms, diffraction theory and published designs.

- ``closed form``: what spectacles, turned and decentred lenses, diffractive orders and
  progressive lenses must do, less what they do here.
- ``diffraction``: largest difference of the modulation through focus, 2 to 38 cpd,
  between kernels and the lens's true profile sampled finely; ``sum of foci`` is what it
  would be if the light of the foci did not interfere.
- ``published``: lenses on optical benches, ours less theirs; sources stand in
  tests/data/published_lenses.json.
- ``people``: what people were found to read through an intraocular lens of extended
  depth of focus and through lenslets, ours less theirs; no bench's numbers of these
  lenses could be read.  And how wide a progressive lens's corridor is said to be.
- ``plan``: PSNR that blended PSFs have, less what their plan predicts.
- ``kernels``: time of a PSF with and without rings in the pupil.
"""

import time
from functools import partial

import numpy as np

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.worn_lens import WornLens, aberration_polynomial
from estimator.optics import prescription as rx
from estimator.optics.zernike import index_from_nm
from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psf_batch
from estimator.wavefront.field_wavefronts import zernike_from_polynomial
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.eye_for_spec import eye_for_spec
from tests.benchmarks.harness import Row, Run, time_calls
from tests.benchmarks.rows import row_of
from tests.lens_truth import (
    MM_PER_DEG,
    PUBLISHED,
    Truth,
    lenslet_eye,
    lenslets_truth,
    modulation,
    worn_eye,
)
from tests.numerical.plan_cases import mean_db, sampled_errors, spec_for
from tests.worn_by_people import (
    TABLES,
    corridor_width_mm,
    lost_by_lenslets,
    read_through_focus,
)

THROUGH_FOCUS_DPT = np.arange(0.0, 3.61, 0.05)
OBJECTS_DPT = np.arange(0.0, 3.1, 0.5)
AT_CPD = np.arange(2.0, 40.0, 2.0)
PUPILS_MM = (2.0, 3.0, 4.5)
DESIGN_NM, BLUE_NM = 550.0, 453.0
LINES = {
    "bifocal": {"design": "bifocal", "add_dpt": 3.0},
    "trifocal": {
        "design": "trifocal",
        "adds_dpt": [1.66, 3.33],
        "light_ratio": [0.5, 0.2, 0.3],
    },
    "edof": {"design": "edof", "add_dpt": 1.75},
    "zones": {
        "design": "zones",
        "zone_adds_dpt": [0.0, 2.5, 0.0],
        "zone_diameters_mm": [2.0, 3.0, 4.0],
    },
    "rings to 3 mm": {"design": "bifocal", "add_dpt": 3.0, "rings_diameter_mm": 3.0},
}
PEAK_LEAST = 0.08
BEFORE_PUPIL_MM = 15.05
KERNELS = 96
STATES, WIDTH_PX, HEIGHT_PX = 100, 1280, 720
MINUTES = 2


row = partial(row_of, "corrections")


def _timed(function):
    start_s = time.perf_counter()
    found = function()
    return found, [1e3 * (time.perf_counter() - start_s)]


def worn(**body) -> WornLens:
    """Return what a profile of an eye without error wears."""
    profile = {"kind": "prescription", "sphere_dpt": 0.0, "correction": body}
    return parse_profile(profile).correction


def closed_form_rows() -> list[Row]:
    """Return a row for each law."""
    rows = []

    def add(case, setting, found, expected, name, reference):
        value, times_ms = _timed(found)
        text = f"{setting}: {value:.4g}"
        error = value - expected
        rows.append(row("closed form", case, text, times_ms, name, error, reference))

    add(
        *("spectacles", "-10 dpt at 12 mm"),
        lambda: rx.power_vector(worn(sphere_dpt=-10.0, vertex_mm=12.0))[0],
        *(-10.0 / 1.12, "dpt", "F / (1 - d F)"),
    )
    for degrees in (10.0, 30.0):
        add(
            *("toric contact lens", f"left of 2 dpt, turned {degrees:g} deg"),
            partial(left_cylinder_dpt, degrees),
            *(4.0 * np.sin(np.radians(degrees)), "dpt", "2 C sin of the angle"),
        )
    add(
        *("decentred contact lens", "coma of 0.3 um, 0.5 mm aside"),
        decentred_coma_um,
        *(-0.3 * 0.5 / 3.0 * 2.0 * np.sqrt(10.0), "um", "-2 sqrt(10) C40 d / r"),
    )
    step = worn(kind="iol", design="bifocal", add_dpt=3.0).rings
    deep = worn(kind="iol", design="edof", add_dpt=1.75).rings
    for order in (1, 2):
        waves = 1.5 * DESIGN_NM / BLUE_NM
        add(
            *("extended depth", f"share of order {order}, 453 nm"),
            lambda order=order: float(share_of(deep, order, BLUE_NM)),
            *(np.sinc(waves - order) ** 2, "ratio", "sinc²(h - k)"),
        )
    for order in (0, 1):
        add(
            *("diffractive", f"share of order {order}, 550 nm"),
            lambda order=order: float(share_of(step, order, DESIGN_NM)),
            *(np.sinc(0.5) ** 2, "ratio", "sinc²(1/2)"),
        )
    add(
        *("diffractive", "share of order 1, 453 nm"),
        lambda: float(share_of(step, 1, BLUE_NM)),
        *(np.sinc(0.5 * DESIGN_NM / BLUE_NM - 1.0) ** 2, "ratio", "sinc²(h - 1)"),
    )
    lens = ProgressiveLens.of(rx.Prescription(0.0), add_dpt=2.0, corridor_mm=14.0)
    for y_mm in (-4.0, -7.0, -10.0):
        add(
            *("progressive", f"astigmatism 0.5 mm beside, {-y_mm:g} mm down"),
            partial(astigmatism_dpt, lens, 0.5, y_mm),
            *(2.0 * 0.5 * slope_dpt_mm(lens, y_mm), "dpt", "Minkwitz 1963: 2 F' x"),
        )
    return rows


def left_cylinder_dpt(turned_deg: float) -> float:
    """Cylinder that a turned lens leaves of 2 dpt."""
    straight = worn(
        kind="contact_lens", sphere_dpt=0.0, cylinder_dpt=-2.0, axis_deg=30.0
    )
    turned = worn(
        kind="contact_lens",
        sphere_dpt=0.0,
        cylinder_dpt=-2.0,
        axis_deg=30.0,
        rotation_deg=turned_deg,
    )
    left = np.subtract(rx.power_vector(straight), rx.power_vector(turned))
    return 2.0 * float(np.hypot(left[1], left[2]))


def decentred_coma_um() -> float:
    """C(3,1) on 6 mm of a lens with spherical aberration, 0.5 mm to the right."""
    lens = worn(
        kind="contact_lens",
        sphere_dpt=0.0,
        spherical_aberration_um=0.3,
        decentration_mm=[0.5, 0.0],
    )
    return float(
        zernike_from_polynomial(aberration_polynomial(lens), 3.0)[index_from_nm(3, 1)]
    )


def share_of(rings, order: int, wavelength_nm: float) -> float:
    """Share of the light in one order."""
    place = list(rings.followed_orders).index(order)
    return abs(rings.amplitudes(wavelength_nm)[place]) ** 2


def astigmatism_dpt(lens: ProgressiveLens, x_mm: float, y_mm: float) -> float:
    """Difference of the principal powers at a point of a lens."""
    powers = np.linalg.eigvalsh(lens.power_matrices_dpt(x_mm, y_mm))
    return float(powers[1] - powers[0])


def slope_dpt_mm(lens: ProgressiveLens, y_mm: float, step_mm: float = 1e-3) -> float:
    """Change of power along the corridor."""
    above, below = lens.power_matrices_dpt(0.0, [y_mm + step_mm, y_mm - step_mm])
    return abs(float(above[0, 0] - below[0, 0])) / (2.0 * step_mm)


def diffraction_rows(pupils_mm) -> list[Row]:
    """Return the largest error of modulation for each design, pupil and colour."""
    rows = []
    for name, body in LINES.items():
        eye = worn_eye(**body)
        for pupil_mm in pupils_mm:
            for wavelength_nm in (DESIGN_NM, BLUE_NM):
                found, times_ms = _timed(
                    partial(
                        modulation,
                        eye,
                        OBJECTS_DPT,
                        pupil_mm=pupil_mm,
                        wavelength_nm=wavelength_nm,
                        at_cpd=AT_CPD,
                    )
                )
                true, summed = truth_through_focus(eye, pupil_mm, wavelength_nm)
                setting = f"{pupil_mm:g} mm, {wavelength_nm:g} nm"
                for method, other in (("diffraction", found), ("sum of foci", summed)):
                    if other is None:
                        continue
                    error = np.abs(other - true).max()
                    rows.append(
                        row(
                            *(method, name, setting, times_ms, "modulation", error),
                            "true profile, FFT",
                            n=OBJECTS_DPT.size,
                        )
                    )
    return rows


def lenslet_rows(pupils_mm) -> list[Row]:
    """Return the largest error of modulation behind lenslets, looking down."""
    rows = []
    for v_deg in (0.0, -25.0):
        eye = lenslet_eye(gaze_deg=[0.0, v_deg])
        for pupil_mm in pupils_mm:
            seen = {"pupil_mm": pupil_mm, "wavelength_nm": 555.0, "at_cpd": AT_CPD}
            found, times_ms = _timed(partial(modulation, eye, [0.0], **seen))
            true = lenslets_truth(
                eye.rings.seen_from(0.0, 0.0), **seen, depth_mm=BEFORE_PUPIL_MM
            )
            rows.append(
                row(
                    *(
                        "diffraction",
                        "lenslets",
                        f"{pupil_mm:g} mm, {abs(v_deg):g} deg down",
                    ),
                    *(times_ms, "modulation", np.abs(found[0] - true).max()),
                    "honeycomb, carried over 15 mm",
                )
            )
    return rows


def truth_through_focus(eye, pupil_mm: float, wavelength_nm: float):
    """Modulation by the true profile, and by foci that do not interfere."""
    truth = Truth(pupil_mm, wavelength_nm)
    behind = truth.profile(eye.rings)
    at_infinity_dpt = eye.refraction_at_dpt(
        pupil_diameter_mm=pupil_mm
    ) + eye.chromatic_shift_dpt(wavelength_nm)
    true, summed = [], []
    for object_dpt in OBJECTS_DPT.tolist():
        total_dpt = at_infinity_dpt + eye.vergence.vergence_dpt(object_dpt)
        true.append(truth.modulation(behind * truth.defocused(total_dpt), AT_CPD))
        if hasattr(eye.rings, "kinoform") and eye.rings.diameter_mm > pupil_mm:
            summed.append(truth.of_sum(eye.rings, total_dpt, AT_CPD))
    return np.array(true), np.array(summed) if summed else None


def peaks(values) -> list[int]:
    """Return where a curve has its peaks; its beginning is none."""
    v = np.asarray(values)
    inside = (v[1:-1] > v[:-2]) & (v[1:-1] >= v[2:]) & (v[1:-1] > PEAK_LEAST)
    return (1 + np.flatnonzero(inside)).tolist()


def transfer_rows() -> list[Row]:
    """Return rows of published modulations."""
    table = PUBLISHED["transfer"]
    at_cpd = [table["line_pairs_per_mm"] * MM_PER_DEG]
    rows = []
    for name, lens in table["lenses"].items():
        found, times_ms = _timed(
            partial(
                modulation,
                worn_eye(**lens["body"]),
                THROUGH_FOCUS_DPT,
                pupil_mm=table["aperture_mm"],
                wavelength_nm=table["wavelength_nm"],
                at_cpd=at_cpd,
            )
        )
        curve = np.abs(found[:, 0])
        for focus, at in foci_of(curve, lens).items():
            rows.append(
                row(
                    *("published", name, f"{focus}: {curve[at]:.3f}", times_ms),
                    *("modulation", curve[at] - lens[focus], table["source"]),
                )
            )
    return rows


def foci_of(curve, lens: dict) -> dict[str, int]:
    """Return where a curve has the foci that a source names; far from its start."""
    later = [k for k in peaks(curve) if THROUGH_FOCUS_DPT[k] > 0.5]
    found = {"far": int(np.argmax(curve[THROUGH_FOCUS_DPT < 0.3]))}
    if "near" in lens:
        near = max(later, key=lambda k: THROUGH_FOCUS_DPT[k] > 2.0 and curve[k])
        found["near"] = near
        if "intermediate" in lens:
            between = [k for k in later if k < near]
            found["intermediate"] = max(between, key=lambda k: curve[k])
    return found


def distance_rows() -> list[Row]:
    """Return rows of published distances of near and intermediate points."""
    rows = []
    for name, lens in PUBLISHED["distances"]["lenses"].items():
        found, times_ms = _timed(
            partial(
                modulation,
                worn_eye(**lens["body"]),
                THROUGH_FOCUS_DPT,
                pupil_mm=3.0,
                wavelength_nm=546.0,
                at_cpd=[30.0],
            )
        )
        curve = np.abs(found[:, 0])
        foci = foci_of(
            curve,
            {"near": 1}
            | dict.fromkeys(
                [k.removesuffix("_cm") for k in lens if k.endswith("_cm")], 1
            ),
        )
        for focus, at in foci.items():
            if f"{focus}_cm" in lens:
                cm = 100.0 / THROUGH_FOCUS_DPT[at]
                error = cm - lens[f"{focus}_cm"]
                rows.append(
                    row(
                        *("published", name, f"{focus}: {cm:.1f} cm", times_ms),
                        *("cm", error, lens["source"]),
                    )
                )
    return rows


def toric_rows() -> list[Row]:
    """Return rows of toric lenses."""
    rows = []
    rotation = PUBLISHED["toric"]["rotation"]
    for degrees, expected in rotation["left_ratio_by_deg"].items():
        left, times_ms = _timed(partial(left_cylinder_dpt, float(degrees)))
        rows.append(
            row(
                *("published", "toric, turned", f"{degrees} deg: {left / 2.0:.3f}"),
                *(times_ms, "ratio", left / 2.0 - expected, rotation["source"]),
            )
        )
    plane = PUBLISHED["toric"]["plane"]
    lens, times_ms = _timed(
        partial(worn, kind="iol", cylinder_dpt=plane["at_lens_dpt"], axis_deg=90.0)
    )
    _, j0, j45 = rx.power_vector(lens)
    found = 2.0 * float(np.hypot(j0, j45))
    rows.append(
        row(
            *("published", "toric, at cornea", f"1.5 dpt: {found:.3f}", times_ms),
            *("dpt", found - plane["at_cornea_dpt"], plane["source"]),
        )
    )
    return rows


def people_rows() -> list[Row]:
    """Return rows of what people read, beside what ours let them."""
    rows: list[Row] = []

    def add(case, setting, name, found, expected, source, times_ms) -> None:
        text = f"{setting}: {found:.2f}"
        error = found - expected
        rows.append(row("people", case, text, times_ms, name, error, source))

    table = TABLES["edof"]
    objects_dpt = np.arange(0.0, table["flat_to_dpt"] + 0.1, 0.25)
    flat, times_ms = _timed(lambda: read_through_focus(objects_dpt))
    source, to = table["source"], f"to {table['flat_to_dpt']:g} dpt"
    for name, found in (("best", flat.min()), ("worst", flat.max())):
        expected = table[f"{name}_log_mar"]
        add("Symfony", f"{name} {to}", "logMAR", found, expected, source, times_ms)
    for dpt, expected in table["log_mar_by_dpt"].items():
        found, times_ms = _timed(lambda dpt=dpt: read_through_focus([float(dpt)])[0])
        add("Symfony", f"at {dpt} dpt", "logMAR", found, expected, source, times_ms)
    table = TABLES["lenslets"]
    lost, times_ms = _timed(lost_by_lenslets)
    for name, key, found in zip(
        ("logMAR", "log contrast"),
        ("lost_log_mar", "lost_log_contrast"),
        lost,
        strict=True,
    ):
        for side, expected in table[key].items():
            setting = f"{name} lost, {side} gaze"
            add("DIMS", setting, name, found, expected, table["source"], times_ms)
    table = TABLES["progressive"]
    width_mm, times_ms = _timed(corridor_width_mm)
    add(
        *("progressive", "corridor's width, mm", "mm", width_mm, table["width_mm"]),
        *(table["source"], times_ms),
    )
    return rows


def plan_rows() -> list[Row]:
    """Return rows of blended PSFs, less what their plans predict."""
    rows = []
    bodies = {name: {"kind": "iol"} | body for name, body in LINES.items()}
    bodies["monofocal"] = {"kind": "iol"}
    bodies["lenslets"] = {"kind": "lenslets", "sphere_dpt": 0.0, "vertex_mm": 12.0}
    for name, body in bodies.items():
        profile = parse_profile(
            {"kind": "prescription", "sphere_dpt": 0.0, "correction": body}
        )
        for eye_model in ("traced", "wavefront"):
            start_s = time.perf_counter()
            spec = spec_for(WIDTH_PX, HEIGHT_PX, mode="dynamic", eye_model=eye_model)
            eye, _ = eye_for_spec(profile, spec)
            plan = unchecked_plan(eye, spec)
            times_ms = [1e3 * (time.perf_counter() - start_s)]
            found_db = mean_db(sampled_errors(eye, spec, plan, count=STATES))
            planned_db = plan.prediction.interpolation_db
            setting = (
                f"{eye_model}, {WIDTH_PX}x{HEIGHT_PX}, "
                f"{plan.prediction.psf_count} PSFs, "
                f"planned for {planned_db:.1f} dB: {found_db:.1f}"
            )
            rows.append(
                row(
                    *("plan", name, setting, times_ms, "dB"),
                    *(found_db - planned_db, "exact PSFs at random states"),
                    n=STATES,
                )
            )
    return rows


def kernel_rows() -> list[Row]:
    """Return the time of a PSF with rings and without, one thread."""
    rows = []
    t_dpt = np.linspace(0.0, 3.0, KERNELS)
    for pupil_mm in (3.0, 6.0):
        zernike_um = np.stack(
            [
                rx.zernike_from_power_vector(
                    t, 0.0, 0.0, zernike_radius_mm=pupil_mm / 2.0
                )
                for t in t_dpt
            ]
        )
        for name, rings in (
            ("none", None),
            ("bifocal", worn_eye(**LINES["bifocal"]).rings),
        ):
            median_ms, p95_ms = time_calls(
                partial(
                    compute_psf_batch,
                    zernike_um,
                    pupil_diameter_mm=pupil_mm,
                    wavelength_nm=DESIGN_NM,
                    pixel_pitch_mrad=1.0,
                    pupil_screen=rings,
                    workers=1,
                ),
                repeats=5,
                per_call=KERNELS,
            )
            rows.append(
                row(
                    *("kernels", name, f"{pupil_mm:g} mm, 1 mrad, one thread"),
                    *([median_ms, p95_ms], "modulation", kernel_error(name, pupil_mm)),
                    "true profile, FFT",
                    n=KERNELS,
                )
            )
    return rows


def kernel_error(name: str, pupil_mm: float) -> float:
    """Largest error of modulation at that pupil, in focus and 1.5 dpt out of it."""
    body = LINES["bifocal"] if name != "none" else {"design": "monofocal"}
    eye, truth = worn_eye(**body), Truth(pupil_mm, DESIGN_NM)
    objects_dpt = [0.0, 1.5]
    found = modulation(
        eye, objects_dpt, pupil_mm=pupil_mm, wavelength_nm=DESIGN_NM, at_cpd=AT_CPD
    )
    behind = 1.0 if eye.rings is None else truth.profile(eye.rings)
    shift_dpt = eye.chromatic_shift_dpt(DESIGN_NM) + eye.refraction_at_dpt(
        pupil_diameter_mm=pupil_mm
    )
    true = [
        truth.modulation(behind * truth.defocused(d + shift_dpt), AT_CPD)
        for d in objects_dpt
    ]
    return float(np.abs(found - true).max())


def measure(run: Run) -> list[Row]:
    """Return all rows, or closed forms and those of one pupil."""
    pupils_mm = PUPILS_MM[1:2] if run.is_quick else PUPILS_MM
    rows = closed_form_rows() + toric_rows()
    rows += diffraction_rows(pupils_mm) + lenslet_rows(pupils_mm)
    rows += transfer_rows() + distance_rows() + people_rows()
    return rows if run.is_quick else rows + kernel_rows() + plan_rows()
