"""Write the corpus: messages, schema, settings, profiles, a batch, an eye, output.

python -m tests.corpus.freeze [--out DIR]
"""

import argparse
import base64
import json
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from PIL import Image

from estimator.profiles.files import load_profile
from filter_service import messages
from filter_service.protocol_schema import protocol_schema
from filter_service.service.config import load_config
from tests.commands import run_command
from tests.source_tree import ROOT
from tests.unit.test_protocol_document import bodies, examples, parts_of

FOLDER = Path(__file__).parent
SERVICE_TOML = """\
bind = "tcp://127.0.0.1:5599"
credit = 3
max_sessions = 12
max_width_px = 2048
devices = ["native:1", "native:2"]
threads = 2
store_cache_dir = "eyes"
alive_interval_s = 2
give_up_after_s = 60
standby = true
max_image_mb = 1500
shared_memory = false
log_format = "json"
metrics_port = 9477
"""
ABP = "Ap = 6.0\nWa = 555\nZ[2, 0] = 3.2\nZ[3, -1] = 0.25\n"
CSV = "# pupil_diameter_mm: 6.0\n# wavelength_nm: 555\nn,m,um\n2,0,3.2\n3,-1,0.25\n"
MORE_PROFILES = (
    {"kind": "prescription", "sphere_dpt": -2, "add_dpt": 2, "higher_order": "none"},
    {
        "kind": "prescription",
        "eye_side": "OS",
        "sphere_dpt": 1.25,
        "cylinder_dpt": -0.5,
        "axis_deg": 10,
        "age_years": 60,
        "straylight": {"pigmentation": 0.5, "cataract": "nuclear"},
        "yellowing": "adapted",
        "correction": {
            "kind": "progressive",
            "sphere_dpt": 1.25,
            "add_dpt": 2,
            "vertex_mm": 12,
        },
        "spectacle_magnification": True,
    },
    {
        "kind": "prescription",
        "sphere_dpt": 0,
        "correction": {"kind": "iol", "design": "trifocal", "adds_dpt": [1.66, 3.32]}
        | {"steps_waves": [0.3, 0.4]},
    },
    {
        "kind": "prescription",
        "sphere_dpt": -3,
        "correction": {"kind": "lenslets", "sphere_dpt": -3, "vertex_mm": 12},
        "periphery": "model",
    },
    {
        "kind": "prescription",
        "sphere_dpt": -3,
        "correction": {"kind": "contact_lens", "sphere_dpt": -3, "rotation_deg": 5},
        "retina": {"radius_mm": 12, "conic_constant": 0.2},
    },
)
ON_AXIS = ("--mode", "on-axis", "--eye-model", "wavefront")
BATCH = (
    *("-p", "myopia", "--fov-deg", "20", "--workers", "1", "--settings"),
    '{"mode": "on-axis", "eye_model": "wavefront"}',
)
FRAME_COUNT = 3
KEPT_EYE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2}
KEPT_SETTINGS = {
    "tolerance": "loose",
    "pupil_range_mm": (3.0, 5.0),
    "focus_range_dpt": (0.0, 2.0),
    "object_range_dpt": (0.0, 2.0),
}
SAVED_WITHIN_S = 20.0
CAMERA = {"fov_deg": 20.0, "width_px": 64, "height_px": 48}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: records and arrays as maps and lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: plain(item) for name, item in vars(value).items()}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def shape_of(value: Any) -> Any:
    """Return the keys and types of printed JSON, of a list those of its first item."""
    if isinstance(value, Mapping):
        return {name: shape_of(item) for name, item in value.items()}
    if isinstance(value, list):
        return [shape_of(value[0])] if value else []
    if isinstance(value, bool):
        return "bool"
    return "number" if isinstance(value, int | float) else type(value).__name__


