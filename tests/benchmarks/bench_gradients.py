"""Derivatives of images by parameters of an eye: time beside error.

Smooth blobs of light, 48x32 px of 0.65 mrad, at one wavelength, through six eyes.

- smooth: one distance.  The reference is the derivative of images by float64 quadrature
  of the profile's own coefficients (`tests.reference.flat_image`).  "fitted" is a
  reference whose wavefront in the entrance pupil is fitted with 28 terms, as the
  filter's is: the wavefront of keratoconus is not a polynomial there.
- edge: the left part is nearer by 1 dpt and covers the rest.  The reference is a
  Richardson difference of `EyeFilter.filter` with a render tolerance of 0, at 0.7 and
  1.3 times the normal steps, whose own error is that of the accuracy "normal".
  "beyond" leaves out the pixels within 4 px of the edge, where the image has kinks as a
  function of the state.

"amplitude" is the error of the projection of a derivative image on the reference, "RMS"
that of pixels relative to the RMS of the reference.  Eyes accommodate for derivatives
by pupil and focus, and are relaxed for those by numbers of the profile.
"""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.profiles.bodies import PRESETS
from filter_service import (
    Camera,
    EyeFilter,
    FilterSettings,
    RgbdView,
    image_derivatives,
)
from filter_service.filtering.derivatives import ACCURACIES, PROFILE_STEPS, STEPS
from tests.benchmarks.harness import Row, Run, memory_mb
from tests.reference.flat_image import (
    FlatScene,
    derivative,
    wavefront_of_profile,
)

MINUTES = 4
WIDTH, HEIGHT = 48, 32
CAMERA = Camera.from_fov(1.2, width_px=WIDTH, height_px=HEIGHT)
SETTINGS = FilterSettings(mode="on-axis", eye_model="wavefront", chromatic=False)
NEARER_DPT, EDGE_COLUMN, EDGE_PX = 1.0, 20, 4
REFERENCE_STEP = 0.01
RICHARDSON_RATIOS = (0.7, 1.3)
STATE_PARAMETERS = ("pupil_diameter_mm", "focus_dpt")
PRESCRIPTIONS = {
    "myopia": {"sphere_dpt": -2.0},
    "astigmatism": {"sphere_dpt": -1.0, "cylinder_dpt": -1.5, "axis_deg": 30.0},
}
STATES = {
    # pupil, focus and distance while accommodating; distance while relaxed
    "emmetropia": (4.0, 2.0, 1.5, None),
    "myopia": (4.0, 2.5, 2.0, 1.2),
    "astigmatism": (4.0, 2.5, 2.0, 1.0),
    "keratoconus": (4.0, 4.0, 3.5, 2.5),
    "cataract": (3.6, 2.5, 2.0, 1.4),
    "post_lasik": (2.7, 3.0, 2.5, 1.4),
}


