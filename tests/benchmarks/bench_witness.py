"""Frames compared with a path tracer through the surfaces of the same eye.

`make witness` sets up the tracer and runs this.  Mitsuba (Jakob et al. 2022; a Python
of its own, `witness_script`) sends rays from the retina through cornea and lens into a
scene, and takes the picture of a pinhole beside it, with distances and what is hidden.
That is what `EyeFilter` is given.  Error: PSNR in linear light, over all pixels; near
edges that light of both sides reaches; and over the rest, by how far from the axis it
lies.  Beside ours: the picture unfiltered, the tracer with half of its samples, the eye
seen as if all directions were the axis, and the frame without lateral color.

The tracer knows no diffraction (pupils here are 5 mm, their blur 0.14 mrad, a pixel
1.8) and no wavefront: it shares with us the eye's radii, distances and indices, the
place of the pinhole, and the size of the iris.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.field.traced_eye import TracedEye
from estimator.optics.surfaces import EyeSurfaces, media_indices
from estimator.profiles.parse import parse_profile
from filter_service.camera import Camera
from filter_service.displays import display_wavelengths_nm
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.benchmarks.bench_occlusion import Scene
from tests.benchmarks.forward_rays import ForwardEye
from tests.benchmarks.harness import OUT, ROOT, Row, Run
from tests.benchmarks.rows import row_of
from tests.numerical.synthetic import psnr_db

MINUTES = 8
SOURCES = tuple(
    Path(__file__).with_name(name) for name in ("witness_script.py", "witness_eye.py")
)
CACHE = OUT / "witness"
PYTHON = ROOT / ".witness" / "bin" / "python"
LEAST_LLVM = 16
"""Of a machine without a GPU: older ones do not compile what Dr.Jit asks for."""

VERTICAL_FOV_DEG = 36.0
PUPIL_MM = 5.0
REFERENCE_NM = 555.0
OBJECT_RANGE_DPT = (0.0, 3.0)
RINGS_DEG = (0.0, 10.0, 20.0, 40.0)
REPEATS = 5


@dataclass(frozen=True)
class Case:
    """An eye that looks at a scene of `witness_script`."""

    name: str
    scene: str
    profile: dict
    focus_dpt: float


EMMETROPE = {"kind": "prescription", "sphere_dpt": 0.0, "higher_order": "none"}
CASES = (
    Case("plane at 2 dpt, looks far", "plane", EMMETROPE, 0.0),
    Case("room, looks far", "room", EMMETROPE, 0.0),
    Case("room, keratoconus", "room", {"kind": "preset", "name": "keratoconus"}, 1.0),
)


def eye_numbers(estimated: EstimatedEye, focus_dpt: float) -> dict:
    """Return what `witness_eye.Eye` is made of: an eye that looks at a distance."""
    wavelengths_nm = display_wavelengths_nm("common")
    traced = TracedEye.trace(
        estimated,
        pupil_diameters_mm=[PUPIL_MM],
        focus_range_dpt=(focus_dpt, focus_dpt),
        wavelengths_nm=wavelengths_nm,
    )
    used_dpt = traced.accommodation_dpt(focus_dpt, pupil_diameter_mm=PUPIL_MM)
    (state,) = estimated.accommodating.states_at([used_dpt])
    surfaces = state.surfaces
    forward = ForwardEye.of(surfaces, pupil_diameter_mm=PUPIL_MM, rest_um=np.zeros(28))
    (retina_radius_mm,) = set(np.abs(np.atleast_1d(surfaces.retina.radius_mm)))
    return {
        "surfaces": [_surface_numbers(surface) for surface in surfaces.surfaces],
        "stop_z_mm": surfaces.stop_z_mm,
        "stop_radius_mm": forward.stop_radius_mm,
        "entrance_pupil_z_mm": forward.pupil_z_mm,
        "retina": {
            "radius_mm": float(retina_radius_mm),
            "conic_constant": surfaces.retina.conic_constant,
            "z_mm": surfaces.retina.z_mm,
        },
        "reference_indices": _indices(surfaces, REFERENCE_NM),
        "channel_indices": [_indices(surfaces, nm) for nm in wavelengths_nm],
    }


def _surface_numbers(surface) -> dict:
    offset_mm = surface.offset_mm
    return {
        "radius_mm": list(surface.radius_mm),
        "conic_constant": surface.conic_constant,
        "z_mm": surface.z_mm,
        "rotation_deg": surface.rotation_deg,
        "decentration_mm": list(surface.decentration_mm),
        "tilt_deg": list(surface.tilt_deg),
        "offset_mm": None if offset_mm is None else np.asarray(offset_mm).tolist(),
        "offset_radius_mm": surface.offset_radius_mm,
    }


def _indices(surfaces: EyeSurfaces, wavelength_nm: float) -> list[float]:
    return media_indices(surfaces, wavelength_nm).tolist()


def traced_picture(job: dict) -> dict[str, NDArray]:
    """Return what `witness_script` makes of a job, once made.

    Raises
    ------
    SystemExit
        The program cannot be run, or failed; says why.
    """
    text = json.dumps(job)
    sources = b"".join(source.read_bytes() for source in SOURCES)
    made_from = hashlib.sha256(sources + text.encode()).hexdigest()
    found = CACHE / f"{made_from}.npz"
    if not found.exists():
        _trace(text, found)
    with np.load(found) as arrays:
        return dict(arrays)


def _trace(job: str, found: Path) -> None:
    found.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        written, unfinished = Path(name) / "job.json", Path(name) / "found.npz"
        written.write_text(job, encoding="utf-8")
        environment = dict(os.environ)
        library = newest_llvm()
        if library is not None:
            environment.setdefault("DRJIT_LIBLLVM_PATH", str(library))
        try:
            ended = subprocess.run(
                (PYTHON, SOURCES[0], written, unfinished),
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
        except OSError as error:
            raise SystemExit(
                f"no Python with Mitsuba: {error}; `make witness` sets one up"
            ) from None
        if ended.returncode != 0:
            raise SystemExit(
                f"{PYTHON} failed ({ended.returncode}); it needs the packages mitsuba "
                f"and numpy, and LLVM {LEAST_LLVM} or newer:\n{ended.stderr[-2000:]}"
            )
        shutil.copyfile(unfinished, found)


def newest_llvm() -> Path | None:
    """Return the newest LLVM library of the system, where there is one."""
    found = {
        int(version.group(1)): path
        for path in Path("/usr/lib").glob("*/libLLVM*.so*")
        if (version := re.search(r"LLVM(?:-|\.so\.)(\d+)", path.name))
    }
    return found[max(found)] if found else None


class Witnessed:
    """A case as the tracer sees it, and regions to compare in."""

    def __init__(self, case: Case, *, width_px: int, samples: int):
        self.case = case
        estimated = estimate_eye(parse_profile(case.profile))
        parameters = estimated.parameters.to_mapping()
        # Its surfaces are then all that there is of it: no rest of a measurement.
        self.profile = parse_profile({"kind": "eye", "parameters": parameters})
        self.camera = Camera.from_fov(
            VERTICAL_FOV_DEG, width_px=width_px, height_px=width_px * 9 // 16
        )
        camera = self.camera
        self.found = traced_picture(
            {
                "scene": case.scene,
                "samples": samples,
                "camera": {
                    "width_px": camera.width_px,
                    "height_px": camera.height_px,
                    "tangents": list(camera.tangents),
                },
                "eye": eye_numbers(estimate_eye(self.profile), case.focus_dpt),
            },
        )
        self.truth = self.found["seen"]

    def view(self, *, layers: int = 2) -> RgbdView:
        """Return the pinhole's picture."""
        arrays = {
            name: self.found[name].astype(np.float32)
            for name in ("color", "depth_m", "hidden_color", "hidden_depth_m")
        }
        if layers == 1 or not (arrays["hidden_depth_m"] > 0.0).any():
            arrays["hidden_color"] = arrays["hidden_depth_m"] = None
        return RgbdView(tangents=self.camera.tangents, depth_kind="radial", **arrays)

    def regions(self) -> dict[str, NDArray[np.bool_]]:
        """Return masks (height, width) by name."""
        camera, everywhere = self.camera, np.ones(self.truth.shape[:2], bool)
        found = {"all": everywhere}
        rest = everywhere
        view = self.view()
        if view.hidden_depth_m is not None:
            scene = Scene(self.case.name, view, PUPIL_MM, self.case.focus_dpt)
            found["edges"] = scene.edge_band()
            rest = ~found["edges"]
        left, right, up, down = camera.tangents
        x = left + (right - left) * (np.arange(camera.width_px) + 0.5) / camera.width_px
        y = up + (down - up) * (np.arange(camera.height_px) + 0.5) / camera.height_px
        angle_deg = np.degrees(np.arctan(np.hypot(x, y[:, None])))
        for low, high in pairwise(RINGS_DEG):
            found[f"rest, {low:g} to {high:g} deg"] = (
                rest & (angle_deg >= low) & (angle_deg < high)
            )
        return found

    def rows(self, method: str, picture: NDArray, times_ms: list[float]) -> list[Row]:
        """Return a row for each region."""
        camera = self.camera
        return [
            row_of(
                *("witness", method, self.case.name),
                *(f"{camera.width_px}x{camera.height_px}, {name}", times_ms),
                *("psnr_db", psnr_db(picture[mask], self.truth[mask])),
                f"Mitsuba {self.found['version']}",
                n=int(mask.sum()),
            )
            for name, mask in self.regions().items()
            if mask.any()
        ]


