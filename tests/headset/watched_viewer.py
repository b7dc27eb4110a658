"""`ocufilter headset` as it is, with a line of JSON for each frame that it shows.

    python -m tests.headset.watched_viewer --scene room.glb --frames 300

Its arguments are the command's, with `--json`.  Each line is a JSON object:
``{"session": ...}`` when a session begins, ``{"frame": ...}`` with the views that the
runtime requested and the views that the viewer showed, and at the end the report that
`ocufilter headset --json` prints.  The command's messages go to stderr.
"""

import json
import sys

import moderngl

from clients.commands import program
from clients.headset import openxr_runtime
from clients.scenes.scene_view import read_texture


def tell(**what) -> None:
    print(json.dumps(what), flush=True)


class WatchedRuntime(openxr_runtime.OpenXrRuntime):
    """Tells of every frame."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        tell(session={"size_px": self.size_px, "has_depth": self.has_depth})

    def end_frame(self, due, shown):
        super().end_frame(due, shown)
        tell(
            frame={
                "state": self.state,
                "asked": [as_json(view) for view in due.views],
                "shown": [as_json(view.view) for view in shown],
                # of the middle row, which tells how sharp it is
                "rows": [self.middle_row(view.color) for view in shown],
            }
        )

    def middle_row(self, color):
        """Return the green channel of an array or a texture."""
        if isinstance(color, moderngl.Texture):
            with self._context:
                color = read_texture(color)
        return color[len(color) // 2, :, 1].tolist()


def as_json(view):
    return {"eye": view.eye, "pose": view.pose, "tangents": view.tangents}


def main() -> None:
    openxr_runtime.OpenXrRuntime = WatchedRuntime
    sys.argv[1:] = ["headset", *sys.argv[1:], "--json"]
    program.main()


if __name__ == "__main__":
    main()
