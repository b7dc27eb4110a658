"""Controller buttons and eye gaze, as OpenXR actions."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import xr

from clients.headset.openxr_swapchains import pose_of
from clients.headset.poses import angles_of, matrix_of
from clients.headset.runtime import GazeSample

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
            if state.is_active and state.changed_since_last_sync:
                if state.current_state:
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
