"""A small OpenXR program: two colored views with depth, and a line for all it sees.

    python tests/headset/probe.py --frames 60

Each line on standard output is a JSON object: ``runtime`` and ``size_px`` of a view;
``state`` of the session; ``frame`` with the poses (x, y, z in m; quaternion x, y, z, w)
and the angles in degrees (left, right, up, down) of the views in the stage; and at the
end ``frames``, how many were taken, or ``error``, what was raised.

Each view is filled with the color of its eye, at `FAR_M`; its upper left quarter is
white, at `NEAR_M`.  With ``--fault`` it does one thing wrong.
"""

import argparse
import ctypes
import json
import math
import time
from ctypes import POINTER, byref, c_char_p, c_int, c_uint, c_void_p, cast, pointer

import moderngl
import xr  # forces PyOpenGL to GLX: OpenGL goes through moderngl and ctypes here

EXTENSIONS = (
    "XR_KHR_opengl_enable",  # swapchain images are OpenGL's textures
    "XR_MNDX_egl_enable",  # the context is one of EGL
    "XR_KHR_composition_layer_depth",
)
VALIDATION = "XR_APILAYER_LUNARG_core_validation"
STEREO = xr.ViewConfigurationType.PRIMARY_STEREO

EYE_SRGB = ((200, 40, 30), (20, 60, 180))
PATCH_SRGB = (255, 255, 255)
NEAR_M, FAR_M = 0.5, 2.0
PLANES_M = (0.1, 100.0)

POLL_S = 0.01

GL_FRAMEBUFFER, GL_TEXTURE_2D = 0x8D40, 0x0DE1
GL_COLOR_ATTACHMENT0, GL_DEPTH_ATTACHMENT = 0x8CE0, 0x8D00
GL_SRGB8_ALPHA8, GL_DEPTH_COMPONENT32F = 0x8C43, 0x8CAC
EGL_CONFIG_ID, EGL_NONE = 0x3028, 0x3038

EGL = ctypes.CDLL("libEGL.so.1")
EGL.eglGetCurrentDisplay.restype = c_void_p
EGL.eglGetCurrentContext.restype = c_void_p
EGL.eglQueryContext.argtypes = (c_void_p, c_void_p, c_int, POINTER(c_int))
EGL.eglChooseConfig.argtypes = (
    *(c_void_p, POINTER(c_int), POINTER(c_void_p)),
    *(c_int, POINTER(c_int)),
)
EGL.eglGetProcAddress.argtypes = (c_char_p,)
EGL.eglGetProcAddress.restype = c_void_p


def tell(**what) -> None:
    """Write one line."""
    print(json.dumps(what), flush=True)


def gl_function(name: str, *types):
    """Return a function of OpenGL that moderngl has no name for."""
    return ctypes.CFUNCTYPE(None, *types)(EGL.eglGetProcAddress(name.encode()))


def window_depth(z_m: float) -> float:
    """Return what a depth buffer between `PLANES_M` holds at a planar depth."""
    near_m, far_m = PLANES_M
    return far_m * (z_m - near_m) / (z_m * (far_m - near_m))


# --- the runtime ----------------------------------------------------------------


def new_instance() -> xr.Instance:
    """Connect to the runtime, with the validation layer between."""
    return xr.create_instance(
        xr.InstanceCreateInfo(
            application_info=xr.ApplicationInfo(application_name="probe"),
            enabled_extension_names=list(EXTENSIONS),
            enabled_api_layer_names=[VALIDATION],
        )
    )


def graphics_binding() -> xr.GraphicsBindingEGLMNDX:
    """Return the current context of EGL, as the runtime wants it told."""
    display, context = EGL.eglGetCurrentDisplay(), EGL.eglGetCurrentContext()
    number, config, count = c_int(), c_void_p(), c_int()
    EGL.eglQueryContext(display, context, EGL_CONFIG_ID, byref(number))
    wanted = (c_int * 3)(EGL_CONFIG_ID, number.value, EGL_NONE)
    EGL.eglChooseConfig(display, wanted, byref(config), 1, byref(count))
    kinds = dict(xr.GraphicsBindingEGLMNDX._fields_)  # PyOpenGL's pointers
    return xr.GraphicsBindingEGLMNDX(
        get_proc_address=cast(EGL.eglGetProcAddress, kinds["get_proc_address"]),
        display=cast(display, kinds["display"]),
        config=cast(config, kinds["config"]),
        context=cast(context, kinds["context"]),
    )


def new_session(instance: xr.Instance, system: xr.SystemId) -> xr.Session:
    """Open a session that draws with the current context."""
    ask = cast(
        xr.get_instance_proc_addr(instance, "xrGetOpenGLGraphicsRequirementsKHR"),
        xr.PFN_xrGetOpenGLGraphicsRequirementsKHR,
    )
    ask(instance, system, byref(xr.GraphicsRequirementsOpenGLKHR()))  # it must be asked
    binding = graphics_binding()
    return xr.create_session(
        instance, xr.SessionCreateInfo(system_id=system, next=address(binding))
    )


