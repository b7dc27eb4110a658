"""Filters all frames in this process, into a file.

    python -m tests.gl_witness.filter_frames ENGINE VIEWS OUT

ENGINE is native or gl; the driver of OpenGL is what the environment says, and with
GL_WITNESS_SHADERS=hardware its variants of the passes are those of a GPU.  VIEWS is of
`frames.save_views`, OUT of `Filtered.save`.
"""

import hashlib
import json
import os
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from tests.gl_witness.frames import (
    CASES,
    FOCUS_DPT,
    PUPIL_MM,
    TIMES,
    Case,
    load_views,
    store_of,
)
from tests.gl_witness.texture_frames import filter_arrays, filter_textures
from tests.shader_variants import Variant

COUNTS = ("fragment_count", "merged_count", "entry_count", "kernel_count")
KEY_OF_NOTES = "notes"


@dataclass
class Filtered:
    """What a process has filtered.

    Attributes
    ----------
    counts : dict
        Fragments, pixels merged and so on, by frame.
    repeats_differ : list of str
        Frames that, filtered once more, have other bytes or counts.
    texture_steps : dict
        Largest difference of frames in textures from those of arrays, in steps of
        8 bits.
    stores : dict
        Fingerprints of the eyes' PSFs: engines are compared on the same ones.
    programs : list of str
        Variants of passes that were compiled.
    arrays : dict
        Pictures by name.
    """

    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    repeats_differ: list[str] = field(default_factory=list)
    texture_steps: dict[str, int] = field(default_factory=dict)
    stores: dict[str, str] = field(default_factory=dict)
    programs: list[str] = field(default_factory=list)
    arrays: dict[str, NDArray] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write a file that `load` reads."""
        notes = json.dumps({**asdict(self), "arrays": None})
        np.savez(path, **self.arrays, **{KEY_OF_NOTES: np.array(notes)})

    @classmethod
    def load(cls, path: Path) -> "Filtered":
        """Read a file of `save`."""
        with np.load(path) as data:
            notes = json.loads(str(data[KEY_OF_NOTES]))
            arrays = {name: data[name] for name in data.files if name != KEY_OF_NOTES}
        return cls(**{**notes, "arrays": arrays})


def filter_cases(renderer, views: dict[str, RgbdView], into: Filtered) -> None:
    """Filter every frame, each several times over."""
    for case in CASES:
        name, view = str(case), case.view(views)
        store = store_of(case, view)
        into.stores[name] = hashlib.sha256(store.kernels.tobytes()).hexdigest()
        handle = renderer.load(store)
        first, *others = [_filtered(renderer, view, handle, case) for _ in range(TIMES)]
        into.arrays[name], into.counts[name] = first
        if any(p.tobytes() != first[0].tobytes() or n != first[1] for p, n in others):
            into.repeats_differ.append(name)
        handle.release()


def _filtered(renderer, view, handle, case: Case) -> tuple[NDArray, dict[str, int]]:
    frame = renderer.render(
        view,
        handle,
        pupil_diameter_mm=PUPIL_MM,
        focus_dpt=FOCUS_DPT,
        **case.options,
    )
    return frame.color, {name: int(getattr(frame, name)) for name in COUNTS}


def filter_with_gl(views: dict[str, RgbdView]) -> Filtered:
    """All frames by the driver that the environment says."""
    from filter_service.gl.gpu import Gpu
    from filter_service.rendering.gl import FilterRenderer
    from tests.gl_witness.hardware_shaders import use_hardware_shaders

    if os.environ.get("GL_WITNESS_SHADERS") == "hardware":
        use_hardware_shaders()
    filtered, gpu = Filtered(), Gpu()
    filter_cases(FilterRenderer(gpu), views, filtered)
    with gpu.entered():  # one context: `between.c` knows one device a process
        pictures, filtered.texture_steps, programs = filter_textures(views)
    filtered.arrays |= pictures
    programs |= set(gpu.passes.programs)
    filtered.programs = sorted(
        str(Variant(name, tuple(defines))) for name, *defines in programs
    )
    return filtered


def filter_with_native(views: dict[str, RgbdView]) -> Filtered:
    """All frames by the native engine."""
    filtered = Filtered()
    filter_cases(NativeRenderer(), views, filtered)
    filtered.arrays |= filter_arrays(views, "native")
    return filtered


if __name__ == "__main__":
    engine, views_path, out = sys.argv[1:]
    by = {"native": filter_with_native, "gl": filter_with_gl}[engine]
    by(load_views(Path(views_path))).save(Path(out))
