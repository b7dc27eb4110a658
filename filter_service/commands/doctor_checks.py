"""What this machine can do, what it lacks, and the command that would install it."""

import ctypes.util
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version

from estimator.threads import thread_count
from filter_service.threads import UNSAFE_THREADING_LAYER

SERVICE_PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "moderngl",
    "glcontext",
    "pyzmq",
    "msgpack",
    "pillow",
    "OpenEXR",
    "onnxruntime",
    "typer",
)
CLIENT_PACKAGES = ("pyrender", "trimesh", "PyOpenGL", "imageio", "imageio-ffmpeg")
WINDOW_PACKAGES = ("glfw",)

SYSTEM_LIBRARIES = {"EGL": "libegl1", "GL": "libgl1", "gomp": "libgomp1"}
"""Library that must be found by name, and the Debian package that holds it."""

PROBE_TIMEOUT_S = 60.0

FIX_PACKAGES = "make demo, or: sh setup.sh"
APT_INSTALL = "sudo apt-get update && sudo apt-get install -y"
FIX_WEIGHTS = "git checkout -- estimator/networks/weights"
FIX_MESA = f"{APT_INSTALL} libgl1-mesa-dri"


"""Numba's fallback: two threads in parallel kernels at once end the process."""


@dataclass(frozen=True)
class Check:
    """One thing that was tried: whether it works, what was seen, how to mend it."""

    name: str
    ok: bool
    detail: str
    fix: str = ""


def examine() -> dict:
    """Try everything once.

    Returns
    -------
    report : dict
        Plain JSON: ``ok`` (the service can run), ``works`` by purpose, ``checks``,
        ``install`` (commands), ``machine``, ``gl``, ``threading_layer``,
        ``networks`` (each with its weights' size and expected error), ``packages``.
    """
    gl = run_probe("gl")
    threads = run_probe("threads")
    networks = run_probe("networks")
    packages = package_versions()
    checks = [
        check_python(),
        check_packages("service packages", SERVICE_PACKAGES, packages),
        *check_libraries(),
        check_gl(gl),
        check_compute(gl),
        check_threads(threads),
        check_networks(networks),
        check_packages("client packages", CLIENT_PACKAGES, packages),
        check_packages("window packages", WINDOW_PACKAGES, packages),
        check_display(),
    ]
    works = what_works({check.name: check.ok for check in checks})
    return {
        "ok": works["serve"],
        "works": works,
        "checks": [asdict(check) for check in checks],
        "install": install_commands(checks),
        "machine": machine(),
        "gl": gl.get("info", {}) | {"limits": gl.get("limits", {})},
        "threading_layer": threads.get("layer"),
        "networks": networks.get("cards", {}),
        "packages": packages,
    }


def run_probe(name: str) -> dict:
    """Run one probe in its own process; ``error`` says why it gave no answer."""
    command = [sys.executable, "-m", "filter_service.commands.doctor_probes", name]
    try:
        finished = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no answer within {PROBE_TIMEOUT_S:g} s"}
    if finished.returncode == 0:
        return json.loads(finished.stdout.splitlines()[-1])
    if finished.returncode < 0:
        return {"error": f"ended by signal {-finished.returncode}"}
    last_lines = finished.stderr.strip().splitlines()[-1:]
    return {"error": last_lines[0] if last_lines else "ended without a word"}


def machine() -> dict:
    """Return processor, system and Python, as benchmark files name them too."""
    try:
        system = platform.freedesktop_os_release().get("PRETTY_NAME", "unknown")
    except OSError:
        system = platform.platform()
    return {
        "system": system,
        "processor": processor_name(),
        "n_cores": thread_count(),
        "python": platform.python_version(),
    }


def processor_name() -> str:
    """Model name as the kernel tells it, or the architecture."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.machine()


def package_versions() -> dict[str, str | None]:
    """Version of each package the project may use; None where it is missing."""
    versions: dict[str, str | None] = {}
    for name in SERVICE_PACKAGES + CLIENT_PACKAGES + WINDOW_PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    return versions


def check_python() -> Check:
    """Check for Python 3.11 or newer."""
    ok = sys.version_info >= (3, 11)
    return Check("python", ok, platform.python_version(), "" if ok else "Python 3.11")


def check_packages(
    name: str, wanted: tuple[str, ...], versions: dict[str, str | None]
) -> Check:
    """Check that every package of one purpose is installed."""
    missing = [package for package in wanted if versions[package] is None]
    if missing:
        return Check(name, False, "missing: " + ", ".join(missing), FIX_PACKAGES)
    return Check(name, True, ", ".join(f"{p} {versions[p]}" for p in wanted))


def check_libraries() -> list[Check]:
    """Look for the system libraries that Python packages load by name."""
    checks = []
    for library, package in SYSTEM_LIBRARIES.items():
        found = ctypes.util.find_library(library)
        fix = "" if found else f"{APT_INSTALL} {package}"
        checks.append(Check(f"lib{library}", bool(found), found or "not found", fix))
    return checks


def check_gl(gl: dict) -> Check:
    """Report the OpenGL context that opens without a screen."""
    if "error" in gl:
        return Check("gl", False, gl["error"], FIX_MESA)
    info = gl["info"]
    return Check("gl", True, f"{info['renderer']}; OpenGL {info['version']}")


def check_compute(gl: dict) -> Check:
    """Report whether a compute shader really ran and its result came back."""
    if "error" in gl:
        return Check("compute", False, "not tried: no OpenGL context")
    ok = gl["compute_correct"] and gl["gl_error"] == "GL_NO_ERROR"
    detail = "ran and read back" if ok else f"wrong result ({gl['gl_error']})"
    return Check("compute", ok, detail, "" if ok else "update the graphics driver")


def check_threads(threads: dict) -> Check:
    """Check that two threads may call Numba at once."""
    if "error" in threads:
        return Check("threads", False, threads["error"], FIX_PACKAGES)
    layer = threads["layer"]
    if layer == UNSAFE_THREADING_LAYER:
        fix = f"{APT_INSTALL} libgomp1"
        return Check("threads", False, f"{layer}: not safe for the service", fix)
    return Check("threads", threads["sum_correct"], layer)


def check_networks(networks: dict) -> Check:
    """Report the trained networks; without them everything is ray-traced."""
    if "error" in networks:
        return Check("networks", False, networks["error"], FIX_PACKAGES)
    if networks["missing"]:
        detail = "; ".join(networks["missing"].values())
        return Check("networks", False, detail, FIX_WEIGHTS)
    found = networks["cards"].items()
    detail = ", ".join(f"{name} {card['expected_error']}" for name, card in found)
    return Check("networks", True, detail)


def check_display() -> Check:
    """Look for a screen; only the live window needs one."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if display:
        return Check("display", True, display)
    if shutil.which("Xvfb"):
        return Check("display", False, "no screen; Xvfb can stand in for one")
    return Check("display", False, "no screen", f"{APT_INSTALL} xvfb")


def what_works(ok: dict[str, bool]) -> dict[str, bool]:
    """Purposes of the program, from the checks each one needs."""
    psf = ok["python"] and ok["service packages"]
    gpu = psf and ok["gl"] and ok["compute"]
    serve = gpu and ok["threads"]
    demo = serve and ok["client packages"]
    return {
        "psf": psf,
        "filter": gpu,
        "serve": serve,
        "demo": demo,
        "window": demo and ok["window packages"] and ok["display"],
    }


def install_commands(checks: list[Check]) -> list[str]:
    """List the fixes of the checks that failed, each once."""
    return list(dict.fromkeys(c.fix for c in checks if not c.ok and c.fix))
