"""Swapchains of a session: color and depth of both eyes, and projection layers."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import moderngl
import xr

from clients.headset.openxr_gl import Framebuffers
from clients.headset.presenter import NEAR_M, Presenter
from clients.headset.runtime import ShownView
from filter_service.messages import Pose

_COLOR_FORMATS = (0x8C43, 0x8058)  # GL_SRGB8_ALPHA8, GL_RGBA8
_DEPTH_FORMATS = (0x8CAC, 0x81A5)  # GL_DEPTH_COMPONENT32F, GL_DEPTH_COMPONENT16
_WAIT_NS = 2_000_000_000


class _Swapchain:
    """A swapchain and the names of its textures."""

    def __init__(
        self,
        session: xr.Session,
        image_format: int,
        usage: xr.SwapchainUsageFlags,
        size_px: tuple[int, int],
    ):
        width, height = size_px
        self.handle = xr.create_swapchain(
            session,
            xr.SwapchainCreateInfo(
                usage_flags=usage | xr.SwapchainUsageFlags.SAMPLED_BIT,
                format=image_format,
                sample_count=1,
                width=width,
                height=height,
                face_count=1,
                array_size=1,
                mip_count=1,
            ),
        )
        images = xr.enumerate_swapchain_images(self.handle, xr.SwapchainImageOpenGLKHR)
        self._textures = [image.image for image in images]
        rect = xr.Rect2Di(xr.Offset2Di(0, 0), xr.Extent2Di(width, height))
        self.part = xr.SwapchainSubImage(self.handle, rect, 0)

    def acquire(self) -> int:
        """Acquire and return the texture to draw into."""
        index = xr.acquire_swapchain_image(self.handle, xr.SwapchainImageAcquireInfo())
        xr.wait_swapchain_image(
            self.handle, xr.SwapchainImageWaitInfo(timeout=_WAIT_NS)
        )
        return self._textures[index]

    def release(self) -> None:
        """Return the texture to the runtime."""
        xr.release_swapchain_image(self.handle, xr.SwapchainImageReleaseInfo())


class StereoImages:
    """Swapchains of both eyes, and the projection layers that show them.

    Parameters
    ----------
    session : xr.Session
        Session that owns the swapchains.
    context : moderngl.Context
        Context to draw in, which must be current for every call.
    size_px : (int, int)
        Width and height of an image.
    with_depth : bool
        Whether to submit depth, which the runtime must support.
    """

    def __init__(
        self,
        session: xr.Session,
        context: moderngl.Context,
        size_px: tuple[int, int],
        *,
        with_depth: bool,
    ) -> None:
        offered = list(xr.enumerate_swapchain_formats(session))
        usage = xr.SwapchainUsageFlags
        color = _first_of(_COLOR_FORMATS, offered)
        depth = _first_of(_DEPTH_FORMATS, offered) if with_depth else None
        self._color, self._depth = (
            [_Swapchain(session, kind, bit, size_px) for _ in range(2)]
            if kind is not None
            else []
            for kind, bit in (
                (color, usage.COLOR_ATTACHMENT_BIT),
                (depth, usage.DEPTH_STENCIL_ATTACHMENT_BIT),
            )
        )
        if not self._color:
            raise RuntimeError(
                f"the runtime offers the color formats {offered}; expected one of "
                f"{_COLOR_FORMATS}"
            )
        self._framebuffers = Framebuffers(context)
        self._presenter = Presenter(context, size_px)

    @property
    def has_depth(self) -> bool:
        """Return whether depth is submitted."""
        return bool(self._depth)

    def release(self) -> None:
        """Free the OpenGL objects and the swapchains."""
        self._framebuffers.release()
        self._presenter.release()
        for swapchain in (*self._color, *self._depth):
            xr.destroy_swapchain(swapchain.handle)

    def layer(
        self, space: xr.Space, shown: Sequence[ShownView]
    ) -> tuple[xr.CompositionLayerProjection, list[xr.CompositionLayerDepthInfoKHR]]:
        """Draw a frame; return its projection layer, and structures it points to."""
        kept, views = [], []
        for i, view in enumerate(shown):
            used = [self._color[i], *self._depth[i : i + 1]]
            textures = [swapchain.acquire() for swapchain in used]
            depth = textures[1] if len(textures) > 1 else 0
            try:
                # The runtime waits for what was submitted before the release.
                self._presenter.draw(view, self._framebuffers.of(textures[0], depth))
            finally:
                for swapchain in used:
                    swapchain.release()
            more = None
            if self._depth:
                info = xr.CompositionLayerDepthInfoKHR(
                    sub_image=self._depth[i].part,
                    min_depth=0.0,
                    max_depth=1.0,
                    near_z=NEAR_M,
                    far_z=math.inf,
                )
                kept.append(info)
                more = ctypes.cast(ctypes.pointer(info), ctypes.c_void_p)
            views.append(
                xr.CompositionLayerProjectionView(
                    pose=posef(view.view.pose),
                    fov=fov(view.view.tangents),
                    sub_image=self._color[i].part,
                    next=more,
                )
            )
        return xr.CompositionLayerProjection(space=space, views=views), kept


def _first_of(wanted: Sequence[int], offered: Sequence[int]) -> int | None:
    return next((kind for kind in wanted if kind in offered), None)


def posef(pose: Pose) -> xr.Posef:
    """Return a pose as an OpenXR structure."""
    x, y, z, *quaternion = pose
    return xr.Posef(xr.Quaternionf(*quaternion), xr.Vector3f(x, y, z))


def pose_of(posef: xr.Posef) -> Pose:
    """Return an OpenXR pose as seven numbers."""
    p, q = posef.position, posef.orientation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def fov(tangents: tuple[float, float, float, float]) -> xr.Fovf:
    """Convert the tangents of the image edges to OpenXR's angles."""
    return xr.Fovf(*(math.atan(tangent) for tangent in tangents))


def tangents_of(fov: xr.Fovf) -> tuple[float, float, float, float]:
    """Convert OpenXR's angles to the tangents left, right, up and down."""
    return (
        math.tan(fov.angle_left),
        math.tan(fov.angle_right),
        math.tan(fov.angle_up),
        math.tan(fov.angle_down),
    )
