"""The peer optiland: a flat scene filtered with PSFs that vary over the field.

Both sides get the same surfaces, pupil and camera.  Each computes its own PSFs, so each
has a dense reference of its own, which shows what its interpolation costs, and is
compared with the other side's too, which includes how their PSFs differ.
"""

import hashlib
import json
import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.optics.media import refractive_index
from estimator.optics.surfaces import EyeSurfaces
from estimator.profiles.parse import parse_profile
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.dense_reference import CACHE
from tests.benchmarks.peer_problem import Peer, Problem
from tests.benchmarks.peer_process import PeerFrames, PeerProcess, require
from tests.benchmarks.view_sources import EyeState

SCRIPT = Path(__file__).with_name("peer_optiland_script.py")

EYE = {"kind": "published", "name": "escudero_sanz_navarro_1999"}
HALF_HEIGHT_DEG = 8.6
"""Of the image, whose left edge is then at 15 deg, where the PSF is twice as wide in
one direction as on the axis.  A multiple of the dense reference's bins, so that none of
them is outside the image."""

BASES = (((3, 3), 3), ((5, 5), 3), ((5, 5), 8), ((9, 9), 16))
"""Field points, and how many eigen-PSFs; optiland's own default is (5, 5) and 3."""


def flat_problem(view: RgbdView, **settings) -> Problem:
    """The picture of a view on a wall at infinity, and `EYE` in front of it."""
    up = math.tan(math.radians(HALF_HEIGHT_DEG))
    right = up * view.width_px / view.height_px
    flat = replace(
        view,
        depth_m=np.full_like(view.depth_m, np.inf),
        tangents=(-right, right, up, -up),
    )
    return Problem(flat, EYE, {"mode": "dynamic", **settings})


def eye_request(eye: EyeSurfaces, wavelength_nm: float) -> dict:
    """The arguments of the script's ``Eye`` for one wavelength.

    Raises
    ------
    ValueError
        The eye has a surface that is not a centered conic.
    """

    def index(medium: str) -> float:
        return float(
            refractive_index(
                medium,
                wavelength_nm=np.array(wavelength_nm),
                indices=eye.indices,
                media=eye.media,
            )
        )

    def conic(surface) -> dict:
        radius_mm = np.unique(surface.radius_mm)
        moved = (*surface.decentration_mm, *surface.tilt_deg)
        if surface.form is not None or radius_mm.size > 1 or any(moved):
            raise ValueError("only centered conics can be given to optiland here")
        return {
            "radius_mm": float(radius_mm[0]),
            "conic_constant": surface.conic_constant,
            "z_mm": surface.z_mm,
        }

    surfaces = [
        conic(surface) | {"index_after": index(surface.medium_after)}
        for surface in eye.surfaces
    ]
    return {
        "surfaces": surfaces,
        "stop_z_mm": eye.stop_z_mm,
        "retina": conic(eye.retina),
    }


def _request(problem: Problem) -> dict:
    """Return the eye and the camera for the script."""
    camera = problem.spec.camera
    eye = parse_profile(problem.profile).surfaces.relaxed
    wavelengths_nm = [float(w) for w in problem.spec.channel_wavelengths_nm]
    return {
        "eye": [eye_request(eye, w) for w in wavelengths_nm],
        "wavelengths_nm": wavelengths_nm,
        "tangents": list(camera.tangents),
        "size_px": [camera.width_px, camera.height_px],
    }


def reference(problem: Problem, state: EyeState) -> NDArray:
    """Filter the picture with optiland's PSFs of many field points, once.

    Raises
    ------
    NotInstalled
    """
    require("optiland")
    request = _request(problem)
    words = json.dumps([request, state.pupil_diameter_mm])
    digest = hashlib.sha256(words.encode() + SCRIPT.read_bytes())
    digest.update(np.ascontiguousarray(problem.color).tobytes())
    path = CACHE / f"optiland_{digest.hexdigest()[:24]}.npy"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with closing(PeerProcess(SCRIPT)) as process:
            process.write("color.npy", problem.color)
            process.ask("open", **request)
            process.ask("reference", pupil_mm=state.pupil_diameter_mm)
            np.save(path, process.read("out.npy"))
    return np.load(path)


def optiland(shape: tuple[int, int], n_components: int):
    """Open the filter with PSFs of field points, reduced to eigen-PSFs."""

    def opened(problem: Problem) -> PeerFrames:
        return PeerFrames(
            *(SCRIPT, "optiland", {"color.npy": problem.color}, _request(problem)),
            lambda state: {
                "pupil_mm": state.pupil_diameter_mm,
                "shape": shape,
                "n_components": n_components,
            },
        )

    return opened


PEERS = tuple(
    Peer(
        f"optiland {shape[1]}x{shape[0]}, {n_components}",
        "mean and eigen-PSFs of that many field points, computed anew for every "
        "pupil; one distance, no occlusion, and the edge of the image darkens. "
        "Does more: distortion, freeform surfaces, polarization, gradients (torch)",
        optiland(shape, n_components),
    )
    for shape, n_components in BASES
)
