"""Drivers of OpenGL that the renderer is run on, each in a process of its own.

llvmpipe translates GLSL itself.  zink makes SPIR-V of it, which lavapipe runs as
Vulkan: another compiler, and OpenGL's barriers made of Vulkan's.  Both are from the
packages that `setup.sh` unpacks.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.source_tree import ROOT

FETCHED = ROOT / ".gl_witness" / "drivers"

SHADERS = ("software", "hardware")
"""The renderer's variants of the passes; the second with mapped memory, too."""


TELL_INFO = """
import json
from filter_service.gl.gpu import Gpu
print(json.dumps(Gpu().info))
"""


@dataclass(frozen=True)
class Driver:
    """A driver, and which variants of the passes the renderer takes on it."""

    name: str
    shaders: str

    def __str__(self):
        return f"{self.name}, {self.shaders} shaders"


DRIVERS = tuple(Driver(name, s) for name in ("llvmpipe", "zink") for s in SHADERS)


def libraries() -> Path:
    """Folder of the unpacked libraries."""
    (folder,) = (FETCHED / "usr" / "lib").glob("*-linux-gnu*")
    return folder


def environment(driver: Driver) -> dict[str, str]:
    """Environment of a process that draws with a driver."""
    folder = libraries()
    vendor = FETCHED / "usr" / "share" / "glvnd" / "egl_vendor.d" / "50_mesa.json"
    icd = str(FETCHED / "lavapipe.json")
    chosen = {
        "LD_LIBRARY_PATH": str(folder),
        "LIBGL_DRIVERS_PATH": str(folder / "dri"),
        "__EGL_VENDOR_LIBRARY_FILENAMES": str(vendor),
        "VK_ICD_FILENAMES": icd,
        "VK_DRIVER_FILES": icd,
        "MESA_SHADER_CACHE_DIR": str(FETCHED / "cache"),
        "LIBGL_ALWAYS_SOFTWARE": "1",
        "GALLIUM_DRIVER": driver.name,
        "GL_WITNESS_SHADERS": driver.shaders,
    }
    if driver.name == "zink":
        chosen["MESA_LOADER_DRIVER_OVERRIDE"] = "zink"
        # What this Mesa makes of uniforms that it takes for constants is wrong from a
        # program's second dispatch on (22.3: squares merge that must not).
        chosen["ZINK_INLINE_UNIFORMS"] = "0"
    return {**os.environ, **chosen}


def renderer_info(driver: Driver) -> dict[str, str]:
    """Names and version that OpenGL tells.

    Raises
    ------
    RuntimeError
        Another driver answers.
    """
    ran = subprocess.run(
        [sys.executable, "-c", TELL_INFO],
        cwd=ROOT,
        env=environment(driver),
        capture_output=True,
        text=True,
        check=True,
    )
    info = json.loads(ran.stdout)
    if not info["renderer"].startswith(driver.name):
        raise RuntimeError(f"asked for {driver.name}, found '{info['renderer']}'")
    return info
