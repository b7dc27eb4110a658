"""From an aberrometer file to the blur over the visual field.

    python examples/02_aberrometer_to_field.py

The file contains on-axis Zernike coefficients, to which an eye model is fitted.  Most
aberrometers do not measure the periphery, so it is predicted from population data.  The
figure shows the image of a point of light in fifteen directions, and the refraction
along the horizontal meridian.
"""

import numpy as np
from common import DATA, OUT
from matplotlib.figure import Figure

from ocufilter import compute_psfs, estimate_eye, load_profile, prepare_eye

PUPIL_MM, GREEN_NM = 4.0, 536.0  # the default green primary
H_DEG = np.array([-30.0, -15.0, 0.0, 15.0, 30.0])  # to the person's right
V_DEG = np.array([15.0, 0.0, -15.0])  # up
PIXEL_ARCMIN = 0.75
HALF_ARCMIN = 24.0  # half the width of each panel
ARCMIN_PER_MRAD = 3.4377

profile = load_profile(DATA / "aberrometer.csv")
found = estimate_eye(profile)
print(f"eye of {found.parameters.eye_length_mm:.1f} mm, fitted to", end=" ")
print(f"{1000 * found.mean_abs_error_um:.2g} nm")

# Relaxed accommodation, over the field, through a 4 mm pupil.
eye, notes = prepare_eye(profile, field_range_deg=((-30.0, 30.0), (-15.0, 15.0)))
print(*notes, sep="\n")
h_deg, v_deg = (grid.ravel() for grid in np.meshgrid(H_DEG, V_DEG))
place = {"h_deg": h_deg, "v_deg": v_deg, "pupil_diameter_mm": PUPIL_MM}
state = place | {"accommodation_dpt": 0.0, "wavelength_nm": GREEN_NM}
defocus_dpt = eye.total_defocus_dpt(**state)
waves = eye.wavefronts(**state, total_defocus_dpt=defocus_dpt)
psfs = compute_psfs(
    waves.zernike_um,
    pupil_diameter_mm=waves.circle_diameter_mm,
    pupil_ellipse=waves.pupil_ellipse,
    wavelength_nm=GREEN_NM,
    pixel_pitch_mrad=PIXEL_ARCMIN / ARCMIN_PER_MRAD,
)


def framed(kernel):
    """Return a kernel cropped or padded to a panel, with a maximum of 1."""
    half = round(HALF_ARCMIN / PIXEL_ARCMIN)
    radius = kernel.shape[0] // 2
    padded = np.pad(kernel, max(0, half - radius))
    middle = padded.shape[0] // 2
    cut = padded[middle - half : middle + half + 1, middle - half : middle + half + 1]
    return np.sqrt(cut / cut.max())  # the square root makes faint light visible


figure = Figure(figsize=(9.5, 7.5), layout="constrained")
points, horizon = figure.subfigures(2, 1, height_ratios=[3.0, 1.6])
points.suptitle(f"A point of light at infinity, pupil {PUPIL_MM:g} mm, 48 arcmin wide")
for k, axes in enumerate(points.subplots(V_DEG.size, H_DEG.size).ravel()):
    axes.imshow(framed(psfs[k].kernel), cmap="gray")
    axes.set_title(f"{h_deg[k]:g}°, {v_deg[k]:g}°", fontsize=9)
    axes.set_axis_off()

along_deg = np.linspace(-30.0, 30.0, 31)
along = place | {"h_deg": along_deg, "v_deg": 0.0}
refraction_dpt = eye.total_defocus_dpt(
    **along, accommodation_dpt=0.0, wavelength_nm=GREEN_NM
)
axes = horizon.subplots()
axes.plot(along_deg, refraction_dpt, color="#0b5d8a")
axes.axhline(0.0, color="#59636c", linewidth=0.8)
axes.set_xlabel("direction, degrees (positive: the person's right)")
axes.set_ylabel("refraction, diopters")
axes.set_title("Refraction along the horizontal meridian")
axes.grid(alpha=0.3)

OUT.mkdir(parents=True, exist_ok=True)
figure.savefig(OUT / "02_aberrometer_to_field.png", dpi=100)
print(OUT / "02_aberrometer_to_field.png")
