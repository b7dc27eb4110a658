"""`ocufilter doctor`: what works on this machine, and what is missing."""

import ctypes.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from estimator.threads import thread_count
from filter_service.command_line import CommandFailed, Json, print_json, print_line
from filter_service.gl_device import (
    GL_DEVICE_VARIABLE,
    is_device_selected,
    is_software_renderer,
)
from filter_service.version import __version__

SERVICE_PACKAGES = (
    "numpy",
    "scipy",
    "moderngl",
    "glcontext",
    "pyzmq",
    "msgpack",
    "msgspec",
    "lz4",
    "lazy-loader",
    "pillow",
    "OpenEXR",
    "onnxruntime",
    "typer",
)
CLIENT_PACKAGES = ("av",)
WINDOW_PACKAGES = ("glfw",)
PYRENDER_PACKAGES = ("pyrender", "trimesh", "PyOpenGL")

SYSTEM_LIBRARIES = {"EGL": "libegl1", "GL": "libgl1"}
"""Libraries that are loaded by name, and Debian packages that contain them."""

PROBE_TIMEOUT_S = 60.0
SHADERS_TIMEOUT_S = 180.0
"""A software renderer compiles the shaders on the CPU."""

FRAME_ERROR_MAX = 2e-3
"""Largest change of a pixel by a perfect eye; the step of a half float is 1e-3."""

CHECKOUT = Path(__file__).resolve().parents[2]
IN_CHECKOUT = (CHECKOUT / "setup.sh").is_file()

FIX_SETUP = "make demo, or sh setup.sh"
FIX_WHEEL = "pip install --force-reinstall --no-deps ocufilter-*.whl"
APT_INSTALL = "sudo apt-get update && sudo apt-get install -y"
FIX_DRIVER = "update the graphics driver"
FIX_WEIGHTS = "git checkout -- estimator/networks/weights" if IN_CHECKOUT else FIX_WHEEL
FIX_SHADERS = "git checkout -- shaders" if IN_CHECKOUT else FIX_WHEEL
FIX_COMPILER = f"{APT_INSTALL} gcc libc6-dev, then " + (
    FIX_SETUP if IN_CHECKOUT else "pip install --force-reinstall --no-deps ocufilter"
)
FIX_MESA = f"{APT_INSTALL} libgl1-mesa-dri"


@dataclass(frozen=True)
class Check:
    """Result of a check: whether it passed, what was found, and how to fix it."""

    name: str
    ok: bool
    detail: str
    fix: str = ""


def examine() -> dict[str, Any]:
    """Run every check once.

    Returns
    -------
    report : dict
        JSON-compatible, with the keys ``ok`` (whether the service can run), ``works``
        (by purpose), ``checks``, ``install`` (commands), ``machine``, ``gl`` (with the
        EGL ``devices``), ``native`` (the compiled loops), ``networks`` (each with the
        size of its weights and its expected error), ``packages`` (versions) and
        ``version`` (of ocufilter).
    """
    gl = run_probe("gl")
    shaders = {} if "error" in gl else run_probe("shaders", SHADERS_TIMEOUT_S)
    native = run_probe("native")
    networks = run_probe("networks")
    packages = package_versions()
    checks = [
        check_python(),
        check_packages("service packages", SERVICE_PACKAGES, packages),
        *check_libraries(),
        check_gl(gl),
        check_compute(gl),
        check_shaders(gl, shaders),
        check_native(native),
        check_engine(gl, native),
        check_networks(networks),
        check_packages("client packages", CLIENT_PACKAGES, packages),
        check_packages("window packages", WINDOW_PACKAGES, packages),
        check_packages("pyrender packages", PYRENDER_PACKAGES, packages),
        check_display(),
        check_layer(),
    ]
    works = what_works({check.name: check.ok for check in checks})
    return {
        "ok": works["serve"],
        "works": works,
        "checks": [asdict(check) for check in checks],
        "install": install_commands(checks),
        "machine": machine(),
        "gl": gl.get("info", {})
        | {"limits": gl.get("limits", {}), "devices": gl_devices()},
        "native": native.get("name"),
        "networks": networks.get("cards", {}),
        "packages": packages,
        "version": __version__,
    }


