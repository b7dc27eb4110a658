"""The exceptions of the service, its protocol and its clients.

    FilterError
    ├── ProtocolError            invalid message
    │   ├── BadMessage           a part, a field or an argument is missing, malformed or
    │   │                        out of range; also a ValueError
    │   ├── UnknownType          unknown message type in the header
    │   ├── VersionMismatch      client and service use different protocol versions
    │   └── CreditExceeded       more unanswered frames than the service granted
    ├── SessionError             valid message that this session cannot process
    │   ├── NoSession            message before hello, or after the service restarted
    │   ├── TooManySessions      the service has reached its limit of clients
    │   ├── NotAllowed           the client's key is not in the service's key folder
    │   ├── NoProfile            frame before any profile
    │   ├── UnknownProfile       the profile's body is invalid or incomplete
    │   ├── GridTooLarge         the profile needs more PSFs than the service allows
    │   ├── BuildFailed          the PSFs of a profile could not be computed
    │   ├── BuildCancelled       a newer profile replaced this one
    │   └── WorkerCrashed        the process that computes PSFs died
    ├── RenderError              a frame could not be filtered
    │   ├── ShaderError          GLSL did not compile or link
    │   ├── CameraMismatch       the frame's pixel pitch is not the PSF store's
    │   ├── OutOfGpuMemory       a buffer or texture could not be allocated
    │   ├── OutOfMemory          the service has no memory left for its images
    │   └── RenderFailed         any other failure while filtering
    └── TransportError           raised by the client library only
        ├── ServiceTimeout       no reply arrived in time
        ├── AuthenticationFailed service and client do not know each other's keys
        └── ConnectionLost       the connection broke while waiting for a reply

Each class has a ``code``, which is sent in an ``error`` message; the client library
converts an ``error`` back to the same class.  A message that raises one of these never
stops the service: it replies with the error and continues.
"""

from __future__ import annotations


class FilterError(Exception):
    """Base class of all errors of the service.

    Parameters
    ----------
    message : str
        One sentence with the invalid value.
    field : str, optional
        Path of the invalid message or profile field, as in ``views[0].width_px``.
    allowed : str, optional
        Values that would have been accepted.
    """

    code = "filter_error"

    def __init__(
        self, message: str, *, field: str | None = None, allowed: str | None = None
    ) -> None:
        super().__init__(message)
        self.message = message
        self.field = field
        self.allowed = allowed

    def __str__(self) -> str:
        """Return one line: field, message and allowed values."""
        text = self.message if self.field is None else f"{self.field}: {self.message}"
        return text if self.allowed is None else f"{text} (allowed: {self.allowed})"


class ProtocolError(FilterError):
    """The message violates the protocol."""

    code = "protocol_error"


class BadMessage(ProtocolError, ValueError):
    """A part, a field or an argument is missing, malformed or out of range."""

    code = "bad_message"


class UnknownType(ProtocolError):
    """The header names a message type that this side does not know."""

    code = "unknown_type"


class VersionMismatch(ProtocolError):
    """Client and service use different protocol versions."""

    code = "version_mismatch"


class CreditExceeded(ProtocolError):
    """The client has more unanswered frames than the service granted."""

    code = "credit_exceeded"


class SessionError(FilterError):
    """The message is well formed, but this session cannot process it."""

    code = "session_error"


class NoSession(SessionError):
    """The client has not sent hello, or the service has restarted since."""

    code = "no_session"


class TooManySessions(SessionError):
    """The service has reached its limit of clients."""

    code = "too_many_sessions"


class NotAllowed(SessionError):
    """The client's key is not in the service's key folder."""

    code = "not_allowed"


class NoProfile(SessionError):
    """A frame arrived before any profile."""

    code = "no_profile"


class UnknownProfile(SessionError):
    """The profile's body is invalid or incomplete."""

    code = "profile_invalid"


class GridTooLarge(SessionError):
    """The profile needs more or larger PSFs than the service allows."""

    code = "grid_too_large"


class BuildFailed(SessionError):
    """The PSFs of a profile could not be computed."""

    code = "build_failed"


class BuildCancelled(SessionError):
    """A newer profile replaced this one before it was ready."""

    code = "build_cancelled"


class WorkerCrashed(SessionError):
    """The process that computes PSFs died; it has been restarted."""

    code = "worker_crashed"


class RenderError(FilterError):
    """A frame could not be filtered."""

    code = "render_error"


class ShaderError(RenderError):
    """GLSL did not compile or link."""

    code = "shader_error"


class CameraMismatch(RenderError):
    """The frame's pixel pitch is not the one that the PSF store was built for."""

    code = "camera_mismatch"


class OutOfGpuMemory(RenderError):
    """A buffer or a texture could not be allocated."""

    code = "out_of_gpu_memory"


class OutOfMemory(RenderError):
    """The service has no memory left for the images of a frame, or for PSFs."""

    code = "out_of_memory"


class RenderFailed(RenderError):
    """Any other failure while a frame was filtered."""

    code = "render_failed"


class TransportError(FilterError):
    """The connection between client and service failed."""

    code = "transport_error"


class ServiceTimeout(TransportError):
    """No reply of the service arrived in time."""

    code = "service_timeout"


class AuthenticationFailed(TransportError):
    """The service and the client do not know each other's keys."""

    code = "authentication_failed"


class ConnectionLost(TransportError):
    """The connection broke while waiting for a reply."""

    code = "connection_lost"


def _with_subclasses(root: type[FilterError]) -> list[type[FilterError]]:
    found = [root]
    for child in root.__subclasses__():
        found += _with_subclasses(child)
    return found


ERROR_CLASSES: dict[str, type[FilterError]] = {
    error_class.code: error_class for error_class in _with_subclasses(FilterError)
}


def error_from_code(
    code: str, message: str, *, field: str | None = None, allowed: str | None = None
) -> FilterError:
    """Return the exception of an error code; FilterError for unknown codes."""
    error_class = ERROR_CLASSES.get(code)
    if error_class is None:
        return FilterError(f"{code}: {message}", field=field, allowed=allowed)
    return error_class(message, field=field, allowed=allowed)
