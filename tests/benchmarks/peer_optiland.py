"""The peer optiland: a flat scene filtered with PSFs that vary over the field.

Both sides get the same surfaces, pupil and camera.  Each computes its own PSFs, so each
has a dense reference of its own, which shows what its interpolation costs, and is
compared with the other side's too, which includes how their PSFs differ.
"""

import hashlib
import json
import math
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
from tests.benchmarks.peer_process import PeerProcess, require
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


class Optiland:
    """optiland with a problem's picture, eye and camera.

    Attributes
    ----------
    own_ms : float
        Of the last frame, without the exchange of files.
    """

    def __init__(self, problem: Problem):
        require("optiland")
        camera = problem.spec.camera
        eye = parse_profile(problem.profile).surfaces.relaxed
        wavelengths_nm = [float(w) for w in problem.spec.channel_wavelengths_nm]
        self._request = {
            "eye": [eye_request(eye, w) for w in wavelengths_nm],
            "wavelengths_nm": wavelengths_nm,
            "tangents": list(camera.tangents),
            "size_px": [camera.width_px, camera.height_px],
        }
        self._color = problem.color
        self._process = PeerProcess(SCRIPT)
        self._process.write("color.npy", problem.color)
        self._process.ask("open", **self._request)
        self.own_ms = 0.0

    def frame(self, state: EyeState, shape, n_components: int) -> NDArray:
        """Filter the picture with eigen-PSFs."""
        answer = self._process.ask(
            "frame",
            pupil_mm=state.pupil_diameter_mm,
            shape=shape,
            n_components=n_components,
        )
        self.own_ms = 1e3 * answer["seconds"]
        return self._process.read("out.npy")

    def reference(self, state: EyeState) -> NDArray:
        """Filter the picture with optiland's PSFs of many field points, once."""
        words = json.dumps([self._request, state.pupil_diameter_mm])
        digest = hashlib.sha256(words.encode() + SCRIPT.read_bytes())
        digest.update(np.ascontiguousarray(self._color).tobytes())
        path = CACHE / f"optiland_{digest.hexdigest()[:24]}.npy"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._process.ask("reference", pupil_mm=state.pupil_diameter_mm)
            np.save(path, self._process.read("out.npy"))
        return np.load(path)

    def close(self) -> None:
        """End the process."""
        self._process.close()


class _EigenFrames:
    def __init__(self, optiland: Optiland, shape, n_components: int):
        self._optiland, self._basis = optiland, (shape, n_components)

    def __call__(self, state: EyeState) -> NDArray:
        return self._optiland.frame(state, *self._basis)

    @property
    def own_ms(self) -> float:
        return self._optiland.own_ms


def optiland_peers(optiland: Optiland | None) -> list[Peer]:
    """Return the rows of optiland, or rows that it is not installed."""

    def opened(shape, n_components):
        def frames(problem: Problem):
            if optiland is None:
                require("optiland")
            return _EigenFrames(optiland, shape, n_components)

        return frames

    return [
        Peer(
            f"optiland {shape[1]}x{shape[0]}, {n_components}",
            "mean and eigen-PSFs of that many field points, computed anew for every "
            "pupil; one distance, no occlusion, and the edge of the image darkens. "
            "Does more: distortion, freeform surfaces, polarization, gradients (torch)",
            opened(shape, n_components),
        )
        for shape, n_components in BASES
    ]
