"""The one owner of the OpenGL context, and the sources of its shaders."""
