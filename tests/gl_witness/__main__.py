"""Two implementations of OpenGL, and the layers of Vulkan, as the renderer's witnesses.

    make gl-witness
    python -m tests.gl_witness [tests] [frames] [layers]

tests: all that draw with OpenGL, on llvmpipe and on zink over lavapipe, with the
variants of the passes for software and those for a GPU.  frames: the same frames
by each, beside the native engine's and each other's.  layers: what Vulkan's
validation layers say of them.  Each part has its place in out/gl_witness.json.
It fails where a test does, or the layers find a fault.
"""

import argparse
import json
import shutil
import sys

from tests.benchmarks.harness import RESULTS, report, write_report, written_path
from tests.gl_witness.drivers import DRIVERS, FETCHED, renderer_info
from tests.gl_witness.outcomes import run_all_tests, say
from tests.gl_witness.tables import compare_frames, watch_layers

NAME = "gl_witness"

PARTS = {"tests": run_all_tests, "frames": compare_frames, "layers": watch_layers}

CANNOT = 77


def main(arguments: list[str] | None = None) -> int:
    """Run the parts, print their tables, and write each to the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []])
    parts = parser.parse_args(arguments).parts or PARTS
    if not (FETCHED / ".made").is_file():
        say("gl-witness: no drivers; sh tests/gl_witness/setup.sh drivers")
        return CANNOT
    if "layers" in parts and shutil.which("cc") is None:
        say("gl-witness: the layers are proved by a layer of ours: no C compiler")
        return CANNOT
    drivers = {str(driver): renderer_info(driver) for driver in DRIVERS}
    for name, info in drivers.items():
        say(f"{name:<28} {info['renderer']}, {info['version']}")
    failed = False
    for part in parts:
        rows = PARTS[part]()
        keep(part, rows, drivers)
        failed |= any(row.get("failed") or row.get("messages") for row in rows)
    return 1 if failed else 0


def keep(part: str, rows: list[dict], drivers: dict) -> None:
    """Write a part of the results, beside those that there are of the others."""
    files = (written_path(f"{NAME}.json"), RESULTS / f"{NAME}.json")
    text = next((f.read_text(encoding="utf-8") for f in files if f.is_file()), "{}")
    content = json.loads(text)
    head = {key: value for key, value in report([]).items() if key != "rows"}
    write_report(NAME, {**content, part: {**head, "drivers": drivers, "rows": rows}})


if __name__ == "__main__":
    sys.exit(main())
