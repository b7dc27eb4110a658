"""An environment of Python on a machine without a network, and what is around it."""

import ctypes
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

from tests.native_build import COMPILER, LIBRARIES, build_libraries

EXPECTED = {
    "numpy": "numpy",
    "scipy": "scipy",
    "matplotlib": "matplotlib contourpy cycler fonttools kiwisolver pyparsing "
    "python-dateutil",
    "PIL": "pillow",
    "onnxruntime": "onnxruntime protobuf flatbuffers",
}
"""Modules that the kit does not carry, unless it was made with these packages."""

GL_LIBRARIES = ("libEGL.so.1", "libGL.so.1", "libOpenGL.so.0")

VENDOR_FOLDERS = ("/etc/glvnd/egl_vendor.d", "/usr/share/glvnd/egl_vendor.d")
"""Where the loader of EGL looks for drivers by itself."""

OTHER_VENDOR_FOLDERS = ("/usr/local/nvidia/share/glvnd/egl_vendor.d",)
"""Where drivers put them on machines that run containers."""

DRIVER_FOLDERS = ("/usr/local/nvidia/lib64", "/usr/local/nvidia/lib")
"""And their libraries, which the system's list need not know yet."""


class SetUpFailed(Exception):
    """The machine lacks something; says what, and what helps."""


def make_environment(folder: Path, wheels: list[Path]) -> Path:
    """Make an environment with these wheels over what Python has; its Python.

    A wheel is unpacked as it is, so that pip need not be there.
    """
    options = ("--clear", "--without-pip", "--system-site-packages")
    subprocess.run([sys.executable, "-m", "venv", *options, str(folder)], check=True)
    python = folder / "bin" / "python"
    site = Path(
        _ask(python, "import sysconfig; print(sysconfig.get_paths()['purelib'])")
    )
    for wheel in wheels:
        unpack_wheel(wheel, site)
    (site / "outer.pth").write_text(_outer_packages(), encoding="utf-8")
    return python


def unpack_wheel(wheel: Path, site: Path) -> None:
    """Unpack a wheel into a folder of packages; its scripts and headers stay out."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    for data in site.glob("*.data"):
        for part in ("purelib", "platlib"):
            if (data / part).is_dir():
                shutil.copytree(data / part, site, dirs_exist_ok=True)
        shutil.rmtree(data)


def _outer_packages() -> str:
    """Line that adds the packages of the environment that this Python is in.

    The one that is made here sees those of the Python under it alone.
    """
    if sys.prefix == sys.base_prefix:
        return ""
    paths = {sysconfig.get_paths()[name] for name in ("purelib", "platlib")}
    return "".join(f"import site; site.addsitedir({p!r})\n" for p in sorted(paths))


def missing_modules(python: Path) -> list[str]:
    """Return which of the modules that the kit does not carry are not there."""
    script = (
        "import importlib.util as u\n"
        f"print(*[m for m in {tuple(EXPECTED)!r} if u.find_spec(m) is None])"
    )
    return _ask(python, script).split()


def _ask(python: Path, script: str) -> str:
    ran = subprocess.run(
        [str(python), "-c", script], check=True, capture_output=True, text=True
    )
    return ran.stdout.strip()


def native_libraries(folder: Path) -> Path | None:
    """Return the folder with the compiled libraries; None without a compiler."""
    if COMPILER is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    if not all((folder / f"{name}.so").exists() for name in LIBRARIES):
        build_libraries(folder)
    return folder


def loads(library: str) -> bool:
    """Whether this machine finds a shared library by itself."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def variables(
    *, python: Path, commit: str, loaders: Path | None, native: Path | None
) -> dict[str, str]:
    """Return the environment variables of the steps.

    Parameters
    ----------
    loaders : Path or None
        Folder with the loaders of OpenGL, where the machine has none.
    native : Path or None
        Folder of the compiled libraries.
    """
    own = dict(os.environ)
    own |= {
        "PATH": f"{python.parent}:{own.get('PATH', '/usr/bin:/bin')}",
        "VIRTUAL_ENV": str(python.parent.parent),
        "OCUFILTER_COMMIT": commit,
        "OCUFILTER_CACHE_DIR": "",  # the user's folder of stores is left alone
        "PYTHONUNBUFFERED": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # those of the machine are not ours
    }
    if native is not None:
        own["OCUFILTER_LIBRARY_DIR"] = str(native)
    libraries = [own.get("LD_LIBRARY_PATH", "")]
    libraries += [folder for folder in DRIVER_FOLDERS if Path(folder).is_dir()]
    if loaders is not None:
        libraries.insert(0, str(loaders))
        own["GLCONTEXT_LINUX_LIBGL"] = "libGL.so.1"
        own["GLCONTEXT_LINUX_LIBEGL"] = "libEGL.so.1"
    own["LD_LIBRARY_PATH"] = ":".join(filter(None, libraries))
    drivers = vendor_files()
    if drivers:
        own.setdefault("__EGL_VENDOR_LIBRARY_FILENAMES", ":".join(drivers))
    return own


def vendor_files() -> list[str]:
    """Return descriptions of EGL drivers that the loader would not find by itself."""
    if any(any(Path(folder).glob("*nvidia*.json")) for folder in VENDOR_FOLDERS):
        return []
    return [
        str(path)
        for folder in OTHER_VENDOR_FOLDERS
        for path in sorted(Path(folder).glob("*.json"))
    ]
