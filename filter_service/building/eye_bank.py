"""Banks of prebuilt eyes on disk, for programs that see each image through another eye.

    bank = EyeBank.build("bank", people, camera, settings)  # once, on all cores
    with EyeFilter(bank[0], bank.camera, bank.settings, worker=False) as eye_filter:
        eye_filter.set_profile(bank[17])

A bank is a folder with a file for each eye, which contains the estimated eye and all
PSFs that frames within the settings can read.  Files are mapped, so that processes
share their memory, and a frame reads only the kernels that it needs.  They are written
atomically: a build that was interrupted continues where it stopped.

    python -m filter_service.building.eye_bank FOLDER FIRST STEP

builds every STEP-th eye of a bank; `EyeBank.build` starts one such process per core.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.field.peripheral_residual import PeripheralResidual
from estimator.optics.zernike import N_TERMS
from estimator.profiles.parse import EyeProfile
from estimator.threads import THREADS_VARIABLE, thread_count
from filter_service.building.jobs import DEFAULT_LIMITS
from filter_service.camera import Camera, is_same_camera
from filter_service.constants import RGB
from filter_service.errors import BadMessage, BuildFailed
from filter_service.given_profile import as_profile
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.plan import plan_cache
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.pack import ComputedPsfs, PackedKernels, box_sizes
from filter_service.psfs.store import PsfStore
from filter_service.psfs.store_cache import check_is_private, code_version
from filter_service.psfs.store_file import DamagedFile, map_file, write_file
from filter_service.settings import DEFAULTS, FilterSettings, as_settings
from filter_service.waiting import Wait

FORMAT = 1
"""Version of the files of a bank."""

HEADER = "bank.psfs"
MAX_EYES = 100_000
DIGITS = 6

ONE_THREAD = {THREADS_VARIABLE: "1", "OPENBLAS_NUM_THREADS": "1"}
"""Variables of processes that build eyes."""

REBUILD = "a bank of this version; delete the folder and build it again"


@dataclass(frozen=True)
class BankHeader:
    """What a bank was built for.

    Attributes
    ----------
    version : int
        `FORMAT`.
    code : str
        Version of the code that computes eyes and PSFs; see `code_version`.
    camera : Camera
    settings : FilterSettings
    profiles : tuple of EyeProfile
    """

    version: int
    code: str
    camera: Camera
    settings: FilterSettings
    profiles: tuple[EyeProfile, ...]

    @property
    def spec(self) -> GridSpec:
        """Return the grid specification of the eyes."""
        return GridSpec(
            camera=self.camera,
            settings=self.settings,
            memory_budget_mb=DEFAULT_LIMITS.max_store_mb,
            max_blur_radius_px=DEFAULT_LIMITS.max_blur_radius_px,
        )


@dataclass(frozen=True)
class BankedKernels:
    """Kernels of all PSFs (n,) of an eye; fields as in `PackedKernels`.

    Channels that share a kernel have one together.
    """

    weights: NDArray[np.uint16]
    reach_px: NDArray[np.uint8]
    radius_px: NDArray[np.uint8]
    peak_ratio: NDArray[np.float32]
    spread_px: NDArray[np.float32]
    lost_energy_ratio: NDArray[np.float32]

    @classmethod
    def of(cls, store: PsfStore) -> BankedKernels:
        """Compute all kernels of a store."""
        psfs = store.not_computed(np.arange(store.psf_count))
        found = [
            store.computed(batch).packed
            for batch in np.array_split(psfs, -(-psfs.size // BATCH) or 1)
        ]
        return cls(
            **{
                field.name: np.concatenate(
                    [getattr(own, field.name) for own in found]
                ).astype(DTYPES.get(field.name))
                for field in fields(cls)
            }
        )

    def packed(self) -> PackedKernels:
        """Return the kernels with their offsets."""
        reach_px = self.reach_px.astype(np.int64)
        widths, heights = box_sizes(reach_px)
        sizes = widths * heights
        return PackedKernels(
            weights=self.weights,
            offsets=np.cumsum(sizes) - sizes,
            reach_px=reach_px,
            radius_px=self.radius_px.astype(np.int64),
            peak_ratio=self.peak_ratio.astype(np.float64),
            spread_px=self.spread_px.astype(np.float64),
            lost_energy_ratio=self.lost_energy_ratio.astype(np.float64),
        )


BATCH = 2048
"""PSFs that are computed at a time."""

DTYPES = {
    "weights": np.uint16,
    "reach_px": np.uint8,
    "radius_px": np.uint8,
    "peak_ratio": np.float32,
    "spread_px": np.float32,
    "lost_energy_ratio": np.float32,
}
"""Types in files, in which `StoreTables` keeps these values, too."""


@dataclass(frozen=True)
class BankFile:
    """Content of the file of an eye.

    Attributes
    ----------
    code : str
        As in `BankHeader`.
    eye : EyeOptics
    spec : GridSpec
    plan : CachePlan
    kernels : BankedKernels
    notes : tuple of str
    known_h_deg, known_v_deg : (n,)
    known_phase_um : (n, 28), um/mm^degree
        Fields that every frame needs, and the phase of the periphery there; see
        `PeripheralResidual.keep`.  Empty for an eye without one.
    """

    code: str
    eye: EyeOptics
    spec: GridSpec
    plan: CachePlan
    kernels: BankedKernels
    notes: tuple[str, ...]
    known_h_deg: NDArray[np.float64]
    known_v_deg: NDArray[np.float64]
    known_phase_um: NDArray[np.float64]


class BankStore(PsfStore):
    """A store whose kernels come from a file instead of being computed.

    Parameters
    ----------
    path : str
        File of the eye.
    """

    def __init__(self, path: str) -> None:
        found = _read_eye(path)
        super().__init__(found.eye, found.spec, found.plan)
        self.path, self.notes = path, found.notes
        self._banked = found.kernels.packed()
        periphery = _periphery_of(found.eye)
        if periphery is not None and found.known_h_deg.size:
            periphery.keep(found.known_h_deg, found.known_v_deg, found.known_phase_um)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the path, from which another process maps the file."""
        return type(self), (self.path,)

    def computed(
        self,
        psfs: NDArray[np.int64],
        *,
        thread_count: int | None = None,
    ) -> ComputedPsfs:
        """Return kernels from the file; see `PsfStore.computed`."""
        kernels = psfs if self.spec.settings.chromatic else psfs // RGB
        return ComputedPsfs(psfs, self._banked.select(kernels), Counter())


