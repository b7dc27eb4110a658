"""Runs in the environment of the peers: DeepLens's defocus of an RGB-D image.

``render_rgbd`` is the method of `deeplens.DefocusLens`, whose PSF is a Gaussian cut off
at the circle of confusion.  "pillbox" calls what that method calls, with the library's
even discs and layers that are uniform in diopters, which is nearer to an eye.

``gradient`` traces rays through the surfaces of an eye, as a `deeplens.GeoLens`.  It
treats what is behind an aperture as air and its sensor is flat, so the stop must be at
the vertex of a surface, and only the axis is right.
"""

import json
import math
import time
from pathlib import Path

import numpy as np

FOCAL_LENGTH_MM = 17.0
"""Any: the sensor is scaled so that the angles are those of the eye."""

CLEAR_RADIUS_MM = 4.0
"""Of surfaces without the stop."""

FARTHEST_MM = 1e6
"""Distance of what is farther, so that disparities are finite."""


def lens_numbers(focus_dpt, pupil_mm, pitch, size_px):
    """Focal length, f-number, focus and sensor of a thin lens with an eye's blur.

    Parameters
    ----------
    focus_dpt : float
        Of the sharpest object; beyond infinity, the lens is focused at `FARTHEST_MM`.
    pupil_mm : float
    pitch : float
        Tangent of a pixel.
    size_px : (width, height)
    """
    focus_mm = 1000.0 / max(focus_dpt, 1000.0 / FARTHEST_MM)
    image_mm = FOCAL_LENGTH_MM * focus_mm / (focus_mm - FOCAL_LENGTH_MM)
    # DeepLens compares the aspect ratios exactly, which short numbers allow
    pixel_mm = float(np.float32(pitch * image_mm))
    return {
        "foclen": FOCAL_LENGTH_MM,
        "fnum": FOCAL_LENGTH_MM / pupil_mm,
        "focus_mm": focus_mm,
        "sensor_size": tuple(pixel_mm * side for side in size_px),
        "sensor_res": tuple(size_px),
    }


def kernel_side_px(circle_mm, pixel_mm):
    """Smallest odd side that holds a circle of confusion of this diameter."""
    return 2 * math.ceil(circle_mm / pixel_mm / 2) + 1


def lens_file(surfaces, stop_z_mm, retina, stop_radius_mm, pixel_mm, side_px):
    """Content of a lens file of DeepLens; see `peer_optiland.eye_request`."""
    if stop_z_mm not in [s["z_mm"] for s in surfaces]:
        raise ValueError("the stop must be at the vertex of a surface")
    ends_mm = [s["z_mm"] for s in surfaces[1:]] + [retina["z_mm"]]
    rows = []
    for surface, end_mm in zip(surfaces, ends_mm, strict=True):
        is_stop = surface["z_mm"] == stop_z_mm
        rows.append(
            {
                "type": "Aspheric",
                "roc": surface["radius_mm"],
                "k": surface["conic_constant"],
                "ai": [],
                "r": stop_radius_mm if is_stop else CLEAR_RADIUS_MM,
                "is_aperture": is_stop,
                "d": surface["z_mm"],
                "d_next": end_mm - surface["z_mm"],
                # index and Abbe number, the second so large that it has no effect
                "mat2": f"{surface['index_after']:.9f}/1e9",
            }
        )
    return {
        "surfaces": rows,
        "obj_depth": -FARTHEST_MM,
        "r_sensor": pixel_mm * side_px / math.sqrt(2.0),
        "sensor_res": [side_px, side_px],
    }


def opened_lens(folder, eye, pupil_mm, pitch, side_px):
    """An eye as a lens with a sensor, and the size of its pixels."""
    from deeplens import GeoLens

    def lens(stop_radius_mm, pixel_mm):
        path = Path(folder) / "lens.json"
        content = lens_file(
            **eye, stop_radius_mm=stop_radius_mm, pixel_mm=pixel_mm, side_px=side_px
        )
        path.write_text(json.dumps(content))
        return GeoLens(str(path), device="cpu")

    first = lens(pupil_mm / 2, pitch * FOCAL_LENGTH_MM)
    focal_length_mm = float(first.foclen) / eye["surfaces"][-1]["index_after"]
    stop_radius_mm = (pupil_mm / 2) ** 2 / float(first.entr_pupilr)
    pixel_mm = pitch * focal_length_mm
    return lens(stop_radius_mm, pixel_mm), pixel_mm


