"""Fits the law of `planning/state_samples.py`: what blending two PSFs costs an image.

    python -m tests.benchmarks.plan_law [--quick]

States are drawn as `sample_states` draws them, neighbours at random distances along one
axis, blended half and half; the error is that of frames of *Courtyard* filtered with
the blend and with the exact PSF.  Writes results/plan_law.json.
"""

import argparse
import math

import numpy as np
from scipy.optimize import least_squares

from filter_service.planning import state_samples as law
from filter_service.planning.node_wavefronts import PupilStates, slopes_px, state_frames
from filter_service.planning.state_samples import moved, sample_states
from tests.benchmarks.harness import commit_id, machine_info, write_report
from tests.numerical.plan_cases import (
    exact_kernels,
    image_error,
    spec_for,
    traced_eye,
)
from tests.numerical.scene_frames import scene_view

EYES = ("emmetropia", "myopia", "astigmatism", "keratoconus", "post_lasik")
WIDTHS_PX = (480, 1280, 2000)
AXES = ("h", "v", "pupil", "accommodation", "defocus")
STEPS = {  # smallest and largest half distance of the neighbours
    "h": (0.3, 10.0),
    "v": (0.3, 8.0),
    "pupil": (0.05, 1.2),
    "accommodation": (0.2, 2.0),
    "defocus": (0.05, 1.0),
}
NOISE_DB, TRUSTED_DB = 66.0, (25.0, 60.0)
"""Methods differ by the first; the fit holds where it predicts the second."""


