"""One eye per image, as for training networks: processor time beside error.

An image of 256x256 px and 20 deg at 2 m, through another drawn person, with another
pupil and focus, for each image; one thread.  Times are those of all processes, for an
image: the filter alone, without reading or writing files.

- ``same eye``: one eye and state for all images.
- ``worker``: a new eye for each image, estimated by the worker process.
- ``no worker``: the same in the calling thread.
- ``one state``: the same, with ranges of pupil and focus that are the image's state.
- ``bank, cold`` and ``bank, warm``: eyes of a bank, whose files are first read from the
  disk, and then in memory.

Errors are the largest difference from the images of ``worker``, in steps of 8 bits, and
for ``worker`` and ``one state`` the PSNR of the worst of some images against exact PSFs
(``render_tolerance=0``).

``batch`` is `ocufilter batch --sample-eyes` with two processes: crops of photographs
from JPEG files to PNG files with labels, an eye of 40 persons for each.  Its time is
wall time for an image, with the start of the processes, beside processor time without
it and the load of the machine before and after.  Its error is the PSNR of the
worst of some images against ``--render-tolerance 0``.

`albumentations` and `kornia` blur the same image with a Gaussian if they are installed:
one blur for all pixels and colors, of no eye.

Last, four processes filter as the workers of a data loader do, with the defaults of
threads and builders: see `loader_workers`.  "none" returns the picture as it is, and is
what the workers take without a filter.
"""

from filter_service import one_blas_thread  # noqa: F401, I001  (before any numpy)

import importlib.util
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from estimator.threads import THREADS_VARIABLE
from filter_service import Camera, EyeBank, EyeFilter, FilterSettings
from tests.benchmarks.harness import Row, Run, memory_mb, time_calls
from tests.loader_workers import SeenPictures, digest, measured
from tests.numerical.scene_frames import scene_view

MINUTES = 6
SIDE_PX, FOV_DEG, DISTANCE_M = 256, 20.0, 2.0
PUPILS_MM, FOCI_DPT = (2.5, 5.5), (0.0, 1.0)
MODES = ("dynamic", "on-axis")
COUNT, QUICK_COUNT = 24, 3
BANK_COUNT, QUICK_BANK_COUNT = 200, 3
EXACT_COUNT, QUICK_EXACT_COUNT = 4, 1
BATCH_COUNT, QUICK_BATCH_COUNT = 1000, 6
BATCH_PEOPLE = 40
PICTURES = (
    *("astronaut.png", "coffee.png", "chelsea.png", "rocket.jpg"),
    *("motorcycle_left.png", "hubble_deep_field.jpg", "retina.jpg", "ihc.png"),
)
"""Photographs of scikit-image, which its package contains."""

N_WORKERS, QUICK_N_WORKERS = 4, 1
CLOCK_HZ = os.sysconf("SC_CLK_TCK")


def _stat(folder: Path) -> list[str]:
    """Return the fields of a process after its name."""
    return (folder / "stat").read_text().rsplit(")", 1)[1].split()


