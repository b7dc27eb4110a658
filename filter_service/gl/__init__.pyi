from .gpu import Gpu as Gpu
from .passes import load_shader as load_shader
