"""OpenXR runtime: a real headset, or the one that Monado simulates.

Import this module only in a process that does not use PyOpenGL otherwise: pyopenxr
makes it use GLX.
"""

from __future__ import annotations

import ctypes
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import wraps
from typing import TYPE_CHECKING, Any

import moderngl
import xr

from clients.headset.openxr_gl import (
    EGL_ENABLE,
    GRAPHICS_VARIABLE,
    StereoImages,
    current_platform,
    offered_extensions,
    pose_of,
    tangents_of,
)
from clients.headset.runtime import (
    EYES,
    DueFrame,
    EyeView,
    GazeSample,
    NoRuntime,
    SessionEnded,
    SessionLost,
    ShownView,
    angles_of,
    matrix_of,
)

if TYPE_CHECKING:
    from filter_service.messages import Pose


_DEPTH = "XR_KHR_composition_layer_depth"
_STEREO = xr.ViewConfigurationType.PRIMARY_STEREO
_IDLE_S = 0.02
_END_S = 3.0
_TRACKED = (
    xr.ViewStateFlags.POSITION_VALID_BIT | xr.ViewStateFlags.ORIENTATION_VALID_BIT
)
_LOCATED = (
    xr.SpaceLocationFlags.POSITION_VALID_BIT
    | xr.SpaceLocationFlags.ORIENTATION_VALID_BIT
)
_WORDS = {
    xr.SessionState.FOCUSED: "the headset shows this program",
    xr.SessionState.VISIBLE: "the headset shows this program without input",
    xr.SessionState.SYNCHRONIZED: "the headset is not worn",
    xr.SessionState.STOPPING: "the headset is ending the session",
}

_REASONS: dict[type[Exception], str] = {
    xr.RuntimeUnavailableError: "no OpenXR runtime is set up here: install one, such "
    "as Monado or SteamVR, or set XR_RUNTIME_JSON to its file",
    xr.RuntimeFailureError: "the OpenXR runtime does not respond; is its service "
    "running?",
    xr.FormFactorUnavailableError: "the OpenXR runtime found no headset; is it "
    "connected and switched on?",
}

log = logging.getLogger("ocufilter.headset")


def _or_lost(method: Callable[..., Any]) -> Callable[..., Any]:
    """Convert errors of a lost OpenXR runtime to `SessionLost`."""

    @wraps(method)
    def wrapped(self: OpenXrRuntime, *arguments: Any) -> Any:
        try:
            return method(self, *arguments)
        except (xr.InstanceLostError, xr.SessionLostError, xr.SessionLossPending):
            raise SessionLost("lost the OpenXR runtime") from None
        except xr.RuntimeFailureError as error:
            raise SessionLost(f"the OpenXR runtime failed: {error}") from None
        except xr.TimeoutExpired:
            raise SessionLost("the OpenXR runtime provided no image in time") from None

    return wrapped


