"""Client library: connect, send a profile and stream RGB-D frames.

    with FilterClient("tcp://127.0.0.1:5577") as client:
        client.set_profile("keratoconus", views=[camera])
        reply = client.filter(color, depth_m, pupil_diameter_mm=4.0, focus_dpt=0.0)

`filter` sends one frame and waits for the result.  `submit` and `poll` are for live
streams: at most ``max_in_flight`` frames are in flight, and of the others the client
keeps only the newest.  `poll` returns each submitted frame once, as a `FilteredFrame`,
a `Dropped` or an `ErrorReply`.

After a restart of the service, the client reconnects and sends its profile again.
Every wait has a timeout, whose error says what the client waited for.  Progress of a
profile's preparation restarts it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Required, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from clients.frame_packer import FramePacker, check_limits
from clients.link import Event, FilteredFrame, ServiceLink
from clients.shared_memory import REPLY_LIMIT_S
from filter_service import ColorImage, Output, RgbdView, as_views
from filter_service.errors import BadMessage, FilterError, ServiceTimeout
from filter_service.filter_protocol import Filter
from filter_service.keys import load_client_key
from filter_service.messages import (
    COMPRESSIONS,
    DEFAULT_ENDPOINT,
    DEPTH_ENCODINGS,
    EYE_NAMES,
    FORMATS,
    Accepted,
    Camera,
    Compression,
    DepthEncoding,
    EyeName,
    FilterSettings,
    Frame,
    Pong,
    ProfileRequest,
    Progress,
    Ready,
    ShareTexture,
    State,
    UnshareTexture,
    ViewHeader,
    ViewState,
    ViewTextures,
    Welcome,
    check_states,
    encode,
)
from filter_service.settings import (
    DepthKind,
    RenderOptions,
    RenderOptionValues,
    as_settings,
)

__all__ = ["Event", "FilterClient", "FilteredFrame", "RgbdView", "ViewState"]


DEFAULT_SETTINGS = FilterSettings()
SharedViews = Sequence[tuple[Camera, ViewTextures]]
"""Views of a frame in shared textures."""


class FrameValues(RenderOptionValues, total=False):
    """Keyword arguments of `FilterClient.submit`."""

    pupil_diameter_mm: Required[float]
    focus_dpt: Required[float]
    gaze_deg: tuple[float, float] | None
    output: Output
    depth_encoding: DepthEncoding
    states: Sequence[ViewState]
    display_time_ns: int | None


def _floats(pair: tuple[float, float]) -> tuple[float, float]:
    """Convert a pair of numbers, of NumPy for example, to floats."""
    try:
        return cast("tuple[float, float]", tuple(map(float, pair)))
    except (TypeError, ValueError):
        raise BadMessage(
            f"is {pair!r}", field="gaze_deg", allowed="two numbers"
        ) from None


def _shared_views(color: object) -> SharedViews:
    """Return the views of a frame in shared textures; none for other frames."""
    if isinstance(color, Sequence) and color and isinstance(color[0], tuple):
        return cast("SharedViews", color)
    return ()


class FilterClient:
    """A session with the filter service, for use by one thread at a time.

    If a wait takes more than 2 s, a bar on stderr shows its progress.  There is none
    without a terminal, with ``on_progress``, while the program shows a `Progress`, or
    if the environment variable ``OCUFILTER_PROGRESS`` is 0.

    Parameters
    ----------
    endpoint : str
        Address that the service listens on.
    timeout_s : float
        Default timeout of a reply: longest time in which the service neither replies
        nor reports progress.
    max_in_flight : int
        Maximum number of frames in flight.  With 1, frames of a live stream are the
        most recent (an age of 1.2 filter periods instead of 2.2).  The highest frame
        rate requires as many as the service's credit, 2 by default.
    client_name : str
        Name that appears in the service's log.
    shared_memory : bool
        Whether to pass images through shared memory if both sides support it.
    key_file : Path or str, optional
        Key file written by ``ocufilter keys add``, for a service that requires keys.
    compression : "none" or "lz4"
        Lossless compression of images that are not in shared memory, for networks
        slower than about 1 Gbit/s.

    Raises
    ------
    ValueError
        If the endpoint or the key file is invalid.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        *,
        timeout_s: float = 10.0,
        max_in_flight: int = 1,
        client_name: str = "filter_client",
        shared_memory: bool = True,
        key_file: Path | str | None = None,
        compression: Compression = "none",
    ) -> None:
        if not timeout_s > 0:
            raise ValueError(f"timeout_s is {timeout_s}; allowed: above 0")
        if max_in_flight < 1:
            raise ValueError(f"max_in_flight is {max_in_flight}; allowed: 1 or more")
        if compression not in COMPRESSIONS:
            raise ValueError(
                f"compression is {compression!r}; allowed: {', '.join(COMPRESSIONS)}"
            )
        self.timeout_s = timeout_s
        link = ServiceLink(
            endpoint,
            max_in_flight,
            client_name,
            shared_memory=shared_memory,
            key=None if key_file is None else load_client_key(key_file),
        )
        self._open_link: ServiceLink | None = link
        self._packer = FramePacker(link, compression, timeout_s)
        self._camera: Camera | None = None
        self._next_frame_id = 0
        self._next_profile_id = 0

    def __enter__(self) -> FilterClient:
        """Connect and wait until the service replies to hello."""
        try:
            self.hello()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        """End the session."""
        self.close()

    def hello(self, timeout_s: float | None = None) -> Welcome:
        """Wait until the service replies to hello; return its welcome message.

        Raises
        ------
        ServiceTimeout, TooManySessions, VersionMismatch, AuthenticationFailed
        """
        limit_s = self.timeout_s if timeout_s is None else timeout_s
        return self._link.wait_until(
            lambda: self._link.welcome, limit_s, "a reply to hello"
        )

    @property
    def welcome(self) -> Welcome | None:
        """Return the welcome message of the service; None if not connected."""
        return self._link.welcome

    def close(self) -> None:
        """End the session; closing twice is allowed."""
        if self._open_link is not None:
            self._open_link.close()
            self._open_link = None

    @property
    def _link(self) -> ServiceLink:
        if self._open_link is None:
            raise ValueError("this FilterClient is closed")
        return self._open_link

    # Profiles

    def set_profile(
        self,
        body: Mapping[str, Any] | str,
        *,
        eye: EyeName = "both",
        settings: FilterSettings | Mapping[str, Any] = DEFAULT_SETTINGS,
        views: Camera | RgbdView | Sequence[Camera | RgbdView] = (),
        wait: bool | str = True,
        on_progress: Callable[[Progress], None] | None = None,
        timeout_s: float = 120.0,
    ) -> Ready | Accepted:
        """Change the eye; the service uses the previous eye until the new one is ready.

        Parameters
        ----------
        body : mapping or str
            Profile, such as ``{"kind": "prescription", "sphere_dpt": -6}``, or the name
            of a preset.
        eye : "both", "left" or "right"
            Eye of the session to change.  "both" applies to all views whose `ViewState`
            does not select an eye.
        settings : FilterSettings or mapping, optional
            Settings, or the fields that differ from the defaults.
        views : camera or view, or several, optional
            Cameras to prepare for; by default, the cameras of the last frame.  Before
            the first frame there is nothing to prepare by default, and Accepted is
            returned with ``is_building`` false.
        wait : bool or "first"
            With True, return when the eye is ready for all cameras; with "first", when
            it is ready for one of them; with False, when the profile is accepted.
            `poll` returns each later Progress and Ready.
        on_progress : callable, optional
            Called with each Progress while waiting.
        timeout_s : float
            Longest time without progress of the preparation.

        Raises
        ------
        UnknownProfile, GridTooLarge, BuildFailed, WorkerCrashed, ServiceTimeout
            The previous eye then remains in use.
        """
        if wait not in (True, False, "first"):
            raise ValueError(f"wait is {wait!r}; allowed: True, False or 'first'")
        previous = self._link.profiles.get(eye)
        request = self._request(body, eye, settings, views)
        parts = encode(request)  # may raise, so it precedes any change of state
        self.hello()
        self._ask(request, parts)
        try:
            return self._link.await_profile(
                request.profile_id, wait, on_progress, timeout_s
            )
        except FilterError:
            # After a restart of the service, the last accepted profile is sent again.
            if previous is None:
                self._link.profiles.pop(eye, None)
            else:
                self._link.profiles[eye] = previous
            raise

    def request_profile(
        self,
        body: Mapping[str, Any] | str,
        *,
        eye: EyeName = "both",
        settings: FilterSettings | Mapping[str, Any] = DEFAULT_SETTINGS,
        views: Camera | RgbdView | Sequence[Camera | RgbdView] = (),
    ) -> int:
        """Request another eye like `set_profile`, without waiting.

        Returns
        -------
        int
            Profile id of the events Accepted, Progress, Ready and ErrorReply that
            `poll` returns.
        """
        request = self._request(body, eye, settings, views)
        self._ask(request, encode(request))
        return request.profile_id

    def _request(
        self,
        body: Mapping[str, Any] | str,
        eye: EyeName,
        settings: FilterSettings | Mapping[str, Any],
        views: Camera | RgbdView | Sequence[Camera | RgbdView],
    ) -> ProfileRequest:
        if isinstance(views, Camera | RgbdView):
            views = (views,)
        cameras = tuple(v.camera if isinstance(v, RgbdView) else v for v in views)
        if isinstance(body, str):
            body = {"kind": "preset", "name": body}
        if not isinstance(body, Mapping):
            raise BadMessage(
                f"is a {type(body).__name__}",
                field="profile",
                allowed="a mapping, or the name of a preset",
            )
        if eye not in EYE_NAMES:
            raise ValueError(f"eye is {eye!r}; allowed: {', '.join(EYE_NAMES)}")
        return ProfileRequest(
            self._next_profile_id, dict(body), as_settings(settings), cameras, eye
        )

    def _ask(self, request: ProfileRequest, parts: list[Any]) -> None:
        self._camera = next(iter(request.views), self._camera)
        self._next_profile_id += 1
        self._link.profiles[request.eye] = request
        if self.welcome is not None:  # otherwise `_begin` sends it after hello
            self._link.queue_message(parts)

    # Frames

    def filter(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView] | SharedViews,
        depth_m: NDArray[np.float32] | None = None,
        *,
        timeout_s: float | None = None,
        **frame: Unpack[FrameValues],
    ) -> FilteredFrame:
        """Send one frame and return it filtered; see `submit` for the parameters.

        The frame is sent again while the service prepares the eye for its camera or
        state, and after a restart of the service, until this has not advanced for
        ``timeout_s``.

        Raises
        ------
        BadMessage
            Among others, if the service has lost a texture with a render worker.
        ProtocolError, SessionError, RenderError, ServiceTimeout
        """
        return self.begin(color, depth_m, timeout_s=timeout_s, **frame)()

    def begin(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView] | SharedViews,
        depth_m: NDArray[np.float32] | None = None,
        *,
        timeout_s: float | None = None,
        **frame: Unpack[FrameValues],
    ) -> Callable[[], FilteredFrame]:
        """Send one frame; return a function that waits for it like `filter`."""
        limit_s = self.timeout_s if timeout_s is None else timeout_s
        submit = partial(self.submit, color, depth_m, **frame)
        first_id = submit()
        return lambda: self._link.await_filtered(first_id, submit, limit_s)

    def submit(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView] | SharedViews,
        depth_m: NDArray[np.float32] | None = None,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        depth_encoding: DepthEncoding = "float32",
        states: Sequence[ViewState] = (),
        display_time_ns: int | None = None,
        **options: Unpack[RenderOptionValues],
    ) -> int:
        """Submit a frame without waiting; return its frame_id.

        The images are copied, so the caller may reuse its arrays at once, except those
        of `lend_view`.  The GPU must have finished rendering shared textures, which the
        service uses until its reply; then the results are finished.  If the service is
        busy, the client queues the frame in place of one that is already queued, which
        is dropped with the reason ``superseded``.

        Parameters
        ----------
        color : (height, width, 3) array, RgbdView, or several views
            uint8 sRGB, or float32 or float16 linear light.  Or a sequence of (Camera,
            ViewTextures): numbers from `share_texture`, and the meaning of the depth.
        depth_m : (height, width) float32, optional
            View-space z in meters, required if ``color`` is an array.  The camera is
            then the first one of the profile.
        pupil_diameter_mm, focus_dpt : float
            Entrance pupil, and focus in diopters.
        gaze_deg : (h, v), optional
            Gaze direction in the image, to the right and up from the camera's axis;
            None selects the profile's setting.
        output : {"srgb8", "linear", "linear16"}
            8-bit sRGB, or linear light in float32 or float16.
        depth_encoding : {"float32", "float16", "dpt16", "mm16"}
            Encoding of depth on the wire: meters as float32; or, in half the bytes for
            slow networks, meters or diopters as float16, or integer millimeters.
        states : sequence of ViewState, optional
            One per view: the eye that sees it, and values that differ from the frame's
            pupil, focus and gaze.  Its pose is returned with the image.
        display_time_ns : int, optional
            Value that is returned with the frame.
        **options
            Fields of `RenderOptions`; see `EyeFilter.filter`.
        """
        if depth_encoding not in DEPTH_ENCODINGS:
            raise ValueError(
                f"depth_encoding is {depth_encoding!r}; allowed: "
                f"{', '.join(DEPTH_ENCODINGS)}"
            )
        if output not in FORMATS:
            raise ValueError(f"output is {output!r}; allowed: {', '.join(FORMATS)}")
        shared = _shared_views(color)
        items = () if shared else as_views(cast("Any", color), depth_m, self._camera)
        n_views = len(shared or items)
        states = tuple(states) or (ViewState(),) * n_views
        if len(states) != n_views:
            raise ValueError(f"{len(states)} states; allowed: {n_views}, one per view")
        check_states(states, State(pupil_diameter_mm, focus_dpt))
        if self.welcome is not None and items:
            check_limits(items, self.welcome)
        if shared:
            headers = [
                ViewHeader.of(camera, state=state)
                for (camera, _), state in zip(shared, states, strict=True)
            ]
        else:
            headers = [
                ViewHeader.describing(item, depth_encoding, state)
                for item, state in zip(items, states, strict=True)
            ]
        frame = Frame(
            frame_id=self._next_frame_id,
            views=tuple(headers),
            pupil_diameter_mm=float(pupil_diameter_mm),
            focus_dpt=float(focus_dpt),
            gaze_deg=None if gaze_deg is None else _floats(gaze_deg),
            output=FORMATS[output],
            options=RenderOptions(**options),
            textures=tuple(textures for _, textures in shared),
            display_time_ns=display_time_ns,
        )
        self._next_frame_id += 1
        self._link.submit(self._packer.packed(frame, items))
        return frame.frame_id

    def lend_view(
        self,
        camera: Camera,
        *,
        dtype: str = "uint8",
        depth_kind: DepthKind = "planar",
    ) -> RgbdView:
        """Return an empty view to render into, which `submit` does not copy.

        Its arrays are in shared memory if that is available, and ordinary arrays
        otherwise.  Do not modify the view between `submit` and the reply; a live stream
        alternates between two views.

        Parameters
        ----------
        camera : Camera
            Camera of the view.
        dtype : "uint8", "float32" or "float16"
            Data type of the color.
        depth_kind : "planar" or "radial"
            Meaning of the depth.
        """
        _ = self._link  # raises if closed
        return self._packer.lend_view(camera, dtype=dtype, depth_kind=depth_kind)

    # Textures

    def share_texture(
        self,
        descriptor: int,
        *,
        width_px: int,
        height_px: int,
        format: str,
        size_bytes: int,
        is_dedicated: bool = False,
        device_uuid: str | None = None,
    ) -> int | None:
        """Share memory of a texture with a service on the same GPU.

        Parameters
        ----------
        descriptor : int
            Opaque descriptor from ``vkGetMemoryFdKHR``, which the caller may close
            afterward.  The image starts at 0, has optimal tiling, one level and one
            layer.
        width_px, height_px : int
        format : str
            Color: "rgba8" (sRGB values), "srgb8_a8" or "rgba16f" (linear light).
            Depth: "d32f", "d24" or "r32f".
        size_bytes : int
            Size of the allocation.
        is_dedicated : bool
            Whether it is a dedicated allocation of Vulkan.
        device_uuid : str, optional
            ``VkPhysicalDeviceIDProperties::deviceUUID`` in hexadecimal digits.

        Returns
        -------
        int or None
            Number of the texture.  None, with one line in the log, if the service
            cannot use it: send arrays to `filter` then.

        Raises
        ------
        BadMessage
            If the size or the format is not allowed.
        ServiceTimeout
            If there is no connection.
        """
        welcome = self.hello()
        textures = self._link.textures
        fields = {
            "session_key": welcome.session_key,
            "texture": textures.new_number(),
            "width_px": width_px,
            "height_px": height_px,
            "format": format,
            "size_bytes": size_bytes,
            "is_dedicated": is_dedicated,
        }
        request = ShareTexture.parse(fields, (), welcome.limits)
        number = request.texture
        reason = textures.refusal(device_uuid) or textures.send(request, descriptor)
        if not reason:
            try:
                reason = self._link.wait_until(
                    lambda: textures.reply_about(number), REPLY_LIMIT_S, "a texture"
                ).reason
            except ServiceTimeout:
                reason = "the service did not reply to a descriptor"
        if reason:
            textures.report(reason)
        return None if reason else number

    def unshare_texture(self, texture: int) -> None:
        """Take a texture back; the service frees it."""
        self._link.queue_message(encode(UnshareTexture(texture)))
        self._link.pump(0.0)

    def poll(self, timeout_s: float = 0.0) -> list[Event]:
        """Return the new events; wait up to ``timeout_s`` if there are none.

        They include messages about profiles.
        """
        deadline_s = time.monotonic() + timeout_s
        self._link.pump(0.0)
        while not self._link.has_events:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                break
            self._link.pump(remaining_s)
        return self._link.take_events()

    @property
    def n_unanswered(self) -> int:
        """Return the number of submitted frames that are queued or in flight."""
        return len(self._link.in_flight) + (self._link.pending is not None)

    @property
    def n_bytes(self) -> tuple[int, int]:
        """Return the total size of messages sent and received, in bytes."""
        return self._link.n_bytes

    @property
    def n_superseded(self) -> int:
        """Return the number of queued frames that newer ones replaced."""
        return self._link.n_superseded

    def ping(self, timeout_s: float | None = None) -> tuple[float, Pong]:
        """Return the round trip in ms, and the state of the service's render worker."""
        return self._link.ping(self.timeout_s if timeout_s is None else timeout_s)


if TYPE_CHECKING:  # mypy checks here that the class implements the protocol
    _: type[Filter] = FilterClient