def commands(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Return a name and the arguments of each command that prints JSON."""
    color, depth, out = folder / "c.png", folder / "d.npy", folder / "out.png"
    Image.fromarray(np.full((32, 48, 3), 90, np.uint8)).save(color)
    np.save(depth, np.full((32, 48), 2.0, np.float32))
    at = ["--pupil-mm", "4", "--wavelength-nm", "555"]
    picture = ["--color", str(color), "--depth", str(depth), "--fov-deg", "20"]
    yield "estimate", ["estimate", "myopia"]
    yield "wavefront", ["wavefront", "myopia", *at, "--h-deg", "10"]
    yield "field", ["field", "myopia", *at]
    yield "psf", ["psf", "myopia", *at, "--pixel-arcmin", "1", "-o", str(out)]
    filtered = ["filter", *picture, "--profile", "myopia", "-o", str(out), *ON_AXIS]
    yield "filter", filtered
    yield "filter --plan", [*filtered, "--plan"]
    yield "report", ["report", "myopia", "-o", str(folder / "r.html"), "--no-charts"]
    yield "doctor", ["doctor"]
    keys = ["--dir", str(folder / "keys")]
    yield "keys add", ["keys", "add", "lab", *keys, "--out", str(folder / "lab.toml")]
    yield "keys list", ["keys", "list", *keys]
    yield "keys remove", ["keys", "remove", "lab", *keys]
    (folder / "eyes").mkdir()
    yield "eyes list", ["eyes", "list", "--dir", str(folder / "eyes")]


def printed_json(arguments: list[str]) -> Any:
    """Return what a command prints with ``--json``."""
    finished = run_command(*arguments, "--json")
    finished.check_returncode()
    return json.loads(finished.stdout)


def frozen_messages() -> list[dict[str, Any]]:
    """Return each message of the protocol's page: its parts and what they mean."""
    found = []
    for name, header in examples().items():
        decode = (
            messages.decode_request
            if name in messages.REQUESTS
            else messages.decode_reply
        )
        parts = [msgpack.packb(header), *parts_of(header)]
        message = decode(parts)
        found.append(
            {
                "type": name,
                "header": base64.b64encode(parts[0]).decode(),
                "part_sizes": [len(part) for part in parts[1:]],
                "fields": plain(message.fields()),
            }
        )
    return found


def frozen_profiles() -> list[dict[str, Any]]:
    """Return profiles of all kinds, and what each is read as."""
    found = []
    for body in [*bodies(), *MORE_PROFILES]:
        text = json.dumps(body)
        found.append({"name": "body.json", "text": text})
    found.append({"name": "eye.abp", "text": ABP})
    found.append({"name": "eye.csv", "text": CSV})
    with tempfile.TemporaryDirectory() as folder:
        for entry in found:
            path = Path(folder) / entry["name"]
            path.write_text(entry["text"], encoding="utf-8")
            entry["read"] = plain(load_profile(str(path)))
    return found


def write_batch(folder: Path) -> None:
    """Write a data set of three frames and a batch of it that lacks two."""
    rng = np.random.default_rng(3)
    for name in ("color", "depth"):
        (folder / "frames" / name).mkdir(parents=True)
    for number in range(FRAME_COUNT):
        color = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        depth_mm = np.full((24, 32), 800 + 700 * number, np.uint16)
        Image.fromarray(color).save(folder / f"frames/color/{number}.png")
        Image.fromarray(depth_mm).save(folder / f"frames/depth/{number}.png")
    run_batch(folder / "frames", folder / "seen")
    lines = (folder / "seen/manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "seen/manifest.jsonl").write_text("".join(lines[:2]))
    (folder / "seen/manifest.json").unlink()
    kept = json.loads(lines[1])["frame"]
    for path in (folder / "seen").rglob("*.png"):
        if path.stem != kept:
            path.unlink()


def run_batch(frames: Path, out: Path) -> str:
    """Run or resume the batch; return what it prints."""
    finished = run_command("batch", frames, *BATCH, "-o", out)
    finished.check_returncode()
    return finished.stdout


def keep_eye(folder: Path) -> list[str]:
    """Build an eye in a service that keeps it in a folder; return its notes."""
    from clients import FilterClient, ServiceProcess
    from filter_service import Camera

    folder.chmod(0o700)  # others' folders are not used
    settings = {"store_cache_dir": str(folder), "engine": "native"}
    with (
        ServiceProcess(settings, start_timeout_s=120.0) as service,
        FilterClient(service.endpoint, timeout_s=60.0) as client,
    ):
        camera = Camera.from_fov(
            CAMERA["fov_deg"],
            width_px=CAMERA["width_px"],
            height_px=CAMERA["height_px"],
        )
        ready = client.set_profile(KEPT_EYE, settings=KEPT_SETTINGS, views=[camera])
        end_s = time.monotonic() + SAVED_WITHIN_S  # it is saved in the background
        while not any(folder.iterdir()) and time.monotonic() < end_s:
            client.poll(0.1)
    return list(ready.notes)


def write_json(path: Path, content: Any) -> None:
    """Write readable JSON."""
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def freeze(folder: Path) -> None:
    """Write the whole corpus into a folder."""
    write_json(folder / "messages.json", frozen_messages())
    write_json(folder / "schema.json", protocol_schema())
    (folder / "service.toml").write_text(SERVICE_TOML, encoding="utf-8")
    settings = plain(asdict(load_config(folder / "service.toml")))
    write_json(folder / "service.json", settings)
    write_json(folder / "profiles.json", frozen_profiles())
    for name in ("batch", "eyes", "js"):
        shutil.rmtree(folder / name, ignore_errors=True)
    write_batch(folder / "batch")
    (folder / "eyes").mkdir()
    keep_eye(folder / "eyes")
    (folder / "js").mkdir()
    for name in ("filter_client.js", "check.js"):
        shutil.copy(ROOT / "clients/js" / name, folder / "js" / name)
    with tempfile.TemporaryDirectory() as scratch:
        outputs = {
            name: shape_of(printed_json(arguments))
            for name, arguments in commands(Path(scratch))
        }
    write_json(folder / "json_output.json", outputs)


def main() -> None:
    """Write the corpus."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=FOLDER, metavar="DIR")
    freeze(parser.parse_args().out)


if __name__ == "__main__":
    main()
