"""Round trips by `ocufilter latency`, by `bench roundtrip` and by a client of its own.

    ocufilter bench latency --program /opt/ocufilter/bin/ocufilter

Each measures the same stream through one service in another process, in turn.  The
third client (`latency_protocol_client.py`) is written from PROTOCOL.md alone.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from clients.latency.stream import StreamSettings, make_frames
from clients.service_process import ServiceProcess
from filter_service.keys import KeyRing
from tests.benchmarks.bench_roundtrip import DEFAULT_PROFILE
from tests.benchmarks.harness import ROOT, report, write_report

SIZE_PX, RATE_HZ = (640, 360), 10.0
SIZE = "{}x{}".format(*SIZE_PX)
METHODS = ("ocufilter latency", "bench roundtrip", "client of PROTOCOL.md")
LIMIT_S = 300.0


def output_of(*words, cwd) -> str:
    finished = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    if finished.returncode:
        sys.exit(finished.stderr.strip())
    return finished.stdout


def write_frames(path: Path) -> None:
    """Write the images of the stream for a client without our code."""
    profile = json.loads(DEFAULT_PROFILE)
    settings = StreamSettings(
        *SIZE_PX, 1, RATE_HZ, 1.0, profile, {}, 4.0, 0.0, "srgb8", 1
    )
    views = [frame[0] for frame in make_frames(settings)]
    np.savez(
        path,
        color=np.stack([view.color for view in views]),
        depth_m=np.stack([view.depth_m for view in views]),
        tangents=views[0].camera.tangents,
    )


class Clients:
    """The three ways of timing a stream, each as a process."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.options, self.folder = options, folder
        self.frames_file = folder / "frames.npz"
        write_frames(self.frames_file)

    def round_trip_ms(self, method: str, endpoint: str, key: Path | None) -> float:
        """Return the median of one stream."""
        n_frames = self.options.frames
        key_option = [] if key is None else ["--key", key]
        if method == "ocufilter latency":
            told = output_of(
                *(self.options.program or (sys.executable, "-m", "ocufilter")),
                *("latency", endpoint, "--still", "--transport", "tcp", "--json"),
                *("--size", SIZE, "--rate-hz", RATE_HZ, "--frames", n_frames),
                *key_option,
                cwd=self.folder if self.options.program else ROOT,
            )
            return json.loads(told)["rows"][0]["round_trip_ms"]["p50"]
        if method == "bench roundtrip":
            told = output_of(
                *(sys.executable, "-m", "tests.benchmarks.bench_roundtrip"),
                *("--endpoint", endpoint, "--size", SIZE, "--rate-hz", RATE_HZ),
                *("--seconds", n_frames / RATE_HZ, "--json", *key_option),
                cwd=self.options.checkout,
            )
            rows = {row["method"]: row for row in json.loads(told)["rows"]}
            return rows["round_trip_ms"]["median_ms"]
        script = Path(__file__).with_name("latency_protocol_client.py")
        words = (endpoint, self.frames_file, RATE_HZ, n_frames, DEFAULT_PROFILE)
        keys = [] if key is None else [key]
        times = output_of(sys.executable, script, *words, *keys, cwd=self.folder)
        return float(np.median(json.loads(times)))


def compare(clients: Clients, *, transport: str, rounds: int) -> list[dict]:
    """Return a row for each client."""
    settings, key = {}, None
    if transport == "CURVE":
        ring, key = KeyRing(clients.folder / "keys"), clients.folder / "key.toml"
        ring.add("benchmark", key)
        settings = {"keys_dir": str(ring.folder)}
    found: dict[str, list[float]] = {method: [] for method in METHODS}
    with ServiceProcess(settings) as service:
        for number in range(rounds):
            turn = number % len(METHODS)
            for method in METHODS[turn:] + METHODS[:turn]:
                ms = clients.round_trip_ms(method, service.endpoint, key)
                found[method].append(round(ms, 3))
                sys.stderr.write(f"{transport}, {method}: {ms:.2f} ms\n")
    base_ms = np.median(found["bench roundtrip"])
    return [
        {
            "bench": "latency",
            "method": method,
            "case": f"{SIZE}, {RATE_HZ:g} Hz",
            "setting": transport,
            "n": rounds * clients.options.frames,
            "median_ms": float(np.median(medians_ms)),
            "round_medians_ms": medians_ms,
            "error_name": "relative_difference_to_bench_roundtrip",
            "error": float(np.median(medians_ms) / base_ms - 1),
            "reference": "bench roundtrip, in turn",
        }
        for method, medians_ms in found.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="ocufilter bench latency", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--program", nargs=1, help="another `ocufilter`, of a wheel")
    parser.add_argument(
        "--checkout", type=Path, default=ROOT, help="of `bench roundtrip`"
    )
    parser.add_argument("--frames", type=int, default=100, help="of each stream")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="20 frames, one round")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    is_whole = not options.quick
    if options.quick:
        options.frames, options.rounds = 20, 1
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        clients = Clients(options, Path(folder))
        for transport in ("tcp", "CURVE"):
            rows += compare(clients, transport=transport, rounds=options.rounds)
    content = report(rows=[]) | {"rows": rows}
    if is_whole:
        write_report("latency", content)
    if options.json:
        print(json.dumps(content))
        return
    for row in rows:
        print(
            f"{row['setting']:<6} {row['method']:<22} {row['median_ms']:8.2f} ms "
            f"{100 * row['error']:+6.1f} %  of {row['round_medians_ms']}"
        )


if __name__ == "__main__":
    main()