def address(structure: ctypes.Structure) -> c_void_p:
    """Return where a structure lies, for the `next` of another one."""
    return cast(pointer(structure), c_void_p)


# --- one eye --------------------------------------------------------------------


class Swapchain:
    """Textures that the runtime shows in turn.

    Parameters
    ----------
    session : xr.Session
    format_ : int
        Of OpenGL.
    usage : xr.SwapchainUsageFlags
    size_px : (width, height)
    """

    def __init__(self, session, format_, usage, size_px):
        width_px, height_px = size_px
        self.handle = xr.create_swapchain(
            session,
            xr.SwapchainCreateInfo(
                format=format_,
                usage_flags=usage | xr.SwapchainUsageFlags.SAMPLED_BIT,
                width=width_px,
                height=height_px,
                sample_count=1,
                face_count=1,
                array_size=1,
                mip_count=1,
            ),
        )
        images = xr.enumerate_swapchain_images(self.handle, xr.SwapchainImageOpenGLKHR)
        self._textures = [image.image for image in images]
        whole = xr.Rect2Di(xr.Offset2Di(0, 0), xr.Extent2Di(width_px, height_px))
        self.sub_image = xr.SwapchainSubImage(self.handle, whole, 0)

    def __enter__(self) -> int:
        """Return the texture to draw into."""
        index = xr.acquire_swapchain_image(self.handle, xr.SwapchainImageAcquireInfo())
        xr.wait_swapchain_image(
            self.handle, xr.SwapchainImageWaitInfo(timeout=xr.INFINITE_DURATION)
        )
        return self._textures[index]

    def __exit__(self, *_) -> None:
        xr.release_swapchain_image(self.handle, xr.SwapchainImageReleaseInfo())