def gl_devices() -> list[dict[str, Any]]:
    """Return the EGL devices, each with its ``renderer`` or ``error``.

    Each device is probed in a separate process, which a broken driver may crash.
    """
    devices = run_probe("devices").get("devices", [])
    for device in devices:
        found = run_probe("gl", gl_device=str(device["index"]))
        device["renderer"] = found.get("info", {}).get("renderer")
        device["error"] = found.get("error")
    return devices


def run_probe(
    name: str, timeout_s: float = PROBE_TIMEOUT_S, *, gl_device: str = ""
) -> dict[str, Any]:
    """Run a probe in a separate process; on failure, return the ``error``."""
    command = [sys.executable, "-m", "clients.commands.doctor_probes", name]
    try:
        finished = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env=os.environ | ({GL_DEVICE_VARIABLE: gl_device} if gl_device else {}),
        )
    except subprocess.TimeoutExpired:
        return {"error": f"no result within {timeout_s:g} s"}
    if finished.returncode == 0:
        return json.loads(finished.stdout.splitlines()[-1])
    if finished.returncode < 0:
        return {"error": f"ended by signal {-finished.returncode}"}
    last_lines = finished.stderr.strip().splitlines()[-1:]
    return {"error": last_lines[0] if last_lines else "ended without output"}


def machine() -> dict[str, Any]:
    """Return the processor, the system and the Python version."""
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
    """Return the model name reported by the kernel, otherwise the architecture."""
    file = Path("/proc/cpuinfo")
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1] if found else platform.machine()


def package_versions() -> dict[str, str | None]:
    """Return the version of each package that ocufilter may use; None if missing."""
    versions: dict[str, str | None] = {}
    names = SERVICE_PACKAGES + CLIENT_PACKAGES + WINDOW_PACKAGES + PYRENDER_PACKAGES
    for name in names:
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
    """Check that all packages for one purpose are installed."""
    missing = [package for package in wanted if versions[package] is None]
    if missing:
        return Check(
            name, False, "missing: " + ", ".join(missing), install_command(missing)
        )
    return Check(name, True, ", ".join(f"{p} {versions[p]}" for p in wanted))


def install_command(missing: list[str]) -> str:
    """Return the command that installs packages; in a checkout, it installs all."""
    if IN_CHECKOUT:
        return FIX_SETUP
    return f"pip install {' '.join(missing)}"


def check_libraries() -> list[Check]:
    """Find the system libraries that Python packages load by name."""
    checks = []
    for library, package in SYSTEM_LIBRARIES.items():
        found = ctypes.util.find_library(library)
        fix = "" if found else f"{APT_INSTALL} {package}"
        checks.append(Check(f"lib{library}", bool(found), found or "not found", fix))
    return checks


def check_gl(gl: dict[str, Any]) -> Check:
    """Report whether there is an OpenGL context without a display."""
    if "error" in gl:
        return Check("gl", False, gl["error"], FIX_MESA)
    info = gl["info"]
    return Check("gl", True, f"{info['renderer']}; OpenGL {info['version']}")


def check_compute(gl: dict[str, Any]) -> Check:
    """Report whether a compute shader ran and returned the right result."""
    if "error" in gl:
        return Check("compute", False, "not run: no OpenGL context")
    ok = gl["compute_correct"] and gl["gl_error"] == "GL_NO_ERROR"
    detail = "right result" if ok else f"wrong result ({gl['gl_error']})"
    return Check("compute", ok, detail, "" if ok else FIX_DRIVER)


def check_shaders(gl: dict[str, Any], shaders: dict[str, Any]) -> Check:
    """Report whether the rendering passes compile and return the right image."""
    if "error" in gl:
        return Check("shaders", False, "not run: no OpenGL context")
    if "error" in shaders:
        is_missing = "does not exist" in shaders["error"]
        fix = FIX_SHADERS if is_missing else FIX_DRIVER
        return Check("shaders", False, shaders["error"], fix)
    frame_error = shaders["frame_error"]
    detail = (
        f"{shaders['program_count']} programs compiled and run; "
        f"a perfect eye changes an image by {frame_error:.1g}"
    )
    ok = frame_error <= FRAME_ERROR_MAX
    return Check("shaders", ok, detail, "" if ok else FIX_DRIVER)


def check_native(native: dict[str, Any]) -> Check:
    """Report whether the compiled loops exist and return the right image."""
    if "error" in native:
        return Check("native", False, native["error"], FIX_COMPILER)
    change = native["frame_error"]
    detail = f"{native['name']}; a perfect eye changes an image by {change:.1g}"
    ok = change <= FRAME_ERROR_MAX
    return Check("native", ok, detail, "" if ok else FIX_COMPILER)


