"""Probes that `ocufilter doctor` runs, each in a separate process.

A broken driver may crash or hang instead of raising, which then ends only the probe.
Each probe prints one line of JSON.

    python -m clients.commands.doctor_probes NAME

The names are the keys of `PROBES`.
"""

import json
import sys
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from filter_service.errors import FilterError

if TYPE_CHECKING:
    from filter_service.rendering.engine import FrameEngine

PROBE_COUNT = 1000
"""Number of values that the compute shader processes."""

LIMITS = (
    "GL_MAX_SHADER_STORAGE_BLOCK_SIZE",
    "GL_MAX_COMPUTE_SHADER_STORAGE_BLOCKS",
    "GL_MAX_SHADER_STORAGE_BUFFER_BINDINGS",
    "GL_MAX_COMPUTE_WORK_GROUP_INVOCATIONS",
    "GL_MAX_COMPUTE_WORK_GROUP_COUNT",
    "GL_MAX_TEXTURE_SIZE",
)
"""Limits that bound frame and PSF sizes."""

PROBE_SHADER = """
#version 430
layout(local_size_x = 64) in;
layout(std430, binding = 0) buffer Values { uint values[]; };
void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < uint(values.length())) values[i] = values[i] * values[i] + 1u;
}
"""


def probe_gl() -> dict[str, Any]:
    """Open a context, run a compute shader and check its result."""
    from filter_service.gl.gpu import Gpu

    gpu = Gpu()
    before = np.arange(PROBE_COUNT, dtype=np.uint32)
    buffer = gpu.context.buffer(before.tobytes())
    buffer.bind_to_storage_buffer(0)
    gpu.context.compute_shader(PROBE_SHADER).run(group_x=-(-PROBE_COUNT // 64))
    after = np.frombuffer(buffer.read(), dtype=np.uint32)
    buffer.release()
    info = gpu.context.info
    return {
        "info": {
            key: gpu.info[key] for key in ("renderer", "version", "vendor", "device")
        },
        "limits": {key: info[key] for key in LIMITS},
        "compute_correct": bool((after == before * before + 1).all()),
        "gl_error": gpu.context.error,
    }


def probe_devices() -> dict[str, Any]:
    """List the EGL devices; `probe_gl` checks whether they work."""
    from filter_service.gl.choose_device import egl_devices

    return {
        "devices": [
            {
                "index": device.index,
                "name": device.name,
                "is_software": device.is_software,
                "extensions": list(device.extensions),
            }
            for device in egl_devices()
        ]
    }


def probe_shaders() -> dict[str, Any]:
    """Compile and run the passes; a perfect eye must leave a frame unchanged."""
    from filter_service.gl.gpu import Gpu
    from filter_service.rendering.gl.renderer import FilterRenderer, compile_passes

    gpu = Gpu()
    try:
        change = compile_passes(FilterRenderer(gpu))
    except FilterError as error:  # compiler messages have many lines
        return {"error": " ".join(str(error).split())}
    else:
        return {"program_count": len(gpu.passes.programs), "frame_error": change}
    finally:
        gpu.close()


def probe_native() -> dict[str, Any]:
    """Filter a perfect eye's frames with the compiled loops."""
    from filter_service.rendering.native import NativeRenderer
    from filter_service.rendering.perfect_eye import change_by_perfect_eye

    try:
        renderer = NativeRenderer()
    except FilterError as error:
        return {"error": str(error)}
    return {
        "name": renderer.name,
        "frame_error": change_by_perfect_eye(cast("FrameEngine", renderer)),
    }


def probe_networks() -> dict[str, Any]:
    """Load every trained network and evaluate it once."""
    from estimator.networks.inference import (
        NETWORK_NAMES,
        NetworkUnavailable,
        load_network,
    )

    cards, missing = {}, {}
    for name in NETWORK_NAMES:
        try:
            network = load_network(name)
        except NetworkUnavailable as error:
            missing[name] = str(error)
            continue
        middle = 0.5 * (network.card.low + network.card.high)
        if not np.all(np.isfinite(network(middle[None]))):
            missing[name] = f"{name}.onnx returns numbers that are not finite"
            continue
        cards[name] = {
            "n_parameters": network.card.n_parameters,
            "precision": network.card.precision,
            "commit": network.card.commit,
            "expected_error": str(network.card.error),
        }
    return {"cards": cards, "missing": missing}


PROBES = {
    "gl": probe_gl,
    "devices": probe_devices,
    "shaders": probe_shaders,
    "native": probe_native,
    "networks": probe_networks,
}

if __name__ == "__main__":
    sys.stdout.write(json.dumps(PROBES[sys.argv[1]](), default=str) + "\n")
