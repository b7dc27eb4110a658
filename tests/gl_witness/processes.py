"""Processes that filter the frames: one for each engine and driver."""

import os
import subprocess
import sys
from pathlib import Path

from tests.gl_witness.drivers import DRIVERS, environment
from tests.gl_witness.filter_frames import Filtered
from tests.gl_witness.frames import save_views
from tests.shader_variants import KINDS, renderer_variants, texture_variants
from tests.source_tree import ROOT

SIZE = {"width_px": 320, "height_px": 180}


def filter_all(folder: Path) -> dict[str, Filtered]:
    """Frames by the native engine and by each driver."""
    views = folder / "views.npz"
    save_views(views, **SIZE)
    runs = {"native": ("native", dict(os.environ))}
    runs |= {str(driver): ("gl", environment(driver)) for driver in DRIVERS}
    found = {}
    for name, (engine, variables) in runs.items():
        out = folder / "out.npz"
        subprocess.run(filter_command(engine, views, out), env=variables, check=True)
        found[name] = Filtered.load(out)
    for driver in DRIVERS:
        check_variants(driver.shaders, found[str(driver)])
    return found


def filter_command(engine: str, views: Path, out: Path) -> tuple[str, ...]:
    """Command that filters all frames in a process of its own."""
    module = "tests.gl_witness.filter_frames"
    return sys.executable, "-m", module, engine, str(views), str(out)


def check_variants(shaders: str, filtered: Filtered) -> None:
    """Make sure that every pass and every variant for such a driver took part.

    Raises
    ------
    RuntimeError
        One did not.
    """
    variants = renderer_variants(KINDS[shaders]) | texture_variants()
    wanted = {str(variant) for variant in variants if variant.stage == "comp"}
    passes = {path.name.split(".")[0] for path in (ROOT / "shaders/passes").iterdir()}
    ran = {name.split("(")[0] for name in filtered.programs}
    missing = (wanted - set(filtered.programs)) | (passes - ran)
    if missing:
        raise RuntimeError(f"no frame runs {', '.join(sorted(missing))}")