class OpenXrRuntime:
    """A session with the runtime that the OpenXR loader of the system finds.

    Parameters
    ----------
    context : moderngl.Context
        Context to draw in, from `openxr_gl.open_context`.
    layers : sequence of str
        OpenXR API layers to load, such as ``XR_APILAYER_LUNARG_core_validation``.
    scale : float
        Factor on the image size that the runtime recommends.

    Raises
    ------
    NoRuntime
        If no runtime is installed, or it is not running or lacks an extension.
    """

    def __init__(
        self,
        context: moderngl.Context,
        *,
        layers: Sequence[str] = (),
        scale: float = 1.0,
    ) -> None:
        self._context = context
        self._scale = scale
        self._is_running = False
        self._is_over = False
        self._ending: Exception = SessionLost("the headset's session has ended")
        self._closing = ExitStack()
        try:
            self._open(layers)
        except xr.XrException as error:
            self.close()
            raise NoRuntime(_explained(error)) from None
        except BaseException:
            self.close()
            raise

    # Opening

    def _open(self, layers: Sequence[str]) -> None:
        offered = offered_extensions()
        with self._context:
            self._platform = current_platform()
        needed = self._platform.extensions
        missing = [name for name in needed if name not in offered]
        if missing:
            words = f"the OpenXR runtime does not support {', '.join(missing)}"
            if missing == [EGL_ENABLE]:
                words += (
                    "; start it before this program, or set "
                    f"{GRAPHICS_VARIABLE}=glx, which requires an X display"
                )
            raise NoRuntime(words)
        optional = [name for name in (_DEPTH, EYE_GAZE) if name in offered]
        self._instance = xr.create_instance(
            xr.InstanceCreateInfo(
                application_info=xr.ApplicationInfo(
                    application_name="ocufilter", api_version=xr.Version(1, 0, 34)
                ),
                enabled_extension_names=[*needed, *optional],
                enabled_api_layer_names=list(layers),
            )
        )
        self._closing.callback(_quietly, xr.destroy_instance, self._instance)
        properties = xr.get_instance_properties(self._instance)
        self.name = properties.runtime_name.decode()
        self._system = xr.get_system(
            self._instance, xr.SystemGetInfo(xr.FormFactor.HEAD_MOUNTED_DISPLAY)
        )
        self.size_px = self._size()
        self._blend = self._blend_mode()
        self._session = self._new_session()
        self._closing.callback(_quietly, xr.destroy_session, self._session)
        self._room = self._space(xr.ReferenceSpaceType.LOCAL)
        self._head = self._space(xr.ReferenceSpaceType.VIEW)
        self.tracks_eyes = EYE_GAZE in optional and self._tracks_eyes()
        self._actions = Actions(
            self._instance, self._session, with_gaze=self.tracks_eyes
        )
        lost = "no eye tracker; gaze is straight ahead"
        self.notes = [] if self.tracks_eyes else [lost]
        with self._context:
            self._images = StereoImages(
                self._session,
                self._context,
                self.size_px,
                with_depth=_DEPTH in optional,
            )
        self.has_depth = self._images.has_depth
        self._closing.callback(self._release_images)

    def _size(self) -> tuple[int, int]:
        """Return the image size (width, height): as recommended, up to the maximum."""
        view = xr.enumerate_view_configuration_views(
            self._instance, self._system, _STEREO
        )[0]
        width = round(self._scale * view.recommended_image_rect_width)
        height = round(self._scale * view.recommended_image_rect_height)
        return (
            min(width, view.max_image_rect_width),
            min(height, view.max_image_rect_height),
        )

    def _blend_mode(self) -> xr.EnvironmentBlendMode:
        """Return the opaque blend mode if supported, otherwise the first one."""
        opaque = xr.EnvironmentBlendMode.OPAQUE
        offered = [
            xr.EnvironmentBlendMode(mode)
            for mode in xr.enumerate_environment_blend_modes(
                self._instance, self._system, _STEREO
            )
        ]
        return opaque if opaque in offered else offered[0]

    def _new_session(self) -> xr.Session:
        # The standard requires this call, whose result is not used.
        ask = ctypes.cast(
            xr.get_instance_proc_addr(
                self._instance, "xrGetOpenGLGraphicsRequirementsKHR"
            ),
            xr.PFN_xrGetOpenGLGraphicsRequirementsKHR,
        )
        wanted = xr.GraphicsRequirementsOpenGLKHR()
        ask(self._instance, self._system, ctypes.byref(wanted))
        with self._context:
            binding = self._platform.binding()
            info = xr.SessionCreateInfo(
                system_id=self._system,
                next=ctypes.cast(ctypes.pointer(binding), ctypes.c_void_p),
            )
            return xr.create_session(self._instance, info)

    def _space(self, kind: xr.ReferenceSpaceType) -> xr.Space:
        space = xr.create_reference_space(
            self._session, xr.ReferenceSpaceCreateInfo(reference_space_type=kind)
        )
        self._closing.callback(_quietly, xr.destroy_space, space)
        return space

    def _tracks_eyes(self) -> bool:
        eyes = xr.SystemEyeGazeInteractionPropertiesEXT()
        chained = ctypes.cast(ctypes.pointer(eyes), ctypes.c_void_p)
        properties = xr.SystemProperties(next=chained)
        raise_failure(
            xr.raw_functions.xrGetSystemProperties(
                self._instance, self._system, ctypes.byref(properties)
            )
        )
        return bool(eyes.supports_eye_gaze_interaction)

    # Frames

    @_or_lost
    def begin_frame(self) -> DueFrame | None:
        """Wait for the next frame; return None if no frame is due."""
        with self._context:
            self._take_events()
            if self._is_over:
                raise self._ending
            if not self._is_running:
                time.sleep(_IDLE_S)
                return None
            state = xr.wait_frame(self._session, xr.FrameWaitInfo())
            with suppress(
                xr.FrameDiscarded
            ):  # the frame has begun and replaces the previous one
                xr.begin_frame(self._session, xr.FrameBeginInfo())
            time_ns = int(state.predicted_display_time)
            pressed = self._actions.sync()
            views = self._views(time_ns)
            return DueFrame(
                time_ns,
                bool(state.should_render) and bool(views),
                views,
                self._head_pose(time_ns),
                self._actions.gaze(self._head, time_ns),
                pressed,
                1e-9 * int(state.predicted_display_period),
            )

    @_or_lost
    def end_frame(self, due: DueFrame, shown: Sequence[ShownView]) -> None:
        """Show a frame; show nothing if ``shown`` is empty."""
        with self._context:
            layers: list[Any] = []
            kept = None  # the layer points to it until the frame has ended
            if shown:
                layer, kept = self._images.layer(self._room, shown)
                layers = [ctypes.byref(layer)]
            info = xr.FrameEndInfo(due.display_time_ns, self._blend, layers=layers)
            xr.end_frame(self._session, info)
            del kept

    def _views(self, time_ns: int) -> tuple[EyeView, ...]:
        state, views = xr.locate_views(
            self._session, xr.ViewLocateInfo(_STEREO, time_ns, self._room)
        )
        if int(state.view_state_flags) & int(_TRACKED) != int(_TRACKED):
            return ()
        return tuple(
            EyeView(eye, pose_of(view.pose), tangents_of(view.fov))
            for eye, view in zip(EYES, views, strict=True)
        )

    def _head_pose(self, time_ns: int) -> Pose | None:
        location = xr.locate_space(self._head, self._room, time_ns)
        if int(location.location_flags) & int(_LOCATED) != int(_LOCATED):
            return None
        return pose_of(location.pose)

    # Events

    def _take_events(self) -> None:
        while True:
            try:
                event = xr.poll_event(self._instance)
            except xr.EventUnavailable:
                return
            kind = xr.StructureType(event.type)
            if kind == xr.StructureType.EVENT_DATA_INSTANCE_LOSS_PENDING:
                raise SessionLost("the OpenXR runtime is shutting down")
            if kind == xr.StructureType.EVENT_DATA_SESSION_STATE_CHANGED:
                changed = ctypes.cast(
                    ctypes.byref(event), ctypes.POINTER(xr.EventDataSessionStateChanged)
                )
                self._enter(xr.SessionState(changed.contents.state))

    def _enter(self, state: xr.SessionState) -> None:
        self.state = state.name
        if state in _WORDS:
            log.info("%s (%s)", _WORDS[state], state.name)
        if state == xr.SessionState.READY:
            xr.begin_session(self._session, xr.SessionBeginInfo(_STEREO))
            self._is_running = True
        elif state == xr.SessionState.STOPPING:
            xr.end_session(self._session)
            self._is_running = False
        elif state in (xr.SessionState.EXITING, xr.SessionState.LOSS_PENDING):
            self._is_over, self._is_running = True, False
            if state == xr.SessionState.EXITING:
                self._ending = SessionEnded("the user ended the session in the headset")

    # Closing

    def close(self) -> None:
        """End the session, if it still exists, in the order that OpenXR requires."""
        if self._is_running and not self._is_over:
            # The session may have been lost.
            with suppress(xr.XrException, SessionLost, SessionEnded):
                self._leave()
        self._is_running = False
        self._closing.close()

    def _leave(self) -> None:
        xr.request_exit_session(self._session)
        end_s = time.monotonic() + _END_S
        while not self._is_over and time.monotonic() < end_s:
            due = self.begin_frame()
            if due is not None:
                self.end_frame(due, ())

    def _release_images(self) -> None:
        with self._context:
            _quietly(self._images.release)


