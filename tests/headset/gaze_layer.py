"""An eye tracker for a runtime that has none: an OpenXR API layer with scripted gaze.

    python -m tests.headset.gaze_layer SCRIPT [MODULE ARGUMENT ...]

The module is run as a program with the layer between it and the runtime.  Without one
a session that shows nothing writes a line of JSON for each frame: time, head, gaze.

SCRIPT is a file with a `Script` as JSON; it is read again at each question, so that it
can be changed while the program runs.
"""

import contextlib
import ctypes
import json
import math
import os
import runpy
import sys
import tempfile
from ctypes import POINTER, byref, c_void_p, cast
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import moderngl
import xr

NAME = "XR_APILAYER_ocufilter_gaze"
PROFILE = b"/interaction_profiles/ext/eye_gaze_interaction"
SUCCESS = xr.Result.SUCCESS.value


@dataclass(frozen=True)
class Script:
    """What the eye tracker tells.

    Attributes
    ----------
    h_deg, v_deg : float
        Where the eyes look: to the right and up of the head.
    age_ns : int, optional
        By how much the sample is older than what it is asked for; None: the tracker
        does not know its time.
    has : str
        ``eyes``; or how they are lost: the action is not ``active``, the pose is not
        ``valid``, or it is the last one, and not ``tracked``.
    """

    h_deg: float = 0.0
    v_deg: float = 0.0
    age_ns: int | None = 0
    has: Literal["eyes", "not active", "not valid", "not tracked"] = "eyes"

    @property
    def orientation(self) -> tuple[float, float, float, float]:
        """Return the turn (x, y, z, w) that takes -z there: up, then aside."""
        aside, up = -math.radians(self.h_deg) / 2, math.radians(self.v_deg) / 2
        return (
            math.cos(aside) * math.sin(up),
            math.sin(aside) * math.cos(up),
            -math.sin(aside) * math.sin(up),
            math.cos(aside) * math.cos(up),
        )


