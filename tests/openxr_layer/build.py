"""Compiles the OpenXR runtime and the application that the tests of the layer use.

build_runtime   mock_runtime/, with its manifest for XR_RUNTIME_JSON
build_driver    driver/
build_handles   handles.c, a program with two threads
build_layer     the layer itself
missing         what this machine lacks for that
thread_sanitizer_options   for programs built with -fsanitize=thread

    python -m tests.openxr_layer.build FOLDER [FLAG ...]     builds both
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

from tests.native_build import extension
from tests.source_tree import ROOT

RUNTIME = Path(__file__).with_name("mock_runtime")
DRIVER = Path(__file__).with_name("driver")
COMPILER = shutil.which("cc")
HEADERS = ("openxr/openxr.h", "openxr/openxr_platform.h", "GL/glx.h", "EGL/egl.h")
HEADERS += ("vulkan/vulkan.h",)
INCLUDE = Path("/usr/include")

WARNINGS = ("-Wall", "-Wextra", "-Werror")
FLAGS = ("-std=gnu11", "-O1", "-g", *WARNINGS)
UNSEEN_LIBRARIES = ("libgallium", "libEGL_mesa", "libGLX_mesa")
LIBRARIES = ("-lGL", "-lEGL", "-lX11", "-lvulkan", "-lm", "-lpthread")


def missing() -> str | None:
    """Return why nothing can be built here, or None."""
    if COMPILER is None:
        return "no C compiler"
    absent = [name for name in HEADERS if not (INCLUDE / name).exists()]
    return f"no header {absent[0]} in {INCLUDE}" if absent else None


def build_runtime(folder: Path, *flags: str) -> Path:
    """Compile the runtime; return its manifest.

    Parameters
    ----------
    folder : Path
        Where libmock_runtime.so and mock_runtime.json are written.
    *flags : str
        More flags of the compiler, such as ``-fsanitize=address``.

    Raises
    ------
    subprocess.CalledProcessError
        The compiler failed; what it said is on standard error.
    """
    library = folder / "libmock_runtime.so"
    # nodelete: the loader unloads a runtime with its instance, and the runtime counts
    # frames and handles through the life of the process
    shared = ("-shared", "-fPIC", "-fvisibility=hidden", "-Wl,-z,nodelete")
    _compile(sorted(RUNTIME.glob("*.c")), library, (*shared, *flags), LIBRARIES)
    manifest = folder / "mock_runtime.json"
    runtime = {"name": "mock runtime", "library_path": str(library)}
    manifest.write_text(
        json.dumps({"file_format_version": "1.0.0", "runtime": runtime}),
        encoding="utf-8",
    )
    return manifest


def build_driver(folder: Path, *flags: str) -> Path:
    """Compile the application; return its path.  As `build_runtime`."""
    program = folder / "driver"
    _compile(
        sorted(DRIVER.glob("*.c")), program, flags, (*LIBRARIES, "-lopenxr_loader")
    )
    return program


def build_handles(folder: Path, *flags: str) -> Path:
    """Compile handles.c; return its path.  As `build_runtime`."""
    program = folder / "handles"
    source = Path(__file__).with_name("handles.c")
    _compile([source], program, flags, (*LIBRARIES, "-lopenxr_loader"))
    return program


def build_layer(folder: Path, *flags: str) -> Path:
    """Compile the layer as the package does; return its path.  As `build_runtime`."""
    library = folder / "layer.so"
    own = extension("_layer")
    command = (COMPILER, "-shared", "-fPIC", *own.extra_compile_args, *WARNINGS, "-g")
    libraries = [f"-l{name}" for name in own.libraries]
    subprocess.run(
        [*command, *flags, *own.sources, "-o", str(library), "-pthread", *libraries],
        cwd=ROOT,
        check=True,
    )
    return library


def thread_sanitizer_options(folder: Path) -> dict[str, str]:
    """Return the environment in which reports are of instrumented code only.

    Mesa and LLVM synchronize with atomic operations that the sanitizer does not see;
    it then takes their locks to be held in another order, or never.

    Parameters
    ----------
    folder : Path
        Where the suppressions are written.
    """
    suppressions = folder / "thread.supp"
    lines = [f"race:{name}\n" for name in UNSEEN_LIBRARIES]
    suppressions.write_text("".join(lines), encoding="utf-8")
    return {"TSAN_OPTIONS": f"detect_deadlocks=0 suppressions={suppressions}"}


def _compile(sources, output, flags, libraries) -> None:
    subprocess.run(
        [COMPILER, *FLAGS, *flags, *map(str, sources), "-o", str(output), *libraries],
        check=True,
    )


def main() -> None:
    """Build both into a folder."""
    folder, *flags = sys.argv[1:]
    Path(folder).mkdir(parents=True, exist_ok=True)
    print(build_runtime(Path(folder), *flags))
    print(build_driver(Path(folder), *flags))


if __name__ == "__main__":
    main()