def check_engine(gl: dict[str, Any], native: dict[str, Any]) -> Check:
    """Report which engine filters frames by default, and why."""
    renderer = gl.get("info", {}).get("renderer", "")
    if is_device_selected():
        fix = "" if renderer else f"unset {GL_DEVICE_VARIABLE}"
        detail = f"gl: {GL_DEVICE_VARIABLE} selects its device"
        return Check("engine", bool(renderer), detail, fix)
    if renderer and not is_software_renderer(renderer):
        return Check("engine", True, f"gl: {renderer} is a hardware GPU")
    reason = f"{renderer} is a software renderer" if renderer else "no OpenGL"
    if "error" in native:
        return Check("engine", False, "none: no compiled libraries", FIX_COMPILER)
    return Check("engine", True, f"native: {reason}")


def check_networks(networks: dict[str, Any]) -> Check:
    """Report the trained networks; without them, all wavefronts are ray-traced."""
    if "error" in networks:
        fix = install_command(["onnxruntime"])
        return Check("networks", False, networks["error"], fix)
    if networks["missing"]:
        detail = "; ".join(networks["missing"].values())
        return Check("networks", False, detail, FIX_WEIGHTS)
    found = networks["cards"].items()
    detail = ", ".join(f"{name} {card['expected_error']}" for name, card in found)
    return Check("networks", True, detail)


def check_display() -> Check:
    """Find a display; only the live window requires one."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if display:
        return Check("display", True, display)
    if shutil.which("Xvfb"):
        return Check("display", False, "no display; Xvfb can provide a virtual one")
    return Check("display", False, "no display", f"{APT_INSTALL} xvfb")


def check_layer() -> Check:
    """Report whether the OpenXR layer was built."""
    from clients.openxr_layer.program import NoLayer, library

    try:
        return Check("layer", True, f"for OpenGL and Vulkan: {library()}")
    except NoLayer as error:
        return Check("layer", False, str(error))


def what_works(ok: dict[str, bool]) -> dict[str, bool]:
    """Return for each purpose whether it works, from the checks that it requires."""
    filters = ok["python"] and ok["service packages"] and ok["native"]
    demo = filters and ok["gl"]  # which renders its scenes
    return {
        "psf": filters,
        "filter": filters,
        "serve": filters,
        "demo": demo,
        "pyrender": filters and ok["pyrender packages"] and ok["gl"],
        "window": demo and ok["window packages"] and ok["display"],
        "layer": filters and ok["layer"],
    }


def install_commands(checks: list[Check]) -> list[str]:
    """Return the fixes of the checks that failed, each once."""
    return list(dict.fromkeys(c.fix for c in checks if not c.ok and c.fix))


def doctor(json_output: Json = False) -> None:
    """Check whether this machine has everything that ocufilter requires.

    Prints how to install what is missing.  The exit code is 0 if the service can run
    here and 1 if it cannot.

    ocufilter doctor --json
    """
    report = examine()
    if json_output:
        print_json(report)
    else:
        _print_diagnosis(report)
    if not report["ok"]:
        fails = ", ".join(name for name, ok in report["works"].items() if not ok)
        raise CommandFailed(f"the service cannot run here; failed: {fails}")


def _print_diagnosis(report: dict[str, Any]) -> None:
    machine = report["machine"]
    print_line(
        f"ocufilter {report['version']}, {machine['system']}, "
        f"{machine['processor']}, {machine['n_cores']} cores"
    )
    for check in report["checks"]:
        print_line(
            f"  {'ok ' if check['ok'] else 'NO '} {check['name']}: {check['detail']}"
        )
    for name, value in report["gl"]["limits"].items():
        print_line(f"      {name}: {value}")
    for device in report["gl"]["devices"]:
        found = device["renderer"] or f"no context: {device['error']}"
        print_line(f"      EGL device {device['index']} ({device['name']}): {found}")
    works = [name for name, ok in report["works"].items() if ok]
    fails = [name for name, ok in report["works"].items() if not ok]
    print_line("works here: " + (", ".join(works) or "nothing"))
    if fails:
        print_line("does not work here: " + ", ".join(fails))
    for command in report["install"]:
        print_line(f"install: {command}")