def blobs() -> NDArray[np.float64]:
    """Return smooth light (height, width)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    found = np.full((HEIGHT, WIDTH), 0.15)
    for peak, column, row, size_px in (
        (0.7, 17, 13, 2.0),
        (0.5, 31, 19, 3.0),
        (-0.1, 25, 10, 1.6),
    ):
        square = (x - column) ** 2 + (y - row) ** 2
        found += peak * np.exp(-square / (2.0 * size_px**2))
    return found


LIGHT = blobs()
COLOR = np.repeat(LIGHT[..., None], 3, axis=2).astype(np.float32)


def profiles(name: str) -> dict[str, dict]:
    """Return the profile of an eye, without haze, for each group of parameters."""
    if name in PRESCRIPTIONS:
        body = {"kind": "prescription", "higher_order": "none", **PRESCRIPTIONS[name]}
        polynomial_um, nm = wavefront_of_profile(body)
        square, cross = 6.0**0.5, 3.0**0.5
        radius_mm = 3.0  # of an equal wavefront with a number for C(4,0)
        sums = polynomial_um[2, 0] + polynomial_um[0, 2], polynomial_um[1, 1]
        terms_um = {
            "2,-2": sums[1] * radius_mm**2 / (2.0 * square),
            "2,0": sums[0] * radius_mm**2 / (4.0 * cross),
            "2,2": (polynomial_um[2, 0] - polynomial_um[0, 2])
            * (radius_mm**2 / (2.0 * square)),
            "4,0": 0.1,
        }
        wavefront = {
            "kind": "zernike",
            "pupil_diameter_mm": 2.0 * radius_mm,
            "wavelength_nm": nm,
            "zernike_um": terms_um,
        }
        return {"state": body, "sphere_dpt": body, "zernike_um.4,0": wavefront}
    body = dict(PRESETS[name])
    body.pop("straylight", None)
    body["zernike_um"] = {"4,0": 0.0, **body["zernike_um"]}
    found = {"state": body, "zernike_um.4,0": body}
    if STATES[name][3] is not None:
        found["zernike_um.2,0"] = body
    return found


def scene_of(profile: dict, pupil_mm: float, focus_dpt: float, object_dpt: float):
    """Return the scene of the quadrature."""
    cornea_um, measured_nm = wavefront_of_profile(profile)
    return FlatScene(
        cornea_um=cornea_um,
        measured_nm=measured_nm,
        pupil_diameter_mm=pupil_mm,
        focus_dpt=focus_dpt,
        object_dpt=object_dpt,
        light=LIGHT,
        pitch_mrad=CAMERA.pixel_pitch_mrad,
    )


def quadrature(scene: FlatScene, parameter: str, profile: dict) -> NDArray[np.float64]:
    """Return the derivative (height, width) of an image by quadrature."""

    def image_at(value: float) -> NDArray[np.float64]:
        if parameter in STATE_PARAMETERS:
            own = replace(scene, **{parameter: value})
        elif parameter.endswith("sphere_dpt"):
            own = scene.with_power(value)
        else:
            n, m = map(int, parameter.rpartition(".")[2].split(","))
            own = scene.with_term(n, m, value, profile["pupil_diameter_mm"] / 2.0)
        return own.image()[..., 0]

    value = getattr(scene, parameter) if parameter in STATE_PARAMETERS else 0.0
    return derivative(image_at, value, REFERENCE_STEP)


def richardson(profile: dict, view: RgbdView, parameter: str, state: dict):
    """Return the derivative (height, width) from differences of filtered frames."""
    keys = parameter.removeprefix("profile.").split(".", 1)
    step = {**STEPS, "sphere_dpt": PROFILE_STEPS["_dpt"]}.get(
        keys[0], PROFILE_STEPS["_um"]
    )

    def image_at(change: float) -> NDArray[np.float64]:
        own, own_state = profile, state
        if parameter in STATE_PARAMETERS:
            own_state = {**state, parameter: state[parameter] + change}
        elif len(keys) == 1:
            own = {**profile, keys[0]: profile[keys[0]] + change}
        else:
            terms = profile[keys[0]]
            own = {**profile, keys[0]: {**terms, keys[1]: terms[keys[1]] + change}}
        with EyeFilter(own, CAMERA, SETTINGS) as eye_filter:
            return (
                eye_filter.filter(
                    view,
                    **own_state,
                    output="linear",
                    whole=True,
                    merge=False,
                    bright_pixels=False,
                    render_tolerance=0.0,
                )
                .color[..., 1]
                .astype(float)
            )

    short, long = (
        (image_at(h) - image_at(-h)) / (2.0 * h)
        for h in (ratio * step for ratio in RICHARDSON_RATIOS)
    )
    ratio = (RICHARDSON_RATIOS[1] / RICHARDSON_RATIOS[0]) ** 2
    return (ratio * short - long) / (ratio - 1.0)


def errors(found, expected) -> dict[str, float]:
    """Return the errors of a derivative image."""
    size = np.vdot(expected, expected)
    return {
        "amplitude": abs(float(np.vdot(found, expected) / size) - 1.0),
        "RMS": float(np.linalg.norm(found - expected) / size**0.5),
    }


def rows_of(name: str) -> Iterator[Row]:
    """Rows of one eye."""
    pupil_mm, focus_dpt, object_dpt, relaxed_dpt = STATES[name]
    for group, profile in profiles(name).items():
        names, state = [f"profile.{group}"], {"focus_dpt": 0.0}
        if group == "state" or relaxed_dpt is None:
            state = {"focus_dpt": focus_dpt}
        if group == "state":
            names = list(STATE_PARAMETERS)
        near_dpt = object_dpt if state["focus_dpt"] else relaxed_dpt
        state["pupil_diameter_mm"] = pupil_mm
        scene = scene_of(profile, pupil_mm, state["focus_dpt"], near_dpt)
        scenes = {"quadrature": scene}
        if name == "keratoconus":
            radius_mm = profile["pupil_diameter_mm"] / 2.0
            scenes["fitted"] = replace(scene, fit_radius_mm=radius_mm)
        distances_dpt = np.full((HEIGHT, WIDTH), near_dpt)
        edge_dpt = distances_dpt + NEARER_DPT * (np.arange(WIDTH) < EDGE_COLUMN)
        for parameter in names:
            for setting, dpt in (("smooth", distances_dpt), ("edge", edge_dpt)):
                view = RgbdView(COLOR, (1.0 / dpt).astype(np.float32), CAMERA.tangents)
                view = replace(view, depth_kind="radial")
                if setting == "smooth":
                    truths = {
                        reference: quadrature(own, parameter, profile)
                        for reference, own in scenes.items()
                    }
                else:
                    truths = {"Richardson": richardson(profile, view, parameter, state)}
                yield from _rows(name, setting, profile, view, parameter, state, truths)


def _rows(name, setting, profile, view, parameter, state, truths) -> Iterator[Row]:
    for accuracy in ACCURACIES:
        with EyeFilter(profile, CAMERA, SETTINGS) as eye_filter:
            eye_filter.operator(view, **state)
            start_s = time.perf_counter()
            found = image_derivatives(
                *(eye_filter, COLOR, view, [parameter]),
                **state,
                profile=profile,
                accuracy=accuracy,
            )[parameter][..., 1]
            taken_ms = 1e3 * (time.perf_counter() - start_s)
        for reference, truth in truths.items():
            measured = errors(found, truth)
            if setting == "edge":
                is_far = np.abs(np.arange(WIDTH) - EDGE_COLUMN + 0.5) > EDGE_PX
                beyond = errors(found[:, is_far], truth[:, is_far])
                measured |= {f"{key}, beyond": value for key, value in beyond.items()}
            for error_name, error in measured.items():
                yield Row(
                    *("gradients", accuracy, name),
                    f"{setting} {parameter.removeprefix('profile.')}",
                    *(1, taken_ms, taken_ms, memory_mb()),
                    *(error_name, error, reference),
                )


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes, or of one."""
    eyes = list(STATES)[: 1 if run.is_quick else None]
    return [row for name in eyes for row in rows_of(name)]