def filtered(
    witnessed: Witnessed, *, layers: int = 2, **settings
) -> tuple[NDArray, list[float]]:
    """Return our frame, and times of frames whose state stays."""
    case = witnessed.case
    view = witnessed.view(layers=layers)
    chosen = FilterSettings(
        **{"lateral_color": True, **settings},
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
        focus_range_dpt=(case.focus_dpt, case.focus_dpt),
        object_range_dpt=OBJECT_RANGE_DPT,
    )
    times_ms = []
    with EyeFilter(witnessed.profile, view.camera, chosen) as eye_filter:
        eye_filter.wait()
        while len(times_ms) < 1 + REPEATS:
            start_s = time.perf_counter()
            seen = eye_filter.filter(
                view,
                pupil_diameter_mm=PUPIL_MM,
                focus_dpt=case.focus_dpt,
                output="linear",
            )
            times_ms.append(1e3 * (time.perf_counter() - start_s))
    return np.asarray(seen.color, dtype=np.float64), times_ms[1:]


OURS = {
    "two layers": {},
    "one layer": {"layers": 1},
    "no lateral color": {"lateral_color": False},
    "on the axis": {"mode": "on-axis", "lateral_color": False},
}


def measure(run: Run) -> list[Row]:
    """Return the rows of all cases, or of two small and noisy ones."""
    rows = []
    width_px, samples = (160, 16) if run.is_quick else (640, 256)
    for case in CASES[:2] if run.is_quick else CASES:
        print(f"{case.name}: {samples} rays a pixel and color", file=sys.stderr)
        witnessed = Witnessed(case, width_px=width_px, samples=samples)
        found = witnessed.found
        tracer_ms = 1e3 * float(found["seconds"])
        rows += witnessed.rows("unfiltered", found["color"].astype(np.float64), [])
        rows += witnessed.rows(
            "half the samples", found["seen_by_half"], [tracer_ms / 2]
        )
        for method, options in OURS.items():
            rows += witnessed.rows(method, *filtered(witnessed, **options))
    return rows
