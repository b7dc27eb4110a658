"""The OpenGL calls of a filter, counted where it asks for their addresses."""

import ctypes
from collections import Counter

from filter_service.gl.current_context import CurrentContext

_uint, _int, _size = ctypes.c_uint, ctypes.c_int, ctypes.c_ssize_t
_pointer = ctypes.c_void_p

UP, DOWN, IMAGE, WAIT, CALL = "up", "down", "image", "wait", "call"

WATCHED = {
    # name: result, arguments, kind, which argument is the number of bytes
    "glBufferData": (None, (_uint, _size, _pointer, _uint), UP, 1),
    "glBufferSubData": (None, (_uint, _size, _size, _pointer), UP, 2),
    "glNamedBufferSubData": (None, (_uint, _size, _size, _pointer), UP, 2),
    "glGetBufferSubData": (None, (_uint, _size, _size, _pointer), DOWN, 2),
    "glGetNamedBufferSubData": (None, (_uint, _size, _size, _pointer), DOWN, 2),
    "glCopyBufferSubData": (None, (_uint, _uint, _size, _size, _size), "copy", 4),
    "glMapBufferRange": (_pointer, (_uint, _size, _size, _uint), "map", 2),
    "glTexImage2D": (None, (_uint, *(_int,) * 5, _uint, _uint, _pointer), IMAGE, 0),
    "glTexSubImage2D": (None, (_uint, *(_int,) * 5, _uint, _uint, _pointer), IMAGE, 0),
    "glTexSubImage3D": (None, (_uint, *(_int,) * 7, _uint, _uint, _pointer), IMAGE, 0),
    "glReadPixels": (None, (*(_int,) * 4, _uint, _uint, _pointer), IMAGE, 0),
    "glGetTexImage": (None, (_uint, _int, _uint, _uint, _pointer), IMAGE, 0),
    "glFinish": (None, (), WAIT, 0),
    "glClientWaitSync": (_uint, (_pointer, _uint, ctypes.c_uint64), "sync", 2),
    "glGetQueryObjectuiv": (None, (_uint, _uint, _pointer), WAIT, 0),
    "glGetQueryObjectui64v": (None, (_uint, _uint, _pointer), WAIT, 0),
    "glDispatchCompute": (None, (_uint, _uint, _uint), CALL, 0),
    "glDispatchComputeIndirect": (None, (_size,), CALL, 0),
}


class CountedContext(CurrentContext):
    """The current context, whose transfers and waits are noted.

    Attributes
    ----------
    calls : Counter
    waits, images : list of str
        Calls that wait for the GPU; transfers of images.
    """

    def __init__(self):
        super().__init__()
        self._kept = []
        self._rings = set()
        self._bound = {}
        self.clear()

    def clear(self):
        """Note anew."""
        self.calls, self.waits, self.images = Counter(), [], []
        self._bytes = {UP: [], DOWN: []}

    def largest(self, way):
        """The largest transfer up or down, in bytes."""
        return max(self._bytes[way], default=0)

    def total(self, way):
        """The sum of all transfers up or down, in bytes."""
        return sum(self._bytes[way])

    def load_opengl_function(self, name):
        """The address of a function that notes its calls."""
        address = super().load_opengl_function(name)
        if not address:
            return address
        if name == "glBindBuffer":
            return self._wrapped(
                name, address, None, (_uint, _uint), self._note_binding
            )
        if name not in WATCHED:
            return address
        result, arguments, kind, at = WATCHED[name]

        def note(*values):
            self._note(name, kind, values[at] if values else 0)

        return self._wrapped(name, address, result, arguments, note)

    def _wrapped(self, name, address, result, arguments, note):
        kind = ctypes.CFUNCTYPE(result, *arguments)
        real = kind(address)

        def call(*values):
            self.calls[name] += 1
            note(*values)
            return real(*values)

        wrapped = kind(call)
        self._kept += [real, wrapped]
        return ctypes.cast(wrapped, _pointer).value

    def _note_binding(self, target, buffer):
        self._bound[target] = buffer

    def _note(self, name, kind, amount):
        if kind in (UP, DOWN):
            self._bytes[kind].append(amount)
        elif kind == "map":
            self._rings.add(self._bound.get(0x8F36))
        elif kind == "copy":
            source = self._bound.get(0x8F36)
            self._bytes[UP if source in self._rings else DOWN].append(amount)
        elif kind == IMAGE:
            self.images.append(name)
        elif kind == WAIT or (kind == "sync" and amount > 0):
            self.waits.append(name)
