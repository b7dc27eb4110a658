"""Build the sdist and the wheels from the last commit, twice, and compare the bytes.

    python -m tests.release.build FOLDER

GCC compiles, because its loops take 78 % of the time of clang's (116 and 149 ms for a
frame of the myopia preset, 1280x720, one thread).  `zig cc` links, because it carries
the symbols of every glibc: the libraries then load with glibc 2.28, which the wheels of
NumPy need, on whatever system they were built.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import shlex
import shutil
import sys
import tarfile
from pathlib import Path

from tests.release.commands import BUILD, ROOT, TOOLS, Failed, run, say

GLIBC = "2.28"  # the OpenXR layer calls memfd_create of 2.27
COMPILERS = {"x86_64": "gcc", "aarch64": "aarch64-linux-gnu-gcc"}


def platform_tag(processor: str) -> str:
    """Return the platform of the wheel for a processor."""
    return f"manylinux_{GLIBC.replace('.', '_')}_{processor}"


def last_commit() -> tuple[str, int]:
    """Return the last commit, and its time, which all files in the archives get."""
    name, time_s = run("git", "log", "-1", "--format=%H %ct").split()
    return name, int(time_s)


def export(commit: str, folder: Path) -> Path:
    """Write the files of a commit to a folder."""
    folder.mkdir(parents=True)
    archive = folder.with_suffix(".tar")
    run("git", "archive", "--format=tar", "-o", archive, commit)
    _unpack(archive, folder)
    archive.unlink()
    return folder


def build_sdist(source: Path, out: Path, time_s: int) -> Path:
    """Build the sdist of an exported tree."""
    _build(source, out, "--sdist", SOURCE_DATE_EPOCH=time_s)
    (path,) = out.glob("*.tar.gz")
    _normalize(path, time_s)
    return path


def build_wheel(sdist: Path, out: Path, processor: str, time_s: int) -> Path:
    """Build the wheel for a processor from an sdist, with all three libraries."""
    folder = out.parent / f"{out.name}-{processor}"
    folder.mkdir()
    _unpack(sdist, folder)
    (source,) = folder.iterdir()
    headers = BUILD / "headers"
    run("sh", ROOT / "tests" / "release" / "headers.sh", headers)
    zig = [TOOLS / "python", "-m", "ziglang", "cc", "-target"]
    link = [*zig, f"{processor}-linux-gnu.{GLIBC}", "-shared", "-s", "-Wl,-z,defs"]
    tag = platform_tag(processor)
    _build(
        *(source, out, "--wheel", f"-C--build-option=--plat-name={tag}"),
        SOURCE_DATE_EPOCH=time_s,
        CC=COMPILERS[processor],
        LDSHARED=shlex.join(map(str, link)),
        CFLAGS=shlex.join(["-isystem", str(headers / "usr" / "include")]),
        LDFLAGS="",
        ZIG_GLOBAL_CACHE_DIR=BUILD / "zig",
        ZIG_LOCAL_CACHE_DIR=BUILD / "zig",
    )
    shutil.rmtree(folder)
    (path,) = out.glob(f"*-{tag}.whl")
    return path


def build_local_wheel(sdist: Path, out: Path, time_s: int) -> Path:
    """Build a wheel for this machine from an sdist, as pip does for its users."""
    folder = out.parent / f"{out.name}-local"
    folder.mkdir()
    _unpack(sdist, folder)
    (source,) = folder.iterdir()
    _build(source, out, "--wheel", SOURCE_DATE_EPOCH=time_s)
    (path,) = out.glob("*-linux_*.whl")
    return path


def build_all(commit: str, time_s: int, out: Path) -> list[Path]:
    """Build the sdist and a wheel for each processor; return their paths."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    source = export(commit, out.parent / f"{out.name}-source")
    sdist = build_sdist(source, out, time_s)
    shutil.rmtree(source)
    return [sdist, *(build_wheel(sdist, out, name, time_s) for name in COMPILERS)]


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def compare(first: list[Path], second: list[Path]) -> None:
    """Check that two builds have the same bytes.

    Raises
    ------
    Failed
        With the names of the files that differ.
    """
    sums = [{path.name: sha256(path) for path in paths} for paths in (first, second)]
    if sums[0] != sums[1]:
        names = sorted({name for name, _ in sums[0].items() ^ sums[1].items()})
        raise Failed(f"two builds differ: {', '.join(names)}")


def build_twice(out: Path) -> tuple[str, list[Path]]:
    """Build into a folder, and again elsewhere; return the commit and equal files."""
    shutil.rmtree(BUILD / "again", ignore_errors=True)
    say("building the sdist and the wheels")
    last = last_commit()  # once, because a commit may be added meanwhile
    built = build_all(*last, out)
    say("building them again, in a folder with another name")
    compare(built, build_all(*last, BUILD / "again" / "elsewhere"))
    return last[0], built


def _build(source: Path, out: Path, *options: str, **environment) -> None:
    python = TOOLS / "python"
    command = (python, "-m", "build", "--no-isolation", "--outdir", out, *options)
    run(*command, source, cwd=out, **environment)


def _unpack(archive: Path, folder: Path) -> None:
    with tarfile.open(archive) as opened:
        if hasattr(tarfile, "data_filter"):  # since Python 3.11.4
            opened.extraction_filter = tarfile.data_filter
        opened.extractall(folder)
    for path in [folder, *folder.rglob("*")]:  # whatever the umask of this process
        executable = path.is_dir() or path.stat().st_mode & 0o100
        path.chmod(0o755 if executable else 0o644)


def _normalize(path: Path, time_s: int) -> None:
    """Sort the files of an archive; set their times and owners."""
    packed = io.BytesIO()
    with tarfile.open(path) as old, tarfile.open(fileobj=packed, mode="w") as new:
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            member.mtime, member.uid, member.gid = time_s, 0, 0
            member.uname = member.gname = ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    path.write_bytes(gzip.compress(packed.getvalue(), 9, mtime=time_s))


def main() -> None:
    """Build into the folder of the command line."""
    os.umask(0o022)
    _, built = build_twice(Path(sys.argv[1]).resolve())
    for path in built:
        print(f"{sha256(path)}  {path.name}")


if __name__ == "__main__":
    main()