def _periphery_of(eye: EyeOptics) -> PeripheralResidual | None:
    found: PeripheralResidual | None = getattr(eye, "periphery", None)
    return found


@dataclass(frozen=True)
class BankedEye(EyeProfile):
    """A profile whose eye is in a bank, for `EyeFilter`.

    Attributes
    ----------
    path : str
        File of the eye.
    """

    path: str = ""

    @cached_property
    def digest(self) -> str:
        """Return the digest of the profile, which does not depend on the bank."""
        return _plain(self).digest

    def store(self, spec: GridSpec) -> BankStore:
        """Return the store of the eye.

        Raises
        ------
        BadMessage
            If the bank was built for another camera or other settings.
        BuildFailed
            If the file is missing, damaged or of another version.
        """
        try:
            store = BankStore(self.path)
        except (OSError, DamagedFile) as error:
            reason = getattr(error, "strerror", None) or error
            raise BuildFailed(
                f"'{self.path}' cannot be read: {reason}",
                field="profile",
                allowed="an eye of a complete bank; EyeBank.build completes it",
            ) from error
        _check_same(spec, store.spec)
        return store


class EyeBank(Sequence[BankedEye]):
    """A bank of prebuilt eyes, a sequence of profiles for `EyeFilter`.

    An eye of a bank needs no estimation and no computation of PSFs: a filter maps its
    file.  Images have the same bytes as without the bank.  The files contain medical
    data, and only their owner can read them.

    Parameters
    ----------
    folder : str or Path
        Folder of a bank.

    Attributes
    ----------
    folder : Path
    camera : Camera
        Camera of the frames.
    settings : FilterSettings
        Settings of the frames.

    Raises
    ------
    FileNotFoundError
        If the folder contains no bank.
    ValueError
        If the bank is damaged, or was built by another version.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        header = _read_header(self.folder)
        self.camera, self.settings = header.camera, header.settings
        self._profiles = header.profiles

    def __len__(self) -> int:
        """Return the number of eyes."""
        return len(self._profiles)

    def __getitem__(self, number: Any) -> Any:
        """Return an eye, or the eyes of a slice."""
        if isinstance(number, slice):
            return [self[k] for k in range(len(self))[number]]
        place = range(len(self))[number]  # raises IndexError
        return _banked(self._profiles[place], _eye_path(self.folder, place))

    @property
    def size_mb(self) -> float:
        """Return the size of all files, 10^6 bytes."""
        return sum(path.stat().st_size for path in self.folder.glob("*.psfs")) / 1e6

    @classmethod
    def build(
        cls,
        folder: str | Path,
        profiles: Sequence[EyeProfile | Mapping[str, Any] | str | Path],
        camera: Camera,
        settings: FilterSettings | Mapping[str, Any] = DEFAULTS,
        *,
        workers: int | None = None,
    ) -> Self:
        """Build a bank, or the eyes that an interrupted build left out.

        A bar on stderr shows the progress if that is a terminal.

        Parameters
        ----------
        folder : str or Path
            New folder, or that of a bank of the same eyes.
        profiles : sequence of EyeProfile, mapping, str or Path
            Profiles as for `EyeFilter`, 1 to 100,000; `drawn_profiles` draws persons.
        camera : Camera
            Camera of the frames.
        settings : FilterSettings or mapping, optional
            Settings of the frames.  All PSFs of their ranges of pupil, focus and
            objects are computed, so narrow ranges make small files.
        workers : int, optional
            Number of processes; by default one per core.

        Raises
        ------
        ValueError
            If a profile is invalid, or the folder contains another bank.
        BuildFailed
            If an eye cannot be built.
        """
        if not 1 <= len(profiles) <= MAX_EYES:
            raise BadMessage(
                f"{len(profiles)}", field="profiles", allowed=f"1 to {MAX_EYES:,}"
            )
        header = BankHeader(
            FORMAT,
            code_version(),
            camera,
            as_settings(settings),
            tuple(_plain(as_profile(profile)) for profile in profiles),
        )
        _ = header.spec  # raises for an impossible camera
        place = Path(folder)
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_is_private(place)
        if (place / HEADER).exists():
            if not _is_same(_read_header(place), header):
                raise BadMessage(
                    f"'{place}' contains a bank of other eyes, another camera or other "
                    "settings",
                    field="folder",
                    allowed="a new folder",
                )
        else:
            write_file(place / HEADER, header)
        count = len(header.profiles)
        _run_workers(place, count, min(workers or thread_count(), count))
        return cls(place)


def _is_same(first: BankHeader, second: BankHeader) -> bool:
    """Return whether two banks have the same eyes, camera and settings."""
    from filter_service.psfs.store_cache import store_key

    return (first.camera, len(first.profiles)) == (
        second.camera,
        len(second.profiles),
    ) and all(
        store_key(mine, first.spec) == store_key(other, second.spec)
        for mine, other in zip(first.profiles, second.profiles, strict=True)
    )


def _banked(profile: EyeProfile, path: Path) -> BankedEye:
    return BankedEye(**_fields_of(profile), path=str(path))


def _plain(profile: EyeProfile) -> EyeProfile:
    """Return a profile that is in no bank."""
    return EyeProfile(**_fields_of(profile))


def _fields_of(profile: EyeProfile) -> dict[str, Any]:
    return {field.name: getattr(profile, field.name) for field in fields(EyeProfile)}


def _eye_path(folder: Path, number: int) -> Path:
    return folder / f"eye_{number:0{DIGITS}d}.psfs"


def _read_header(folder: Path) -> BankHeader:
    path = folder / HEADER
    try:
        header = map_file(path)
    except DamagedFile as error:
        raise BadMessage(
            f"'{path}' is damaged or of another version: {error}",
            field="folder",
            allowed=REBUILD,
        ) from error
    if not isinstance(header, BankHeader):
        raise BadMessage(f"'{path}' is no bank", field="folder", allowed=REBUILD)
    if (header.version, header.code) != (FORMAT, code_version()):
        raise BadMessage(
            f"'{folder}' was built by another version of ocufilter",
            field="folder",
            allowed=REBUILD,
        )
    return header


_verified: set[tuple[str, int, int]] = set()
"""Files whose checksum this process has verified: path, time of change and size."""


def _read_eye(path: str) -> BankFile:
    """Map the file of an eye; verify its checksum when it is first used.

    Raises
    ------
    DamagedFile, OSError
    """
    status = os.stat(path)
    key = path, status.st_mtime_ns, status.st_size
    found = map_file(Path(path), verify=key not in _verified)
    _verified.add(key)
    if not isinstance(found, BankFile):
        raise DamagedFile(f"it is a {type(found).__name__}, not an eye of a bank")
    if found.code != code_version():
        raise DamagedFile("it was built by another version of ocufilter")
    return found


def _check_same(asked: GridSpec, built: GridSpec) -> None:
    """Raise if frames of a grid cannot use the PSFs of another."""
    follows_field = built.settings.follows_field
    if not is_same_camera(asked.camera, built.camera, follows_field=follows_field):
        raise BadMessage(
            f"it is {asked.camera}",
            field="camera",
            allowed=f"{built.camera}, the bank's",
        )
    for name, value in built.settings.fields().items():
        given = asked.settings.fields()[name]
        if given != value:
            raise BadMessage(
                f"it is {given!r}",
                field=f"settings.{name}",
                allowed=f"{value!r}, as in the bank",
            )


def _run_workers(folder: Path, count: int, n_workers: int) -> None:
    """Build the missing eyes of a bank in processes, and show the progress.

    Raises
    ------
    BuildFailed
    """
    lines: SimpleQueue[tuple[str, str]] = SimpleQueue()
    command = [sys.executable, "-P", "-m", "filter_service.building.eye_bank"]
    environment = {
        **os.environ,
        **ONE_THREAD,
        "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path),
    }
    processes = [
        subprocess.Popen(
            [*command, str(folder), str(first), str(n_workers)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        for first in range(n_workers)
    ]

    def read(process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout as output:
            for line in output:
                kind, _, text = line.rstrip("\n").partition(" ")
                lines.put((kind, text))
        lines.put(("end", str(process.wait())))

    readers = [
        threading.Thread(target=read, args=(process,), daemon=True)
        for process in processes
    ]
    for reader in readers:
        reader.start()
    try:
        n_done, n_ended = 0, 0
        with Wait("Building a bank of eyes") as waiting:
            while n_ended < n_workers:
                kind, text = lines.get()
                if kind == "done":
                    n_done += 1
                    waiting.update(n_done, n_done / count, f"{n_done} of {count} eyes")
                elif kind == "failed":
                    raise BuildFailed(text)
                elif text == "0":
                    n_ended += 1
                else:
                    raise BuildFailed(f"a process that builds eyes ended with {text}")
    finally:
        for process in processes:
            if process.poll() is None:
                process.terminate()
        for reader in readers:
            reader.join()


def _build_missing(folder: Path, first: int, step: int) -> Iterator[str]:
    """Build every ``step``-th eye of a bank; yield a line for each."""
    header = _read_header(folder)
    for number in range(first, len(header.profiles), step):
        path = _eye_path(folder, number)
        with suppress(OSError, DamagedFile):
            _read_eye(str(path))
            yield "done"
            continue
        try:
            eye, notes = eye_for_spec(header.profiles[number], header.spec)
            plan = plan_cache(eye, header.spec)
            store = PsfStore(eye, header.spec, plan)
            kernels = BankedKernels.of(store)
            _ = store.defocus  # evaluates the periphery for frames
        except Exception as error:
            text = " ".join(str(error).split())
            yield f"failed eye {number}: {text or type(error).__name__}"
            return
        periphery = _periphery_of(eye)
        known = None if periphery is None else periphery.last_known()
        known = known or (np.zeros(0), np.zeros(0), np.zeros((0, N_TERMS)))
        write_file(
            path, BankFile(header.code, eye, header.spec, plan, kernels, notes, *known)
        )
        yield "done"


if __name__ == "__main__":
    # Under its own name, so that files contain classes of this module.
    from filter_service.building.eye_bank import _build_missing as build_missing

    for line in build_missing(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])):
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()
