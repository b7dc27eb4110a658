"""A scene recovered from the image on a retina, by least squares and by gradients.

    python examples/12_deblur.py

An eye of -1 diopter sees the courtyard, and the image has noise of 0.5 % of white.
`EyeFilter.operator` is the filter as a matrix, which LSQR inverts: more iterations
restore more detail, and more noise.  With PyTorch (`pip install 'ocufilter[torch]'`),
Adam minimizes the difference plus the total variation of the scene, by the gradients
of `ocufilter.torch.SeeThrough`.
"""

import numpy as np
from common import load_courtyard, save_pictures
from PIL import Image
from scipy.sparse.linalg import lsqr

from ocufilter import Camera, EyeFilter

WIDTH_PX, HEIGHT_PX, FOV_DEG = 240, 150, 5.0
VIEWER = {"kind": "prescription", "sphere_dpt": -1.0}
STATE = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.0}
NOISE = 0.005
WEIGHT = 5e-4  # of the total variation


def linear(srgb8):
    """Return 8-bit sRGB as linear light."""
    value = srgb8 / 255.0
    high = ((value + 0.055) / 1.055) ** 2.4
    return np.where(value < 0.04045, value / 12.92, high).astype(np.float32)


def srgb8(light):
    """Return linear light as 8-bit sRGB."""
    value = np.clip(light, 0.0, 1.0)
    curve = 1.055 * value ** (1.0 / 2.4) - 0.055
    return np.rint(255.0 * np.where(value < 0.0031, 12.92 * value, curve)).astype("u1")


def psnr_db(light):
    """Return the PSNR relative to the scene; white is the peak."""
    return -10.0 * np.log10(np.mean((np.clip(light, 0.0, 1.0) - scene) ** 2))


def by_gradients(image, camera, n_steps=150):
    """Return the scene that minimizes the difference and the total variation."""
    import torch

    from ocufilter.torch import SeeThrough

    see = SeeThrough(VIEWER, camera, far_m, settings=SETTINGS, **STATE)
    seen = torch.from_numpy(image.transpose(2, 0, 1).copy())
    x = seen.clone().requires_grad_(True)
    optimizer = torch.optim.Adam([x], lr=0.02)
    for _ in range(n_steps):
        optimizer.zero_grad()
        steps = x.diff(dim=1)[:, :, :-1], x.diff(dim=2)[:, :-1]
        variation = (steps[0] ** 2 + steps[1] ** 2 + 1e-6).sqrt().mean()
        loss = (see(x) - seen).square().mean() + WEIGHT * variation
        loss.backward()
        optimizer.step()
    return x.detach().numpy().transpose(1, 2, 0)


SETTINGS = {"mode": "on-axis"}
color, _, _ = load_courtyard()
part = Image.fromarray(color).crop((80, 60, 400, 260)).resize((WIDTH_PX, HEIGHT_PX))
scene = linear(np.asarray(part))
far_m = np.full((HEIGHT_PX, WIDTH_PX), np.inf, np.float32)
camera = Camera.from_fov(FOV_DEG, width_px=WIDTH_PX, height_px=HEIGHT_PX)
with EyeFilter(VIEWER, camera, SETTINGS) as eye_filter:
    operator = eye_filter.operator(far_m, **STATE)
noise = NOISE * np.random.default_rng(0).standard_normal(scene.shape)
image = (operator.forward(scene) + noise).astype(np.float32)

found = [("the scene", scene), ("seen, with noise", image)]
for n_iterations in (5, 20, 100):
    solved = lsqr(operator.as_linear_operator(), image.ravel(), iter_lim=n_iterations)[
        0
    ].reshape(scene.shape)
    found.append((f"LSQR, {n_iterations} steps", solved))
try:
    found.append(("gradients", by_gradients(image, camera)))
except ImportError:
    print("PyTorch is not installed: no picture by gradients")

pictures = [("the scene", srgb8(scene))]
for caption, light in found[1:]:
    print(f"{caption}: {psnr_db(light):.1f} dB")
    pictures.append((f"{caption}: {psnr_db(light):.1f} dB", srgb8(light)))
save_pictures("12_deblur.png", pictures, columns=3)
