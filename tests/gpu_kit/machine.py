"""What this machine has: processor, GPU, driver, libraries.  Prints one JSON object.

    python -m tests.gpu_kit.machine

Exits with 1 where there is no OpenGL context.
"""

import importlib.util
import json
import sys

from filter_service.errors import RenderFailed
from filter_service.gl.gpu import Gpu
from tests.benchmarks.harness import machine_info, nvidia_smi


def torch_version() -> str:
    """Version of torch, and whether it has a GPU; empty without torch."""
    if importlib.util.find_spec("torch") is None:
        return ""
    import torch

    return f"{torch.__version__}{', CUDA' * torch.cuda.is_available()}"


def gl_info() -> dict:
    """What OpenGL says of itself."""
    try:
        gpu = Gpu()
    except RenderFailed as error:
        return {"gl_renderer": "", "gl_error": str(error)}
    info, is_software = gpu.info, gpu.is_software
    gpu.close()
    return {
        "gl_renderer": info["renderer"],
        "gl_version": info["version"],
        "is_software": is_software,
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
