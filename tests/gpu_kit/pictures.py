"""Pictures of the courtyard through three eyes, by the engine gl.

    python -m tests.gpu_kit.pictures FOLDER [--size WxH]

Prints one JSON object: their differences from the native engine's, where that is there.
"""

import argparse
import json
from pathlib import Path

from PIL import Image

from estimator.profiles.parse import parse_profile
from filter_service.gl.gpu import Gpu
from filter_service.native.library import library_path
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.bench_gpu import EYES, FOCUS_DPT, PUPIL_MM
from tests.benchmarks.harness import commit_id
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db

STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT}


def draw(renderer, view, body: dict, file: Path) -> dict:
    """Filter a view through an eye into a file; its row."""
    spec = grid_spec(
        width_px=view.width_px,
        height_px=view.height_px,
        tangents=view.tangents,
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
        focus_range_dpt=(FOCUS_DPT, FOCUS_DPT),
        mode="dynamic",
    )
    store = build_psf_store(parse_profile(body), spec)
    handle = renderer.load(store)
    Image.fromarray(renderer.render(view, handle, output="srgb8", **STATE).color).save(
        file
    )
    row = {"method": "picture", "file": file.name, "psnr_db": None}
    if library_path() is not None:
        linear = renderer.render(view, handle, **STATE).color
        native = NativeRenderer()
        expected = native.render(view, native.load(store), **STATE).color
        native.close()
        row["psnr_db"] = psnr_db(linear, expected)
    handle.release()
    return row


def main() -> None:
    """Write the pictures, print their rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", default="1280x720", help="of the frames, px")
    arguments = parser.parse_args()
    width_px, height_px = (int(part) for part in arguments.size.split("x"))
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view.color).save(arguments.folder / "courtyard.png")
    renderer = FilterRenderer(Gpu())
    rows = []
    for eye, body in EYES.items():
        file = arguments.folder / f"courtyard_{eye.replace(' ', '_')}.png"
        rows.append({"case": eye} | draw(renderer, view, body, file))
    print(json.dumps({"commit": commit_id(), "rows": rows}))


if __name__ == "__main__":
    main()