def times(a, b) -> tuple[float, float, float, float]:
    """Return the quaternion of b, then a."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def address(handle) -> int:
    """Return what tells a handle of OpenXR from others."""
    return cast(handle, c_void_p).value


def chained(structure, kind):
    """Return the structure of a kind that hangs on another one; None without one."""
    at = structure.next
    while at:
        head = cast(at, POINTER(xr.BaseInStructure)).contents
        if head.type == kind().type:
            return cast(at, POINTER(kind)).contents
        at = head.next
    return None


class GazeLayer(xr.DynamicApiLayerBase):
    """Stands between a program and its runtime, and has an eye tracker.

    Parameters
    ----------
    script : Path
        Read again at each question.
    json_path : str
        A folder that does not exist yet, for the layer's manifest.
    """

    def __init__(self, script: Path, json_path: str) -> None:
        super().__init__(NAME, "scripted gaze", json_path)
        self._script = script
        self._actions: set[int] = set()
        self._spaces: dict[int, xr.Space] = {}  # those of VIEW, by those of the gaze
        self._is_synced = False
        self._get = xr.PFN_xrGetInstanceProcAddr(self._get_instance_proc_addr)
        self._create = xr.PFN_xrCreateApiLayerInstance(self._create_instance)
        own = {
            "xrGetSystemProperties": self._get_system_properties,
            "xrSuggestInteractionProfileBindings": self._suggest,
            "xrSyncActions": self._sync_actions,
            "xrGetActionStatePose": self._get_action_state_pose,
            "xrCreateActionSpace": self._create_action_space,
            "xrLocateSpace": self._locate_space,
        }
        self._own = {
            name.encode(): getattr(xr, f"PFN_{name}")(function)
            for name, function in own.items()
        }

    @property
    def script(self) -> Script:
        """Return what is to be told now."""
        return Script(**json.loads(self._script.read_text(encoding="utf-8")))

    # What the loader asks for

    def negotiate_loader_api_layer_interface(self, loader_info, layer_name, request):
        """Say where the layer's own functions are."""
        request.layer_interface_version = xr.CURRENT_LOADER_API_LAYER_VERSION
        request.layer_api_version = loader_info.max_api_version
        request.get_instance_proc_addr = self._get
        request.create_api_layer_instance = self._create
        return xr.Result.SUCCESS

    def _create_instance(self, info, layer_info, instance) -> int:
        mine = layer_info.contents.next_info.contents
        # A copy: what ctypes gives of the loader's structures goes with them.
        function = cast(mine.next_get_instance_proc_addr, c_void_p).value
        self._next_get = xr.PFN_xrGetInstanceProcAddr(function)
        # The layers after this one find their own place at the head of the list.
        rest = xr.ApiLayerCreateInfo.from_buffer_copy(layer_info.contents)
        rest.next_info = mine.next
        result = mine.next_create_api_layer_instance(
            info, ctypes.pointer(rest), instance
        )
        if result == SUCCESS:
            # Declared as a handle, it is the address of one.
            handle = cast(instance, POINTER(c_void_p))[0]
            self._instance = cast(handle, xr.Instance)
        return result

    def _get_instance_proc_addr(self, instance, name, function) -> int:
        own = self._own.get(name)
        if own is None:
            return self._next_get(instance, name, function)
        ctypes.memmove(function, byref(own), ctypes.sizeof(own))
        return SUCCESS

    def _next(self, name: str):
        """Return a function of what comes after this layer."""
        found = xr.PFN_xrVoidFunction()
        self._next_get(self._instance, name.encode(), ctypes.pointer(found))
        return cast(found, getattr(xr, f"PFN_{name}"))

    # What the program asks for

    def _get_system_properties(self, instance, system, properties) -> int:
        result = self._next("xrGetSystemProperties")(instance, system, properties)
        eyes = chained(properties.contents, xr.SystemEyeGazeInteractionPropertiesEXT)
        if result == SUCCESS and eyes is not None:
            eyes.supports_eye_gaze_interaction = 1
        return result

    def _suggest(self, instance, suggested) -> int:
        path = xr.Path()
        self._next("xrStringToPath")(instance, PROFILE, ctypes.pointer(path))
        bindings = suggested.contents
        if bindings.interaction_profile == path.value:
            for i in range(bindings.count_suggested_bindings):
                binding = bindings._suggested_bindings[i]
                self._actions.add(address(binding.action))
        return self._next("xrSuggestInteractionProfileBindings")(instance, suggested)

    def _sync_actions(self, session, info) -> int:
        result = self._next("xrSyncActions")(session, info)
        # Without the focus there is no input, and the result says so.
        self._is_synced = result == SUCCESS
        return result

    def _get_action_state_pose(self, session, info, state) -> int:
        result = self._next("xrGetActionStatePose")(session, info, state)
        if result == SUCCESS and address(info.contents.action) in self._actions:
            is_active = self._is_synced and self.script.has != "not active"
            state.contents.is_active = is_active
        return result

    def _create_action_space(self, session, info, space) -> int:
        result = self._next("xrCreateActionSpace")(session, info, space)
        if result == SUCCESS and address(info.contents.action) in self._actions:
            head = xr.Space()
            view = xr.ReferenceSpaceCreateInfo(xr.ReferenceSpaceType.VIEW)
            self._next("xrCreateReferenceSpace")(
                session, ctypes.pointer(view), ctypes.pointer(head)
            )
            self._spaces[address(space.contents)] = head
        return result

    def _locate_space(self, space, base, time_ns, location) -> int:
        head = self._spaces.get(address(space))
        if head is None:
            return self._next("xrLocateSpace")(space, base, time_ns, location)
        result = self._next("xrLocateSpace")(head, base, time_ns, location)
        if result == SUCCESS:
            self._turn(location.contents, time_ns)
        return result

    def _turn(self, location: xr.SpaceLocation, time_ns: int) -> None:
        """Make the gaze of a head's location."""
        script, flags = self.script, xr.SpaceLocationFlags
        tracked = flags.ORIENTATION_TRACKED_BIT | flags.POSITION_TRACKED_BIT
        if script.has in ("not valid", "not active"):
            location.location_flags = flags.NONE
        elif script.has == "not tracked":
            location.location_flags = location.location_flags & ~tracked
        else:
            location.location_flags = location.location_flags | tracked
        q = location.pose.orientation
        turned = times((q.x, q.y, q.z, q.w), script.orientation)
        location.pose.orientation = xr.Quaternionf(*turned)
        sample = chained(location, xr.EyeGazeSampleTimeEXT)
        if sample is not None:
            is_known = script.age_ns is not None
            sample.time = time_ns - script.age_ns if is_known else 0


def tell_frames() -> None:
    """Open a session, and tell of each frame until killed; nothing is shown."""
    from clients.headset.openxr_runtime import OpenXrRuntime

    context = moderngl.create_context(standalone=True, backend="egl", require=430)
    with contextlib.closing(OpenXrRuntime(context)) as runtime:
        print(json.dumps({"notes": runtime.notes}), flush=True)
        while True:
            due = runtime.begin_frame()
            if due is None:
                continue
            gaze = None if due.gaze is None else asdict(due.gaze)
            line = {"now_s": due.now_s, "head": due.head, "gaze": gaze}
            print(json.dumps(line), flush=True)
            runtime.end_frame(due, ())


def main() -> None:
    """Put the layer in, and run what is named."""
    script, *program = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        layer = GazeLayer(Path(script), f"{folder}/layer")
        wanted = [os.environ.get("XR_ENABLE_API_LAYERS"), layer.name]
        os.environ["XR_ENABLE_API_LAYERS"] = os.pathsep.join(filter(None, wanted))
        if not program:
            tell_frames()
            return
        sys.argv[:] = program
        runpy.run_module(program[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