def _quietly(release: Callable[..., Any], *arguments: Any) -> None:
    """Release a resource that may have been lost."""
    try:
        release(*arguments)
    except xr.XrException as error:
        log.debug("%s: %s", getattr(release, "__name__", release), error)


def _explained(error: Exception) -> str:
    for kind, reason in _REASONS.items():
        if isinstance(error, kind):
            return reason
    return f"{type(error).__name__}: {error}"


# Controller buttons and eye gaze

EYE_GAZE = "XR_EXT_eye_gaze_interaction"
_BUTTONS = {
    # Paths on the simple controller, which every runtime supports.
    "next_eye": "/user/hand/right/input/select/click",
    "on_off": "/user/hand/left/input/select/click",
}
_CONTROLLER = "/interaction_profiles/khr/simple_controller"
_TRACKER = "/interaction_profiles/ext/eye_gaze_interaction"
_GAZE = "/user/eyes_ext/input/gaze_ext/pose"
_SEEN = (
    # VALID alone marks the last known pose, for example while the eyes are closed.
    xr.SpaceLocationFlags.ORIENTATION_VALID_BIT
    | xr.SpaceLocationFlags.ORIENTATION_TRACKED_BIT
)


class Actions:
    """Actions of one session, which are attached on construction.

    Parameters
    ----------
    instance, session
        OpenXR handles.
    with_gaze : bool
        Whether the system tracks eyes and the extension is enabled.
    """

    def __init__(
        self, instance: xr.Instance, session: xr.Session, *, with_gaze: bool
    ) -> None:
        self._session = session
        self._set = xr.create_action_set(
            instance, xr.ActionSetCreateInfo("viewer", "Viewer", 0)
        )
        self._buttons = {
            name: self._action(name, xr.ActionType.BOOLEAN_INPUT) for name in _BUTTONS
        }
        bound = [(self._buttons[name], path) for name, path in _BUTTONS.items()]
        _suggest(instance, _CONTROLLER, bound)
        self._gaze = self._gaze_space = None
        if with_gaze:
            self._gaze = self._action("gaze", xr.ActionType.POSE_INPUT)
            _suggest(instance, _TRACKER, [(self._gaze, _GAZE)])
        xr.attach_session_action_sets(
            session, xr.SessionActionSetsAttachInfo(action_sets=[self._set])
        )
        if self._gaze is not None:
            self._gaze_space = xr.create_action_space(
                session, xr.ActionSpaceCreateInfo(action=self._gaze)
            )

    def _action(self, name: str, kind: xr.ActionType) -> xr.Action:
        info = xr.ActionCreateInfo(
            action_name=name,
            action_type=kind,
            localized_action_name=name.replace("_", " "),
        )
        return xr.create_action(self._set, info)

    def sync(self) -> tuple[str, ...]:
        """Synchronize the actions; return the buttons pressed since the last call."""
        active = xr.ActiveActionSet(self._set, xr.NULL_PATH)
        try:
            xr.sync_actions(
                self._session, xr.ActionsSyncInfo(active_action_sets=[active])
            )
        except xr.SessionNotFocused:
            return ()
        pressed = []
        for name, action in self._buttons.items():
            state = xr.get_action_state_boolean(
                self._session, xr.ActionStateGetInfo(action)
            )
            is_new = state.is_active and state.changed_since_last_sync
            if is_new and state.current_state:
                pressed.append(name)
        return tuple(pressed)

    def gaze(self, head_space: xr.Space, time_ns: int) -> GazeSample | None:
        """Return the gaze relative to the head; None if unknown.

        A tracker that cannot predict returns its nearest sample in time. If it does not
        report the time of the sample (0), the requested time is used.
        """
        if self._gaze_space is None:
            return None
        state = xr.get_action_state_pose(
            self._session, xr.ActionStateGetInfo(self._gaze)
        )
        if not state.is_active:
            return None
        sampled = xr.EyeGazeSampleTimeEXT()
        chained = ctypes.cast(ctypes.pointer(sampled), ctypes.c_void_p)
        found = xr.SpaceLocation(next=chained)
        # The wrapper of pyopenxr cannot return the time of the sample.
        raise_failure(
            xr.raw_functions.xrLocateSpace(
                self._gaze_space, head_space, time_ns, ctypes.byref(found)
            )
        )
        if found.location_flags & _SEEN != _SEEN:
            return None
        # The gaze direction is -z of its pose.
        h_deg, v_deg = angles_of(-matrix_of(pose_of(found.pose))[:3, 2])
        at_ns = int(sampled.time) or time_ns
        return GazeSample(h_deg, v_deg, 1e-9 * at_ns)


def _suggest(
    instance: xr.Instance, profile: str, bound: Sequence[tuple[xr.Action, str]]
) -> None:
    bindings = [
        xr.ActionSuggestedBinding(action, xr.string_to_path(instance, path))
        for action, path in bound
    ]
    xr.suggest_interaction_profile_bindings(
        instance,
        xr.InteractionProfileSuggestedBinding(
            interaction_profile=xr.string_to_path(instance, profile),
            suggested_bindings=bindings,
        ),
    )


def raise_failure(result: int) -> None:
    """Raise an exception if the result of a raw OpenXR call is a failure."""
    found = xr.exception.check_result(xr.Result(result))
    if found.is_exception():
        raise found
