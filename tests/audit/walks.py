"""Count the files and functions that a frame, a profile and a photograph pass.

    .venv/bin/python -m tests.audit.walks

`sys.setprofile` records every Python function of the project that is called, in every
process, between the request and its result: a frame in another state to a running
service, a new profile until its first frame, and `ocufilter filter` with a photograph.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
RECORDER = Path(__file__).with_name("recorder")
SIZE_PX = (64, 48)


class Recorder:
    """Records calls in this process's children, and in itself if it was restarted."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number = folder, 0

    @contextmanager
    def recorded(self) -> Iterator[dict[str, set[str]]]:
        """Record during the context; the functions by file are complete after it."""
        found: dict[str, set[str]] = {}
        for file in self._folder.glob("*.calls"):
            file.unlink()
        with (self._folder / "flag").open("r+b", buffering=0) as flag:
            self._number += 1
            flag.write(bytes([self._number]))
            yield found
            flag.seek(0)
            flag.write(b"\0")
        for file in self._folder.glob("*.calls"):
            for line in file.read_text().splitlines():
                name, function = line.split("\t")
                found.setdefault(name, set()).add(function)


def walk_service(recorder: Recorder) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Return the functions of a frame, and of a profile, over ZeroMQ."""
    from clients.filter_client import FilterClient
    from clients.service_process import ServiceProcess
    from filter_service import Camera, RgbdView

    camera = Camera.from_fov(40.0, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    rng = np.random.default_rng(5)
    color = rng.integers(0, 256, (*SIZE_PX[::-1], 3)).astype(np.uint8)
    depth_m = np.full(SIZE_PX[::-1], 2.0, np.float32)
    depth_m[:, :20] = 0.4
    view = RgbdView(color, depth_m, camera.tangents)
    with (
        ServiceProcess({"engine": "native"}) as service,
        FilterClient(service.endpoint, timeout_s=120.0) as client,
    ):
        with recorder.recorded() as profile:
            client.set_profile("myopia", views=[camera])
        client.filter(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
        with recorder.recorded() as frame:
            client.filter(view, pupil_diameter_mm=3.7, focus_dpt=0.4)
    return frame, profile


def walk_photograph(recorder: Recorder, folder: Path) -> dict[str, set[str]]:
    """Return the functions of one photograph on the command line."""
    rng = np.random.default_rng(6)
    color = rng.integers(0, 256, (*SIZE_PX[::-1], 3)).astype(np.uint8)
    Image.fromarray(color).save(folder / "color.png")
    np.save(folder / "depth.npy", np.full(SIZE_PX[::-1], 1.5, np.float32))
    with recorder.recorded() as found:
        subprocess.run(
            [
                *(sys.executable, "-m", "ocufilter", "filter"),
                *("--color", folder / "color.png", "--depth", folder / "depth.npy"),
                *("--fov-deg", "40", "--profile", "myopia", "--pupil-mm", "4"),
                *("--engine", "native", "-o", folder / "seen.png"),
            ],
            check=True,
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
        )
    return found


def main() -> None:
    """Print the counts; with ``--list``, each file and its functions."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--list", action="store_true", help="print files and functions")
    parser.add_argument("--json", action="store_true", help="print one object")
    arguments = parser.parse_args()
    if "OCUFILTER_WALK_FOLDER" not in os.environ:
        with tempfile.TemporaryDirectory() as name:
            (Path(name) / "flag").write_bytes(b"\0")
            path = os.pathsep.join((str(RECORDER), str(ROOT)))
            environment = os.environ | {
                "OCUFILTER_WALK_FOLDER": name,
                "OCUFILTER_WALK_ROOT": str(ROOT),
                "PYTHONPATH": path,
            }
            command = [sys.executable, "-m", "tests.audit.walks", *sys.argv[1:]]
            sys.exit(subprocess.run(command, cwd=ROOT, env=environment).returncode)
    folder = Path(os.environ["OCUFILTER_WALK_FOLDER"])
    recorder = Recorder(folder)
    frame, profile = walk_service(recorder)
    walks = {
        "frame": frame,
        "profile": profile,
        "photograph": walk_photograph(recorder, folder),
    }
    counts = {
        name: {"files": len(found), "functions": sum(map(len, found.values()))}
        for name, found in walks.items()
    }
    if arguments.json:
        print(json.dumps(counts))
        return
    print("| walk | files | functions |\n|---|---|---|")
    for name, count in counts.items():
        print(f"| {name} | {count['files']} | {count['functions']} |")
    if arguments.list:
        for name, found in walks.items():
            print(f"\n## {name}")
            for file, functions in sorted(found.items()):
                print(f"{file}: {', '.join(sorted(functions))}")


if __name__ == "__main__":
    main()