def children() -> list[Path]:
    """Return the folders in /proc of the processes that this one started."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            if int(_stat(folder)[1]) == os.getpid():
                found.append(folder)
    return found


def processor_s(others: list[Path]) -> float:
    """Return the processor time of this process and of others."""
    ticks = sum(int(own) for folder in others for own in _stat(folder)[11:13])
    return ticks / CLOCK_HZ + time.process_time()


def people(count: int) -> list[dict[str, Any]]:
    """Return drawn persons of random refraction and age."""
    rng = np.random.default_rng(7)
    return [
        {
            "kind": "prescription",
            "sphere_dpt": round(float(rng.normal(-1.0, 1.5)), 2),
            "cylinder_dpt": -round(float(rng.gamma(1.2, 0.4)), 2),
            "axis_deg": round(float(rng.uniform(1.0, 180.0))),
            "age_years": round(float(rng.uniform(20.0, 60.0))),
            "sample": number,
        }
        for number in range(count)
    ]


def states(count: int) -> list[dict[str, float]]:
    """Return random pupils and foci."""
    rng = np.random.default_rng(8)
    return [
        {
            "pupil_diameter_mm": round(float(rng.uniform(*PUPILS_MM)), 2),
            "focus_dpt": round(float(rng.uniform(*FOCI_DPT)), 2),
        }
        for _ in range(count)
    ]


def one_state(settings: FilterSettings, state: dict[str, float]) -> FilterSettings:
    """Return settings whose ranges of pupil and focus are one state."""
    pupil_mm, focus_dpt = state.values()
    return settings.changed(
        pupil_range_mm=(pupil_mm, pupil_mm), focus_range_dpt=(focus_dpt, focus_dpt)
    )


class Runs:
    """Images through many eyes, in several ways."""

    def __init__(self, mode: str, camera: Camera) -> None:
        self.mode, self.camera = mode, camera
        self.settings = FilterSettings(
            mode=mode,
            pupil_range_mm=PUPILS_MM,
            focus_range_dpt=FOCI_DPT,
            object_planes_dpt=(1.0 / DISTANCE_M,),
        )
        view = scene_view("courtyard", width_px=SIDE_PX, height_px=SIDE_PX)
        self.frame = view.color, np.full((SIDE_PX, SIDE_PX), DISTANCE_M, np.float32)
        self.rows: list[Row] = []

    def images(
        self,
        profiles: list[Any],
        *,
        worker: bool = False,
        is_one_state: bool = False,
        **options: Any,
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Return images and their processor times, ms, after one that is not timed."""
        found, times_ms = [], []
        with EyeFilter(
            camera=self.camera, engine="native", worker=worker
        ) as eye_filter:
            others = children()
            every = [profiles[-1], *profiles]
            for profile, state in zip(
                every, [states(1)[0], *states(len(profiles))], strict=True
            ):
                start_s = processor_s(others)
                settings = self.settings
                if is_one_state:
                    settings = one_state(settings, state)
                eye_filter.set_profile(profile, settings=settings)
                seen = eye_filter.filter(*self.frame, **state, whole=True, **options)
                found.append(seen.color)
                times_ms.append(1e3 * (processor_s(others) - start_s))
        return found[1:], np.array(times_ms[1:])

    def same_eye(self, count: int) -> np.ndarray:
        """Return the processor times, ms, of one eye and state."""
        times_ms = []
        with EyeFilter(
            people(1)[0], self.camera, self.settings, engine="native"
        ) as eye_filter:
            for _ in range(count + 2):
                start_s = time.process_time()
                eye_filter.filter(*self.frame, **states(1)[0])
                times_ms.append(1e3 * (time.process_time() - start_s))
        return np.array(times_ms[2:])

    def add(
        self, method: str, times_ms: np.ndarray, name: str, error: float, to: str
    ) -> None:
        """Add a row; its time is the mean, because eyes differ."""
        self.rows.append(
            Row(
                *("ml", method, self.mode, f"{SIDE_PX}x{SIDE_PX}", times_ms.size),
                *(float(times_ms.mean()), float(np.percentile(times_ms, 95))),
                *(memory_mb(), name, float(error), to),
            )
        )


def difference(first: list[np.ndarray], second: list[np.ndarray]) -> int:
    """Return the largest difference of images, steps of 8 bits."""
    return max(
        int(np.abs(a.astype(int) - b).max()) for a, b in zip(first, second, strict=True)
    )


def worst_db(images: list[np.ndarray], exact: list[np.ndarray]) -> float:
    """Return the lowest PSNR of images, dB."""
    errors = [
        np.square((a.astype(float) - b) / 255.0).mean()
        for a, b in zip(images, exact, strict=False)
    ]
    return float(-10.0 * np.log10(max(*errors, 1e-12)))


