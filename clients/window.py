"""Live window with the scene on the left and the filtered image on the right."""

from __future__ import annotations

from typing import Any, cast

import glfw
import moderngl
import numpy as np
from numpy.typing import NDArray

_VERTEX = """
#version 430 core
out vec2 uv;
void main() {
    // One triangle that covers the viewport.
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    uv = vec2(corner.x, 1.0 - corner.y);
    gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}
"""
_FRAGMENT = """
#version 430 core
uniform sampler2D image;
in vec2 uv;
out vec4 color;
void main() { color = vec4(texture(image, uv).rgb, 1.0); }
"""


class NoDisplay(Exception):
    """No window can be opened."""


class LiveWindow:
    """A window with two images side by side.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of one image.
    title : str
        Text of the title bar.

    Raises
    ------
    NoDisplay
        If there is no display with OpenGL 4.3.

    Notes
    -----
    Scenes are rendered through EGL, and on X11 this window draws through GLX.  A thread
    cannot have a current context of each, so the window's context is current only
    during a call.
    """

    def __init__(self, size_px: tuple[int, int], title: str) -> None:
        self._errors: list[str] = []
        glfw.set_error_callback(
            lambda code, text: self._errors.append(cast(bytes, text).decode())
        )
        if not glfw.init():
            raise NoDisplay(f"no window can be opened: {self._reason()}")
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 4)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        width, height = size_px
        self._window: Any = glfw.create_window(2 * width, height, title, None, None)
        if not self._window:
            glfw.terminate()
            raise NoDisplay(f"no window can be opened: {self._reason()}")
        glfw.set_key_callback(self._window, _close_on_escape)
        glfw.make_context_current(self._window)
        self._context = moderngl.create_context()
        program = self._context.program(
            vertex_shader=_VERTEX, fragment_shader=_FRAGMENT
        )
        self._triangle = self._context.vertex_array(program, [])
        self._textures = [self._context.texture(size_px, 3) for _ in range(2)]
        for texture in self._textures:
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        glfw.make_context_current(cast(Any, None))

    def __enter__(self) -> LiveWindow:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _reason(self) -> str:
        return self._errors[-1] if self._errors else "no display"

    @property
    def is_open(self) -> bool:
        """Return whether the window is open; Esc or the close button closes it."""
        return self._window is not None and not glfw.window_should_close(self._window)

    def show(
        self,
        left: NDArray[np.uint8],
        right: NDArray[np.uint8],
        title: str | None = None,
    ) -> bool:
        """Draw two images (h, w, 3) of the window's size; return `is_open`.

        Raises
        ------
        ValueError
            If an image has another size.
        """
        glfw.make_context_current(self._window)
        try:
            width, height = glfw.get_framebuffer_size(self._window)
            for i, image in enumerate((left, right)):
                texture = self._textures[i]
                if image.shape != (texture.height, texture.width, 3):
                    raise ValueError(
                        f"image of shape {image.shape}; expected "
                        f"{(texture.height, texture.width, 3)}"
                    )
                # The size of a row of three-byte pixels need not be a multiple of four.
                texture.write(np.ascontiguousarray(image), alignment=1)
                texture.use()
                self._context.viewport = (i * width // 2, 0, width // 2, height)
                self._triangle.render(moderngl.TRIANGLES, vertices=3)
            glfw.swap_buffers(self._window)
        finally:
            glfw.make_context_current(cast(Any, None))
        if title is not None:
            glfw.set_window_title(self._window, title)
        glfw.poll_events()
        return self.is_open

    def shown(self) -> NDArray[np.uint8]:
        """Read back the content (h, 2w, 3) of the window, top row first."""
        glfw.make_context_current(self._window)
        try:
            width, height = glfw.get_framebuffer_size(self._window)
            raw = self._context.screen.read((0, 0, width, height), 3, alignment=1)
        finally:
            glfw.make_context_current(cast(Any, None))
        return np.frombuffer(raw, np.uint8).reshape(height, width, 3)[::-1]

    def close(self) -> None:
        """Close the window; closing twice is allowed."""
        if self._window is not None:
            glfw.make_context_current(self._window)
            self._context.release()
            glfw.destroy_window(self._window)
            self._window = None
            glfw.terminate()


def _close_on_escape(
    window: Any, key: int, _scancode: int, action: int, _mods: int
) -> None:
    if key == glfw.KEY_ESCAPE and action == glfw.PRESS:
        glfw.set_window_should_close(window, True)
