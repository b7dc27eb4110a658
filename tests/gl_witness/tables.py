"""Tables of a run: how far drivers lie apart, and what the layers of Vulkan say."""

import tempfile
import time
from dataclasses import asdict
from itertools import combinations
from pathlib import Path

from tests.gl_witness.compare import differences, summary
from tests.gl_witness.drivers import DRIVERS, SHADERS
from tests.gl_witness.filter_frames import Filtered
from tests.gl_witness.frames import save_views
from tests.gl_witness.layers import WATCHES, prove, watched
from tests.gl_witness.outcomes import say
from tests.gl_witness.processes import check_variants, filter_all, filter_command

WATCHED_SIZE = {"width_px": 96, "height_px": 64}
"""As small as lets every pass run: under the GPU-assisted layer they take minutes."""


def compare_frames() -> list[dict]:
    """Each two of the native engine and the drivers."""
    with tempfile.TemporaryDirectory() as folder:
        found = filter_all(Path(folder))
    rows = []
    for here, there in combinations(found, 2):
        each = differences(found[there], found[here])
        row = {"here": here, "there": there, "frames": summary(each)}
        row["repeats_differ"] = found[there].repeats_differ
        row["texture_steps"] = found[there].texture_steps
        row["failed"] = any(steps > 1 for steps in row["texture_steps"].values())
        row["each"] = [asdict(one) for one in each if not one.is_none]
        rows.append(row)
        told = row["frames"]
        say(
            f"{here + ' : ' + there:<58} {told['byte for byte']:>2} of "
            f"{told['compared']:>2} equal, least {told['least_psnr_db']:.1f} dB, "
            f"largest difference {told['largest']:.1e}"
        )
    for driver in map(str, DRIVERS):
        steps = found[driver].texture_steps.values()
        say(
            f"{driver}: {len(steps)} frames in textures, at most {max(steps)} of 255 "
            "steps from those of arrays"
        )
    return rows


def watch_layers() -> list[dict]:
    """What the layers say, of a deliberate fault and of our frames."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        views, out = Path(folder) / "views.npz", Path(folder) / "out.npz"
        frames = filter_command("gl", views, out)[2:]
        save_views(views, **WATCHED_SIZE)
        for watch in WATCHES:
            proof = prove(watch, frames)
            say(f"{watch}, deliberate fault: {proof.counts}")
            for shaders in SHADERS:
                started_s = time.monotonic()
                said = watched(watch, shaders, frames)
                check_variants(shaders, Filtered.load(out))
                rows.append(
                    {
                        "watch": watch,
                        "shaders": shaders,
                        "messages": said.counts,
                        "messages_of_zink": said.of_zink,
                        "examples": said.examples,
                        "of_a_deliberate_fault": proof.counts,
                        "enabled": said.enabled,
                        "seconds": round(time.monotonic() - started_s),
                    }
                )
                say(
                    f"{watch}, {shaders} shaders: {said.counts or 'no message'}, "
                    f"{said.of_zink} of zink's own, {rows[-1]['seconds']} s"
                )
    return rows