def gradient(folder, eye, wavelength_nm, pupil_mm, pitch, rays):
    """Derivative of a PSF's sum, weighted with a blob, by the radius of the cornea."""
    import torch

    torch.manual_seed(0)
    blob = torch.from_numpy(np.load(Path(folder) / "blob.npy").astype(np.float32))
    side_px = len(blob)
    opened, pixel_mm = opened_lens(folder, eye, pupil_mm, pitch, side_px)
    cornea = opened.surfaces[0]
    curvature_per_mm = cornea.c.detach().clone()
    point = torch.tensor([[0.0, 0.0, -FARTHEST_MM]])
    for _ in range(2):  # the first warms up
        start_s = time.perf_counter()
        cornea.c = curvature_per_mm.clone().requires_grad_()
        psf = opened.psf(point, ks=side_px, wvln=wavelength_nm / 1000.0, spp=rays)[0]
        light = blob @ psf @ blob
        light.backward()
        taken_s = time.perf_counter() - start_s
    slope = float(cornea.c.grad) * -(float(curvature_per_mm) ** 2)  # c = 1 / R
    return {
        "gradient": slope,
        "light": float(light),
        "pixel_mm": pixel_mm,
        "seconds": taken_s,
    }


class Defocus:
    """The picture of the requests, filtered by thin lenses."""

    def open(self, folder):
        """Read the picture and the distance of its pixels in diopters."""
        import torch

        color = np.load(Path(folder) / "color.npy").astype(np.float32)
        dpt = np.maximum(np.load(Path(folder) / "dpt.npy"), 1000.0 / FARTHEST_MM)
        self._color = torch.from_numpy(np.moveaxis(color, -1, 0)[None].copy())
        self._depth_mm = torch.from_numpy((1000.0 / dpt).astype(np.float32)[None, None])
        self._dpt_range = float(dpt.min()), float(dpt.max())
        return {}

    def frame(self, folder, mode, layers, focus_dpt, pupil_mm, pitch, size_px):
        """Filter the picture."""
        import torch
        from deeplens import DefocusLens
        from deeplens.imgsim import conv_psf_occlusion

        numbers = lens_numbers(focus_dpt, pupil_mm, pitch, size_px)
        start_s = time.perf_counter()
        with torch.no_grad():
            focus_mm = numbers.pop("focus_mm")
            lens = DefocusLens(**numbers, device="cpu")
            lens.d_far, lens.d_close = -FARTHEST_MM, -1.0
            lens.refocus(-focus_mm)
            dpt = torch.linspace(*self._dpt_range, layers)
            depths_mm = -1000.0 / dpt
            circle_mm = float(lens.coc(depths_mm).max())
            side = kernel_side_px(circle_mm, float(lens.pixel_size))
            if mode == "pillbox":
                points = torch.stack([0 * dpt, 0 * dpt, depths_mm], dim=-1)
                kernels = lens.psf(points, ks=side, psf_type="pillbox")
                kernels = kernels[:, None].repeat(1, 4, 1, 1)
                color = torch.cat([self._color, torch.ones_like(self._depth_mm)], 1)
                color = conv_psf_occlusion(color, -self._depth_mm, kernels, depths_mm)
                color = color[:, :3] / color[:, 3:].clamp(min=1e-6)
            else:
                color = lens.render_rgbd(
                    self._color, self._depth_mm, psf_ks=side, num_layers=layers
                )
            color = np.moveaxis(color[0].numpy(), 0, -1)
        taken_s = time.perf_counter() - start_s
        np.save(Path(folder) / "out.npy", color)
        return {"seconds": taken_s}


if __name__ == "__main__":
    from peer_answers import answer_requests

    defocus = Defocus()
    answer_requests(
        {
            "open": defocus.open,
            "frame": defocus.frame,
            "gradient": gradient,
        }
    )
