"""Table 6 anew: the PSF textures of the paper and of its predecessor, rebuilt.

33 distances on the axis, a pupil of 5 mm that looks at 0.5 dpt, 1280x720 over 50
degrees: how many layers each layout takes and how much memory, for every eye.  The
time is that of making the paper's layers from its PSFs and of computing those, on the
processor.

Error: none is made here.  That of pictures through these textures stands in
`bench_field`; the row holds the largest radius in px, which decides the memory.
"""

from tests.benchmarks.field_methods import EyeBench, State
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.paper_layout import BYTES_PER_TEXEL, ON_AXIS, kept_texture
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.resized_psfs import full_radius_px
from tests.benchmarks.view_sources import EyeState
from tests.numerical.scene_frames import scene_view

MINUTES = 0.2
STATE = State(5.0, 0.5)


def predecessor_row(eye: str, state: EyeState) -> Row:
    """Every PSF at every whole blur radius."""
    cut = ON_AXIS.precomputed(state)
    radius_px = full_radius_px(cut.radius_px) + 1
    layer_count = ON_AXIS.distance_dpt.size * (radius_px + 1)
    return _row("predecessor", eye, layer_count, radius_px, 0.0)


def paper_row(eye: str, state: EyeState) -> Row:
    """Layers by distance, with transitional ones between."""
    texture, build_ms = kept_texture(state, ON_AXIS)
    layer_count, _, side, _ = texture.weights.shape
    return _row("paper on-axis", eye, layer_count, side // 2, build_ms)


def _row(method: str, eye: str, layer_count: int, radius_px: int, time_ms) -> Row:
    texel_count = layer_count * (2 * radius_px + 1) ** 2
    return Row(
        *("layouts", method, eye, f"1280x720 {STATE}", layer_count),
        *(time_ms, time_ms, texel_count * BYTES_PER_TEXEL / 1e6),
        *("radius_px", float(radius_px), "none"),
    )


def measure(run: Run) -> list[Row]:
    """Return two rows for each eye, or for one."""
    view = scene_view("courtyard", width_px=1280, height_px=720)
    rows = []
    for eye in CONDITIONS[:1] if run.is_quick else CONDITIONS:
        state = EyeBench(None, eye, [view]).exact_state(STATE, on_axis=True)
        rows += [predecessor_row(eye, state), paper_row(eye, state)]
    return rows