class Eye:
    """What one eye is shown.

    Parameters
    ----------
    context : moderngl.Context
    session : xr.Session
    size_px : (width, height)
    fill_srgb : three of 0 to 255
    planes_m : near and far plane, as the runtime is told
    """

    def __init__(self, context, session, size_px, fill_srgb, planes_m=PLANES_M):
        usages = xr.SwapchainUsageFlags
        self.color = Swapchain(
            session, GL_SRGB8_ALPHA8, usages.COLOR_ATTACHMENT_BIT, size_px
        )
        self.depth = Swapchain(
            *(session, GL_DEPTH_COMPONENT32F),
            *(usages.DEPTH_STENCIL_ATTACHMENT_BIT, size_px),
        )
        near_m, far_m = planes_m
        self._depth_info = xr.CompositionLayerDepthInfoKHR(
            sub_image=self.depth.sub_image,
            min_depth=0.0,
            max_depth=1.0,
            near_z=near_m,
            far_z=far_m,
        )
        self._context, self._size_px = context, size_px
        self._fill_srgb = fill_srgb
        self._framebuffers: dict[tuple[int, int], moderngl.Framebuffer] = {}

    def draw(self) -> None:
        """Fill the next image of both swapchains."""
        width_px, height_px = self._size_px
        upper_left = (0, height_px - height_px // 2, width_px // 2, height_px // 2)
        with self.color as color, self.depth as depth:
            framebuffer = self._framebuffer(color, depth)
            framebuffer.clear(*fractions(self._fill_srgb), depth=window_depth(FAR_M))
            framebuffer.clear(
                *fractions(PATCH_SRGB),
                depth=window_depth(NEAR_M),
                viewport=upper_left,
            )
            self._context.finish()

    def layer_view(self, view: xr.View) -> xr.CompositionLayerProjectionView:
        """Return the images as seen from a view, with their depth."""
        return xr.CompositionLayerProjectionView(
            pose=view.pose,
            fov=view.fov,
            sub_image=self.color.sub_image,
            next=address(self._depth_info),
        )

    def _framebuffer(self, color: int, depth: int) -> moderngl.Framebuffer:
        if (color, depth) not in self._framebuffers:
            name = c_uint()
            gl_function("glGenFramebuffers", c_int, POINTER(c_uint))(1, byref(name))
            gl_function("glBindFramebuffer", c_uint, c_uint)(GL_FRAMEBUFFER, name)
            attach = gl_function(
                "glFramebufferTexture2D", c_uint, c_uint, c_uint, c_uint, c_int
            )
            attach(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_TEXTURE_2D, color, 0)
            attach(GL_FRAMEBUFFER, GL_DEPTH_ATTACHMENT, GL_TEXTURE_2D, depth, 0)
            found = self._context.detect_framebuffer(name.value)
            self._framebuffers[color, depth] = found
        return self._framebuffers[color, depth]


def fractions(srgb: tuple[int, int, int]) -> list[float]:
    """Return an opaque color as shares of the largest value."""
    return [value / 255 for value in (*srgb, 255)]


# --- the program ----------------------------------------------------------------


class Probe:
    """One session, from its first state to its last.

    Parameters
    ----------
    context : moderngl.Context
        The current one.
    fault : str or None
        One of `FAULTS`.
    """

    def __init__(self, context: moderngl.Context, fault: str | None):
        self._context = context
        self._instance = new_instance()
        properties = xr.get_instance_properties(self._instance)
        kind = xr.StructureType.UNKNOWN if fault == "type" else xr.SystemGetInfo().type
        system = xr.get_system(
            self._instance,
            xr.SystemGetInfo(form_factor=xr.FormFactor.HEAD_MOUNTED_DISPLAY, type=kind),
        )
        self._session = new_session(self._instance, system)
        shape = xr.enumerate_view_configuration_views(self._instance, system, STEREO)[0]
        size_px = (
            shape.recommended_image_rect_width,
            shape.recommended_image_rect_height,
        )
        planes_m = (1.0, 1.0) if fault == "planes" else PLANES_M
        self._eyes = [
            Eye(context, self._session, size_px, fill_srgb, planes_m)
            for fill_srgb in EYE_SRGB
        ]
        self._stage = xr.create_reference_space(
            self._session,
            xr.ReferenceSpaceCreateInfo(
                reference_space_type=xr.ReferenceSpaceType.STAGE
            ),
        )
        self._running = self._ended = False
        tell(runtime=properties.runtime_name.decode(), size_px=size_px)

    def run(self, frame_count: int) -> None:
        """Show frames, then leave the session as a program should."""
        shown, leaving = 0, False
        while not self._ended:
            self._read_events()
            if not self._running:
                time.sleep(POLL_S)
                continue
            shown += self._show_frame(visible=shown < frame_count)
            if shown == frame_count and not leaving:
                xr.request_exit_session(self._session)
                leaving = True
        tell(frames=shown, gl=self._context.error)

    def close(self) -> None:
        """Give back what the runtime lent."""
        for eye in self._eyes:
            xr.destroy_swapchain(eye.color.handle)
            xr.destroy_swapchain(eye.depth.handle)
        xr.destroy_space(self._stage)
        xr.destroy_session(self._session)
        xr.destroy_instance(self._instance)

    def _read_events(self) -> None:
        while True:
            try:
                event = xr.poll_event(self._instance)
            except xr.EventUnavailable:
                return
            if event.type == xr.StructureType.EVENT_DATA_SESSION_STATE_CHANGED:
                change = cast(byref(event), POINTER(xr.EventDataSessionStateChanged))
                self._follow(xr.SessionState(change.contents.state))

    def _follow(self, state: xr.SessionState) -> None:
        tell(state=state.name)
        if state == xr.SessionState.READY:
            xr.begin_session(self._session, xr.SessionBeginInfo(STEREO))
            self._running = True
        elif state == xr.SessionState.STOPPING:
            self._running = False
            xr.end_session(self._session)
        elif state == xr.SessionState.EXITING:
            self._ended = True

    def _show_frame(self, *, visible: bool) -> int:
        """Take part in one frame; return how many were shown."""
        state = xr.wait_frame(self._session, xr.FrameWaitInfo())
        xr.begin_frame(self._session, xr.FrameBeginInfo())
        layers = []
        if visible and state.should_render:
            views = self._views(state.predicted_display_time)
            for eye in self._eyes:
                eye.draw()
            projection = xr.CompositionLayerProjection(
                space=self._stage,
                views=[
                    eye.layer_view(view)
                    for eye, view in zip(self._eyes, views, strict=True)
                ],
            )
            layers.append(byref(projection))
        xr.end_frame(
            self._session,
            xr.FrameEndInfo(
                display_time=state.predicted_display_time,
                environment_blend_mode=xr.EnvironmentBlendMode.OPAQUE,
                layers=layers,
            ),
        )
        if layers:
            tell(frame=[described(view) for view in views])
        return len(layers)

    def _views(self, display_time_ns: int) -> list[xr.View]:
        _, views = xr.locate_views(
            self._session, xr.ViewLocateInfo(STEREO, display_time_ns, self._stage)
        )
        return list(views)


def described(view: xr.View) -> dict[str, list[float]]:
    """Return where a view is and what it sees, in words of JSON."""
    place, turn, fov = view.pose.position, view.pose.orientation, view.fov
    edges = (fov.angle_left, fov.angle_right, fov.angle_up, fov.angle_down)
    return {
        "position_m": [place.x, place.y, place.z],
        "orientation": [turn.x, turn.y, turn.z, turn.w],
        "angles_deg": [math.degrees(edge) for edge in edges],
    }


FAULTS = {
    "type": "a structure says that it is another one",
    "planes": "the depth's near plane is its far plane",
}


def main() -> None:
    """Read the arguments and show frames."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--fault", choices=FAULTS)
    arguments = parser.parse_args()
    context = moderngl.create_context(standalone=True, backend="egl", require=450)
    try:
        probe = Probe(context, arguments.fault)
        probe.run(arguments.frames)
        probe.close()
    except xr.exception.XrException as error:
        tell(error=type(error).__name__)


if __name__ == "__main__":
    main()