def srgb_to_linear(color):
    c = np.asarray(color, float) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def frame_spectrum(image, side_px=512):
    """Variance of a pixel per frequency (side, side), over windows of a frame."""
    window = np.outer(np.hanning(side_px), np.hanning(side_px))
    parts = []
    for y in range(0, image.shape[0] - side_px + 1, max(1, image.shape[0] - side_px)):
        for x in range(0, image.shape[1] - side_px + 1, side_px // 2):
            for c in range(3):
                part = image[y : y + side_px, x : x + side_px, c]
                part = (part - (part * window).sum() / window.sum()) * window
                parts.append(np.abs(np.fft.fft2(part)) ** 2 / (window**2).sum())
    return np.mean(parts, axis=0)


def neighbours(sample, axis, rng, limits):
    """Lower and upper neighbours of states, and which of them stay in the limits."""
    count = sample.vergence_dpt.size
    low, high = STEPS[axis]
    step = np.exp(rng.uniform(math.log(low), math.log(high), count))
    if axis == "defocus":
        columns = vars(sample.states)
        total_dpt = columns["total_defocus_dpt"]
        pair = [
            PupilStates(**columns | {"total_defocus_dpt": total_dpt + sign * step})
            for sign in (-1.0, 1.0)
        ]
        return pair, np.ones(count, bool)
    name = {"pupil": "pupil_diameter_mm", "accommodation": "accommodation_dpt"}
    values = vars(sample.states)[name.get(axis, f"{axis}_deg")]
    first, last = limits[axis]
    good = (values - step >= first) & (values + step <= last)
    step = np.where(good, step, 0.0)
    return [moved(sample, axis, values + sign * step) for sign in (-1.0, 1.0)], good


def measured(name, width_px, axis, rng, count, spectrum):
    """Features and mean square errors of random neighbours along an axis."""
    spec = spec_for(width_px, width_px * 9 // 16, mode="dynamic")
    eye = traced_eye(name, spec)
    sample = sample_states(eye, spec, 4096)
    sample = sample.select(rng.choice(4096, count, replace=False))
    pupils_mm = tuple(eye.usable_pupil_mm(p) for p in spec.settings.pupil_range_mm)
    used_dpt = eye.accommodation_nodes_dpt(
        spec.settings.focus_range_dpt, pupil_range_mm=pupils_mm
    )
    limits = {
        "h": spec.field_range_deg[0],
        "v": spec.field_range_deg[1],
        "pupil": pupils_mm,
        "accommodation": (used_dpt[0], used_dpt[-1]),
    }
    pair, good = neighbours(sample, axis, rng, limits)
    low_px, high_px = (slopes_px(state_frames(eye, spec, states)) for states in pair)
    good &= np.hypot(*np.moveaxis(sample.exact_px, -1, 0)).max(axis=1) < 90.0
    kernels = [exact_kernels(eye, spec, states) for states in (*pair, sample.states)]
    errors = np.full(count, np.nan)
    for k in np.flatnonzero(good):
        side = max(batch[k].kernel.shape[0] for batch in kernels)
        difference = np.zeros((side, side))
        for weight, batch in zip((0.5, 0.5, -1.0), kernels, strict=True):
            kernel = batch[k].kernel
            edge = (side - kernel.shape[0]) // 2
            inner = slice(edge, side - edge)
            difference[inner, inner] += weight * kernel / kernel.sum(dtype=np.float64)
        errors[k] = image_error(difference, spectrum)
    aside_px = 0.5 * (low_px + high_px) - sample.exact_px
    features = {
        "difference2": law.mean_square(high_px - low_px),
        "aside2": law.mean_square(aside_px),
        "covariance": law.spot_covariance(sample.exact_px),
        "unit": sample.unit_px,
    }
    return {k: v[good] for k, v in features.items()}, errors[good]


def predicted(p, data):
    """Log RMS error by the law with parameters p."""
    doubling, aside, exponent, sharp, own, diffraction = p
    xx, yy, xy = data["covariance"].T
    more = (
        math.exp(2 * sharp)
        + math.exp(own) * data["difference2"]
        + math.exp(diffraction) * data["unit"] ** 2
    )
    blur2 = np.sqrt(np.maximum((xx + more) * (yy + more) - xy * xy, more * more))
    square = (math.exp(doubling) * data["difference2"] / blur2**exponent) ** 2
    square += math.exp(2 * aside) * data["aside2"] * blur2 ** (1 - 2 * exponent)
    return 0.5 * np.log(square + 1e-20)


def fit(data, errors):
    """Parameters, and which pairs the law is trusted for."""
    noise = 10 ** (-NOISE_DB / 10)
    wanted = 0.5 * np.log(np.maximum(errors, noise))
    p = np.array([-5.4, -3.7, 0.82, -0.7, -1.5, 0.7])
    for _ in range(4):
        db = -20.0 / math.log(10.0) * predicted(p, data)
        kept = (db > TRUSTED_DB[0]) & (db < TRUSTED_DB[1])

        def residual(p, kept=kept):
            with_noise = 0.5 * np.log(np.exp(2 * predicted(p, data)) + noise)
            return (with_noise - wanted)[kept]

        p = least_squares(residual, p, loss="soft_l1", f_scale=0.3).x
    return p, kept


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    is_quick = parser.parse_args().quick
    parts = 8 if is_quick else 60
    frame = scene_view("courtyard", width_px=1280, height_px=720)
    spectrum = frame_spectrum(srgb_to_linear(frame.color))
    rng = np.random.default_rng(0)
    found = []
    for name in EYES:
        for width_px in WIDTHS_PX:
            for axis in AXES:
                data, errors = measured(name, width_px, axis, rng, parts, spectrum)
                found.append((axis, width_px, data, errors))
    data = {k: np.concatenate([f[2][k] for f in found]) for k in found[0][2]}
    errors = np.concatenate([f[3] for f in found])
    axis = np.concatenate([np.full(f[3].size, f[0]) for f in found])
    width = np.concatenate([np.full(f[3].size, f[1]) for f in found])
    p, kept = fit(data, errors)
    ratio_db = 10.0 * np.log10(errors) - 20.0 / math.log(10.0) * predicted(p, data)
    square = np.exp(2.0 * predicted(p, data))
    by_power = {}
    for low in range(30, 66, 6):
        part = (-10 * np.log10(square) > low - 3) & (-10 * np.log10(square) <= low + 3)
        mean_ratio = errors[part].sum() / square[part].sum()
        by_power[low] = (int(part.sum()), round(10 * math.log10(mean_ratio), 1))
    report = {
        "machine": machine_info(),
        "commit": commit_id(),
        "pairs": int(errors.size),
        "fitted": int(kept.sum()),
        "doubling": math.exp(p[0]),
        "aside": math.exp(p[1]),
        "blur_exponent": p[2],
        "sharp_px": math.exp(p[3]),
        "own_share": math.exp(p[4]),
        "diffraction_share": math.exp(p[5]),
        "spread_db": float(ratio_db[kept].std()),
        "mean_square_over_law_db": by_power,
        "by_axis_db": {
            a: [
                round(float(ratio_db[kept & (axis == a)].mean()), 1),
                round(float(ratio_db[kept & (axis == a)].std()), 1),
                round(
                    10
                    * math.log10(
                        errors[kept & (axis == a)].sum()
                        / square[kept & (axis == a)].sum()
                    ),
                    1,
                ),
            ]
            for a in AXES
        },
        "by_width_db": {
            int(w): [
                round(float(ratio_db[kept & (width == w)].mean()), 1),
                round(
                    10
                    * math.log10(
                        errors[kept & (width == w)].sum()
                        / square[kept & (width == w)].sum()
                    ),
                    1,
                ),
            ]
            for w in WIDTHS_PX
        },
    }
    for key, value in report.items():
        print(f"{key}: {value}")
    if not is_quick:
        write_report("plan_law", report)


if __name__ == "__main__":
    main()
