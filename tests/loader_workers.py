"""Processes that filter images as the workers of a data loader do.

    python -m tests.loader_workers FILE METHOD WORKERS [--torch]

FILE is a pickled `SeenPictures`, METHOD "fork" or "spawn".  Prints JSON: the processor
time of a worker until its first image, with its interpreter and imports; the PSS of all
workers, and of their children, after the last image; images per second; and a hash of
the images.  With ``--torch``, the workers are those of a `DataLoader`; without, of
`multiprocessing`, without PyTorch.  `measured` runs this as a program of its own, so
that workers load what they need and not what a benchmark imports.
"""

import hashlib
import json
import multiprocessing
import os
import pickle
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from filter_service import Camera, EyeFilter, FilterSettings
from tests.process_memory import process_ids, pss_mb

BATCH = 4
THREADS_VARIABLE = "OCUFILTER_THREADS"


class SeenPictures:
    """A data set: one picture through the eye, and in the state, of each sample.

    Parameters
    ----------
    frame : ((height, width, 3), (height, width))
        Color and depth, m.
    camera : Camera
    settings : FilterSettings
    profiles : sequence
        Profile of each sample; none for the picture itself, without a filter.
    states : sequence of dict
        Pupil and focus of each sample.
    """

    def __init__(
        self,
        frame: tuple[np.ndarray, np.ndarray],
        camera: Camera,
        settings: FilterSettings,
        profiles: Any,
        states: list[dict[str, float]],
    ) -> None:
        self.frame, self.camera, self.settings = frame, camera, settings
        self.profiles, self.states = profiles, states
        self.eye_filter: EyeFilter | None = None
        self.start_s = 0.0

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.states)

    def __getitem__(self, index: int) -> tuple[int, np.ndarray, int, float, float]:
        """Return the number, the image, and the process that filtered it.

        Of that, its id, processor time until its first image, and that until now, s.
        """
        image = self._seen(index)
        now_s = time.process_time()
        self.start_s = self.start_s or now_s
        return index, image, os.getpid(), self.start_s, now_s

    def _seen(self, index: int) -> np.ndarray:
        if not len(self.profiles):
            return self.frame[0].copy()
        if self.eye_filter is None:
            self.eye_filter = EyeFilter(camera=self.camera, settings=self.settings)
        self.eye_filter.set_profile(self.profiles[index])
        seen = self.eye_filter.filter(*self.frame, **self.states[index], whole=True)
        return np.asarray(seen.color)


def work(pictures: SeenPictures, indices: list[int], results: Any, end: Any) -> None:
    """Send the samples of a worker; then wait until its memory is measured."""
    for index in indices:
        results.put(pictures[index])
    end.wait()


def loaded(pictures: SeenPictures, method: str, n_workers: int) -> dict[str, Any]:
    """Measure workers of `multiprocessing`."""
    context = multiprocessing.get_context(method)
    results, end = context.SimpleQueue(), context.Event()
    numbers = range(len(pictures))
    processes = [
        context.Process(
            target=work,
            args=(pictures, numbers[k::n_workers], results, end),
            daemon=True,
        )
        for k in range(n_workers)
    ]
    for process in processes:
        process.start()
    samples, times_s = [], []
    for _ in numbers:
        samples.append(results.get())
        times_s.append(time.perf_counter())
    found = summary(samples, times_s)
    end.set()
    for process in processes:
        process.join()
    return found


def loaded_by_torch(
    pictures: SeenPictures, method: str, n_workers: int
) -> dict[str, Any]:
    """Measure workers of a `DataLoader`."""
    from torch.utils.data import DataLoader

    warnings.filterwarnings("ignore", "This DataLoader will create")  # many workers
    loader = DataLoader(
        pictures,
        BATCH,
        num_workers=n_workers,
        multiprocessing_context=method,
        collate_fn=list,
        persistent_workers=True,  # until their memory is measured
    )
    samples, times_s = [], []
    for batch in loader:
        samples += batch
        times_s += [time.perf_counter()] * len(batch)
    return summary(samples, times_s)


def summary(samples: list[tuple], times_s: list[float]) -> dict[str, Any]:
    """Return the measurements of the samples and times of arrival of all images."""
    workers = {sample[2]: sample for sample in samples}  # the last of each
    pids = [p for pid in workers for p in process_ids(pid, "worker").values()]
    sizes_mb = [pss_mb(pid) for pid in pids]
    images = [sample[1] for sample in sorted(samples, key=lambda sample: sample[0])]
    starts_s = [start_s for *_, start_s, _ in workers.values()]
    n_later = len(samples) - len(workers)
    later_s = sum(now_s - start_s for *_, start_s, now_s in workers.values())
    half = len(times_s) // 2  # the first half has the starts
    elapsed_s = times_s[-1] - times_s[half - 1]
    return {
        "workers": len(workers),
        "processes": len(pids),
        "pss_mb": None if None in sizes_mb else round(sum(map(float, sizes_mb))),
        "start_s": round(max(starts_s), 2),
        "processor_ms": round(1e3 * later_s / max(n_later, 1), 1),
        "images_per_s": round((len(times_s) - half) / max(elapsed_s, 1e-9), 1),
        "images": digest(images),
    }


def digest(images: list[np.ndarray]) -> str:
    """Return a hash of the bytes of images."""
    found = hashlib.blake2b(digest_size=16)
    for image in images:
        found.update(image.tobytes())
    return found.hexdigest()


def measured(
    pictures: SeenPictures, method: str, n_workers: int, *, with_torch: bool = False
) -> dict[str, Any]:
    """Return the measurements of a program of its own, with the default threads."""
    variables = {k: v for k, v in os.environ.items() if k != THREADS_VARIABLE}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pictures"
        path.write_bytes(pickle.dumps(pictures))
        found: dict[str, Any] = json.loads(
            subprocess.run(
                [
                    *(sys.executable, "-m", "tests.loader_workers"),
                    *(path, method, str(n_workers), *["--torch"][: int(with_torch)]),
                ],
                env=variables,
                stdout=subprocess.PIPE,
                check=True,
            ).stdout
        )
    return found


def main() -> None:
    """Run from the command line."""
    pictures = pickle.loads(Path(sys.argv[1]).read_bytes())
    load = loaded_by_torch if "--torch" in sys.argv else loaded
    print(json.dumps(load(pictures, sys.argv[2], int(sys.argv[3]))))


if __name__ == "__main__":
    # Under its own name, so that workers that are spawned import this module.
    from tests.loader_workers import main as run

    run()
