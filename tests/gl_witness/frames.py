"""The frames of both scenes that every driver filters."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from estimator.profiles.parse import parse_profile
from filter_service.planning.grid import GridSpec
from filter_service.psfs.store import PsfStore, build_psf_store
from filter_service.rgbd_view import RgbdView
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import SCENES, scene_view

PUPIL_MM, FOCUS_DPT = 5.0, 0.5

TIMES = 3
"""Times a frame is filtered: kernels made anew, kept, and kept once more."""


@dataclass(frozen=True)
class Case:
    """A frame: scene, eye, and what the client asks for."""

    scene: str
    eye: str
    mode: str = "on-axis"
    dtype: str = "uint8"
    with_hidden: bool = False
    options: dict = field(default_factory=dict)

    def __str__(self):
        told = [self.scene, self.eye]
        told += [self.mode] * (self.mode != "on-axis")
        told += [self.dtype] * (self.dtype != "uint8")
        told += ["hidden layer"] * self.with_hidden
        told += [str(value) for value in self.options.values() if value is not False]
        told += ["unmerged"] * (not self.options.get("merge", True))
        return ", ".join(told)

    def view(self, views: dict[str, RgbdView]) -> RgbdView:
        """The frame, of the views of all scenes."""
        view = views[self.scene]
        if not self.with_hidden:
            view = replace(view, hidden_color=None, hidden_depth_m=None)
        if self.dtype == "uint8":
            return view
        light = (view.color / np.float32(255)) ** np.float32(2.2)
        return replace(view, color=light.astype(self.dtype))


PAPER = {"accumulation": "paper"}
CASES = (
    *(Case(s, e) for s in SCENES for e in ("emmetropia", "myopia", "keratoconus")),
    *(Case(scene, "myopia", options=PAPER) for scene in SCENES),
    Case("courtyard", "keratoconus", options={**PAPER, "merge": False}),
    Case("courtyard", "keratoconus", options={"merge": False}),
    Case("courtyard", "astigmatism", mode="dynamic"),
    Case("courtyard", "emmetropia", with_hidden=True),
    Case("primitives", "keratoconus", with_hidden=True, mode="dynamic"),
    Case("primitives", "cataract", dtype="float32"),
    Case("primitives", "astigmatism", dtype="float16", options={"output": "linear16"}),
    Case("courtyard", "myopia", options={"output": "srgb8"}),
)


def save_views(path: Path, *, width_px: int, height_px: int) -> None:
    """Draw both scenes into a file: drivers are not to see different ones."""
    arrays = {}
    for name in SCENES:
        size = {"width_px": width_px, "height_px": height_px}
        view = scene_view(name, **size, with_hidden=True)
        for part in ("color", "depth_m", "hidden_color", "hidden_depth_m", "tangents"):
            arrays[f"{name} {part}"] = np.asarray(getattr(view, part))
    np.savez(path, **arrays)


def load_views(path: Path) -> dict[str, RgbdView]:
    """Views that `save_views` wrote, by scene."""
    with np.load(path) as data:
        parts = {name: {} for name in SCENES}
        for key in data.files:
            name, part = key.split()
            parts[name][part] = data[key]
    return {
        name: RgbdView(**{**part, "tangents": tuple(part["tangents"].tolist())})
        for name, part in parts.items()
    }


def store_of(case: Case, view: RgbdView) -> PsfStore:
    """PSFs of a case's eye."""
    return build_psf_store(
        parse_profile({"kind": "preset", "name": case.eye}), _spec(case, view)
    )


def _spec(case: Case, view: RgbdView) -> GridSpec:
    return grid_spec(
        width_px=view.width_px,
        height_px=view.height_px,
        tangents=view.tangents,
        mode=case.mode,
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
        focus_range_dpt=(FOCUS_DPT, FOCUS_DPT),
    )
