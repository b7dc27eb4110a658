"""What this machine has: processor, GPU, driver, libraries.  Prints one JSON object.

    python -m tests.gpu_kit.machine

``shares``: which extensions for memory of other processes OpenGL and EGL have.  Exits
with 1 where there is no OpenGL context.
"""

import ctypes
import importlib.util
import json
import sys

from filter_service.errors import RenderFailed
from filter_service.gl.gpu import Gpu
from tests.benchmarks.harness import machine_info, nvidia_smi

SHARING = {
    "memory": "GL_EXT_memory_object_fd",
    "semaphores": "GL_EXT_semaphore_fd",
    "dma-buf import": "EGL_EXT_image_dma_buf_import",
    "dma-buf export": "EGL_MESA_image_dma_buf_export",
    "fences": "EGL_ANDROID_native_fence_sync",
}
EGL_EXTENSIONS = 0x3055


def torch_version() -> str:
    """Version of torch, and whether it has a GPU; empty without torch."""
    if importlib.util.find_spec("torch") is None:
        return ""
    import torch

    return f"{torch.__version__}{', CUDA' * torch.cuda.is_available()}"


def egl_extensions() -> list[str]:
    """Extensions of the display of the current context."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetCurrentDisplay.restype = ctypes.c_void_p
    egl.eglQueryString.argtypes = (ctypes.c_void_p, ctypes.c_int)
    egl.eglQueryString.restype = ctypes.c_char_p
    told = egl.eglQueryString(egl.eglGetCurrentDisplay(), EGL_EXTENSIONS)
    return (told or b"").decode().split()


def gl_info() -> dict:
    """What OpenGL says of itself."""
    try:
        gpu = Gpu()
    except RenderFailed as error:
        return {"gl_renderer": "", "gl_error": str(error)}
    info, is_software = gpu.info, gpu.is_software
    with gpu.entered():
        extensions = {*gpu.context.extensions, *egl_extensions()}
    gpu.close()
    return {
        "gl_renderer": info["renderer"],
        "gl_version": info["version"],
        "is_software": is_software,
        "shares": ", ".join(
            f"{what} {'yes' if name in extensions else 'no'}"
            for what, name in SHARING.items()
        ),
    }


def main() -> int:
    """Print; the exit code."""
    found = {
        **machine_info(),
        "device": nvidia_smi("name,memory.total,driver_version"),
        "torch": torch_version(),
    }
    found |= gl_info()
    print(json.dumps(found))
    if "gl_error" in found:
        print(found["gl_error"], file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
