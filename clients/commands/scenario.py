"""`ocufilter scenario`: list scenarios, or write the pictures of one."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clients.commands.options import read_size_px
from filter_service.command_line import Json, check_range, print_json, print_line
from filter_service.progress import Progress

if TYPE_CHECKING:
    from clients.scenarios import Scenario
    from filter_service import Filtered

PICTURES = ("scene.png", "a.png", "b.png")
MAP = "defocus.png"
SIDE_LIMITS_PX = (16, 4096)
MAP_DPI = 120


def scenario(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="A scenario; without one, all are listed."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="DIR", help="Output folder; by default NAME."
        ),
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of the pictures in px.")
    ] = "960x540",
    defocus_map: Annotated[
        bool,
        typer.Option(
            "--defocus-map", help="Write maps of defocus over the visual field as well."
        ),
    ] = False,
    json_output: Json = False,
) -> None:
    """List scenarios, or write what a person sees in both states of one.

    ocufilter scenario

    ocufilter scenario night_driving -o night

    A scenario has two states of one person, such as before and after surgery, in a
    scene at a distance, a light and a pupil.  The command writes scene.png, a.png and
    b.png.
    """
    from clients.scenarios import scenario_named, scenarios

    if name is None:
        _print_list([*scenarios().values()], json_output=json_output)
        return
    chosen = scenario_named(name)
    size_px = read_size_px(size)
    for side_px in size_px:
        check_range("--size", side_px, SIDE_LIMITS_PX)
    folder = Path(name) if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    notes = _write(chosen, folder, size_px, with_map=defocus_map, quiet=json_output)
    written = [*PICTURES, *([MAP] if defocus_map else [])]
    if json_output:
        paths = [str(folder / each) for each in written]
        print_json(_described(chosen) | {"pictures": paths, "notes": notes})
        return
    print_line(chosen.title)
    print_line(chosen.sees)
    print_line(chosen.leaves_out)
    for side, state in (("a.png", chosen.a), ("b.png", chosen.b)):
        print_line(f"{folder / side}: {state.title}")


def _print_list(found: "list[Scenario]", *, json_output: bool) -> None:
    if json_output:
        print_json({"scenarios": [_described(each) for each in found]})
        return
    width = max(len(each.name) for each in found)
    for each in found:
        print_line(f"{each.name:{width}}  {each.title}")


def _described(chosen: "Scenario") -> dict[str, Any]:
    """Return a scenario as JSON values."""
    plain = {k: v for k, v in vars(chosen).items() if k not in ("a", "b")}
    states = {
        side: {"title": state.title, "profile": dict(state.profile)}
        for side, state in (("a", chosen.a), ("b", chosen.b))
    }
    return {
        **plain,
        "focus_dpt": chosen.focus_dpt,
        "differing_entries": list(chosen.differing_entries),
        **states,
    }


def _write(
    chosen: "Scenario",
    folder: Path,
    size_px: tuple[int, int],
    *,
    with_map: bool,
    quiet: bool,
) -> dict[str, list[str]]:
    """Write the pictures; return the notes on each state."""
    from clients.provenance import code_version, picture_metadata, profile_identity
    from clients.scenarios import filtered_states, scenario_view
    from clients.scenes.appearance import uint8_srgb
    from filter_service.atomic_files import replace_atomically
    from filter_service.image_files import write_image

    with Progress("scenario", quiet=quiet) as progress:
        progress.task("Rendering the scene")
        view = scenario_view(chosen, size_px)
        progress.task("Filtering")
        seen = filtered_states(chosen, view)
    is_hdr = view.color.dtype != "uint8"
    scene = uint8_srgb(view.color.astype(float)) if is_hdr else view.color
    images: dict[str, tuple[Any, dict[str, str]]] = {"scene.png": (scene, {})}
    for side, state, filtered in zip(
        ("a", "b"), (chosen.a, chosen.b), seen, strict=True
    ):
        metadata = picture_metadata(
            code_version(),
            profile_identity(f"{chosen.name}_{side}", state.profile),
            pupil_diameter_mm=filtered.pupil_diameter_mm,
            focus_dpt=filtered.focus_dpt,
            more={"scenario": chosen.name},
        )
        images[f"{side}.png"] = filtered.color, metadata
    for file, (image, metadata) in images.items():
        write = partial(write_image, image=image, metadata=metadata)
        replace_atomically(folder / file, write)
    if with_map:
        _write_map(chosen, folder / MAP)
    return {"a": _notes(seen[0]), "b": _notes(seen[1])}


def _notes(filtered: "Filtered") -> list[str]:
    return [str(note) for note in filtered.notes]


def _write_map(chosen: "Scenario", path: Path) -> None:
    from clients.figures.defocus import defocus_maps_figure
    from estimator import parse_profile
    from filter_service.atomic_files import replace_atomically

    figure = defocus_maps_figure(
        {
            each.title: parse_profile(dict(each.profile))
            for each in (chosen.a, chosen.b)
        },
        pupil_diameter_mm=chosen.pupil_diameter_mm,
        focus_dpt=chosen.focus_dpt,
    )
    replace_atomically(
        path, lambda part: figure.savefig(part, format="png", dpi=MAP_DPI)
    )
