from .gpu import Gpu as Gpu
from .shader_source import load_shader as load_shader
