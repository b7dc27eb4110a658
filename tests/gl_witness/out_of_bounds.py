"""A deliberate fault: a pass that writes beyond its buffer, for `layers.py`.

python -m tests.gl_witness.out_of_bounds
"""

import numpy as np

from filter_service.gl.gpu import Gpu

BEYOND = """#version 430 core
layout(local_size_x = 64) in;
layout(std430, binding = 0) buffer Words { uint words[]; };
uniform uint shift;
void main() { words[gl_GlobalInvocationID.x + shift] = 1u; }
"""

if __name__ == "__main__":
    gpu = Gpu()
    program = gpu.context.compute_shader(BEYOND)
    gpu.upload("WORDS", np.zeros(64, np.uint32)).bind_to_storage_buffer(0)
    program["shift"].value = 1 << 16
    program.run(1)
    gpu.context.finish()
