"""Fields of the presets before and after: the eye model's own, and people's."""

from pathlib import Path

import numpy as np

from estimator.field.field_table import field_table
from estimator.profiles.parse import parse_profile, preset_names
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.settings import FilterSettings
from tests.numerical.scene_frames import scene_view

H_DEG, V_DEG = np.linspace(-40.0, 40.0, 33), np.linspace(-24.0, 24.0, 19)
PERIPHERIES = ("model", "people")
MAPS = {
    # of a table: name, values, range
    "M, dpt": (lambda t: t.power_dpt[:, 0] - t.power_dpt[CENTRE, 0], 3.0),
    "J0, dpt": (lambda t: t.power_dpt[:, 1] - t.power_dpt[CENTRE, 1], 3.0),
    "coma x, µm": (lambda t: t.zernike_um[:, 8] - t.zernike_um[CENTRE, 8], 0.6),
}
CENTRE = H_DEG.size * V_DEG.size // 2
SCENE = {"width_px": 320, "height_px": 180}
STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}


def plot_fields(file: Path) -> None:
    """Draw changes from the axis, three maps twice for each preset."""
    from matplotlib.figure import Figure

    names = preset_names()
    figure = Figure(figsize=(15.0, 2.1 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 2 * len(MAPS), sharex=True, sharey=True)
    h_deg, v_deg = (values.ravel() for values in np.meshgrid(H_DEG, V_DEG))
    for line, name in zip(panels, names, strict=True):
        for k, periphery in enumerate(PERIPHERIES):
            profile = parse_profile(
                {"kind": "preset", "name": name, "periphery": periphery}
            )
            table = field_table(
                profile,
                h_deg=h_deg,
                v_deg=v_deg,
                pupil_diameter_mm=4.0,
                wavelength_nm=555.0,
            )
            for m, (title, (values, limit)) in enumerate(MAPS.items()):
                axes = line[2 * m + k]
                grid = values(table).reshape(V_DEG.size, H_DEG.size)
                drawn = axes.contourf(
                    H_DEG,
                    V_DEG,
                    np.clip(grid, -limit, limit),
                    levels=np.linspace(-limit, limit, 25),
                    cmap="RdBu_r",
                )
                axes.set_title(f"{name}, {title}, {periphery}", fontsize=7)
                if name == names[-1]:
                    figure.colorbar(drawn, ax=panels[:, 2 * m + k], shrink=0.4)
    figure.suptitle("Change from the axis, 4 mm, 555 nm; h and v in degrees")
    figure.savefig(file, dpi=70)


def show_scene(file: Path) -> None:
    """Write the demo's scene through each preset, the model's periphery above."""
    from PIL import Image

    view = scene_view("courtyard", **SCENE)
    rows = []
    for periphery in PERIPHERIES:
        seen = []
        for name in preset_names():
            profile = {"kind": "preset", "name": name, "periphery": periphery}
            settings = FilterSettings(mode="dynamic")
            with EyeFilter(
                {**profile, "straylight": None}, view.camera, settings
            ) as eye_filter:
                eye_filter.wait()
                seen.append(eye_filter.filter(view, **STATE).color)
        rows.append(np.concatenate(seen, axis=1))
    Image.fromarray(np.concatenate(rows)).save(file, quality=85)