def drop_from_memory(folder: Path) -> None:
    """Make the system forget the content of files, which it then reads again."""
    for path in folder.iterdir():
        descriptor = os.open(path, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


def run_mode(
    mode: str, counts: tuple[int, int, int], folder: Path, details: list[dict]
) -> list[Row]:
    """Measure all ways of one mode."""
    count, bank_count, exact_count = counts
    runs = Runs(mode, Camera.from_fov(FOV_DEG, width_px=SIDE_PX, height_px=SIDE_PX))
    eyes = people(bank_count)
    some = eyes[:count]
    step = "difference, steps"
    runs.add("same eye", runs.same_eye(count), step, 0.0, "itself")
    exact, _ = runs.images(some[:exact_count], is_one_state=True, render_tolerance=0.0)
    expected, times_ms = runs.images(some, worker=True)
    runs.add("worker", times_ms, "PSNR, dB", worst_db(expected, exact), "exact PSFs")
    found, times_ms = runs.images(some)
    runs.add("no worker", times_ms, step, difference(found, expected), "worker")
    found, times_ms = runs.images(some, is_one_state=True)
    runs.add("one state", times_ms, "PSNR, dB", worst_db(found, exact), "exact PSFs")
    start_s = time.perf_counter()
    bank = EyeBank.build(folder, eyes, runs.camera, runs.settings)
    build_s = time.perf_counter() - start_s
    sizes_mb = [path.stat().st_size / 1e6 for path in folder.glob("eye_*")]
    details.append(
        {
            "mode": mode,
            "bank_eyes": len(bank),
            "build_s": round(build_s, 1),
            "mean_mb": round(float(np.mean(sizes_mb)), 3),
            "largest_mb": round(max(sizes_mb), 3),
        }
    )
    drop_from_memory(folder)
    for method in ("bank, cold", "bank, warm"):
        found, times_ms = runs.images(list(bank))
        runs.add(method, times_ms, step, difference(found[:count], expected), "worker")
    return runs.rows


def write_crops(folder: Path, count: int) -> None:
    """Write crops of photographs."""
    import skimage

    rng = np.random.default_rng(3)
    place = Path(skimage.__file__).parent / "data"
    pictures = [np.asarray(Image.open(place / n).convert("RGB")) for n in PICTURES]
    folder.mkdir()
    for number in range(count):
        picture = pictures[number % len(pictures)]
        y, x = (int(rng.integers(0, n - SIDE_PX + 1)) for n in picture.shape[:2])
        crop = np.ascontiguousarray(picture[y : y + SIDE_PX, x : x + SIDE_PX])
        Image.fromarray(crop).save(folder / f"{number:05d}.jpg", quality=95)


def run_batch(
    mode: str, folder: Path, counts: tuple[int, int, int], details: list[dict]
) -> Row:
    """Measure `ocufilter batch` with an eye for each image."""
    count, people_count, exact_count = counts
    crops = folder / "crops"
    if not crops.exists():
        write_crops(crops, count)
    person = {"kind": "prescription", "sphere_dpt": -1.5, "age_years": 30}
    common = [
        *(sys.executable, "-m", "ocufilter", "batch", str(crops), "--json"),
        *("-p", json.dumps(person), "--sample-eyes", str(people_count), "--seed", "1"),
        *("--sample-pupil-mm", "{},{}".format(*PUPILS_MM)),
        *("--sample-focus-dpt", "{},{}".format(*FOCI_DPT)),
        *("--fov-deg", str(FOV_DEG), "--distance-m", str(DISTANCE_M)),
        *("--settings", json.dumps({"mode": mode}), "--workers", "2"),
    ]

    def images(name: str, *more: str) -> tuple[dict[str, Any], list[np.ndarray]]:
        out = folder / f"{name}_{mode}"
        command = [*common, "-o", str(out), *more]
        told = subprocess.run(command, check=True, stdout=subprocess.PIPE)
        files = sorted(out.glob("images/*.png"))[:exact_count]
        return json.loads(told.stdout), [np.asarray(Image.open(f)) for f in files]

    load, start_s = os.getloadavg()[0], time.perf_counter()
    summary, found = images("seen")
    took_s = time.perf_counter() - start_s
    _, exact = images("exact", "--limit", str(exact_count), "--render-tolerance", "0")
    core_s = summary["this_run"]["core_seconds"]
    eyes = len(summary["frames_done"])
    details.append(
        {
            "mode": mode,
            "images": count,
            "eyes": eyes,
            "workers": 2,
            "seconds": round(took_s, 1),
            "core_ms": round(1e3 * core_s / count, 2),
            "images_per_s": round(count / took_s, 1),
            "load": [round(one, 1) for one in (load, os.getloadavg()[0])],
        }
    )
    ms = 1e3 * took_s / count
    error = worst_db(found, exact)
    return Row(
        *("ml", "batch", mode, f"{SIDE_PX}x{SIDE_PX}", count, ms, ms, memory_mb()),
        *("PSNR, dB", error, "exact PSFs"),
    )


def blurs(count: int) -> list[dict]:
    """Return the times of Gaussian blurs of other packages, if they are installed."""
    color = scene_view("courtyard", width_px=SIDE_PX, height_px=SIDE_PX).color
    calls: dict[str, Callable[[], object]] = {}
    if importlib.util.find_spec("albumentations"):
        import albumentations

        blur = albumentations.GaussianBlur(sigma_limit=(2.0, 2.0), p=1.0)
        calls["albumentations"] = lambda: blur(image=color)
    if all(map(importlib.util.find_spec, ("kornia", "torch"))):
        import kornia
        import torch

        torch.set_num_threads(1)
        batch = torch.from_numpy(color).movedim(-1, 0)[None].float()
        calls["kornia"] = lambda: kornia.filters.gaussian_blur2d(
            batch, (13, 13), (2.0, 2.0)
        )
    found = []
    for name, call in calls.items():
        median_ms, _ = time_calls(call, repeats=count, clock=time.process_time)
        found.append({"package": name, "gaussian_2_px_ms": round(median_ms, 3)})
    return found


def loaders(bank: EyeBank, count: int, n_workers: int) -> list[dict]:
    """Return memory, start and speed of workers, and whether images are the same."""
    runs = Runs(MODES[0], bank.camera)
    eyes = {"bank": bank[:count], "drawn": people(count), "none": []}
    expected, _ = runs.images(bank[:count])
    wanted = {"none": digest([runs.frame[0]] * count)}
    packages = [
        "multiprocessing",
        *["torch"][: bool(importlib.util.find_spec("torch"))],
    ]
    found = []
    for package, (name, profiles), method in itertools.product(
        packages, eyes.items(), ("fork", "spawn")
    ):
        pictures = SeenPictures(
            runs.frame, bank.camera, bank.settings, profiles, states(count)
        )
        own = measured(pictures, method, n_workers, with_torch=package == "torch")
        is_same = own.pop("images") == wanted.get(name, digest(expected))
        found.append(
            {"package": package, "eyes": name, "start": method}
            | own
            | {"same_images": is_same}
        )
    return found


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, and figures of banks, batches, workers and blurs."""
    os.environ[THREADS_VARIABLE] = "1"
    counts, n_workers = (COUNT, BANK_COUNT, EXACT_COUNT), N_WORKERS
    batch_counts = BATCH_COUNT, BATCH_PEOPLE, EXACT_COUNT
    if run.is_quick:
        n_workers = QUICK_N_WORKERS
        counts = QUICK_COUNT, QUICK_BANK_COUNT, QUICK_EXACT_COUNT
        batch_counts = QUICK_BATCH_COUNT, QUICK_BANK_COUNT, QUICK_EXACT_COUNT
    rows: list[Row] = []
    banks: list[dict] = []
    batches: list[dict] = []
    with tempfile.TemporaryDirectory() as name:
        for mode in MODES:
            rows += run_mode(mode, counts, Path(name) / mode, banks)
            rows.append(run_batch(mode, Path(name), batch_counts, batches))
        workers = loaders(EyeBank(Path(name) / MODES[0]), counts[0], n_workers)
    details = {"banks": banks, "batches": batches, "workers": workers}
    return rows, details | {"blurs": blurs(counts[0])}
