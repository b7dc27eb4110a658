/* The layer's own OpenGL context, which shares objects with the application's.
 *
 * It is current only within intercepted calls.  Afterward, the thread has the context and
 * the drawables that it had before; none of the application's state is changed. */
#ifndef OCU_LAYER_GL_CONTEXT_H
#define OCU_LAYER_GL_CONTEXT_H

#include <EGL/egl.h>
#include <GL/glcorearb.h>
#include <GL/glx.h>
#include <stdbool.h>

#define XR_USE_PLATFORM_XLIB
#define XR_USE_PLATFORM_EGL
#define XR_USE_GRAPHICS_API_OPENGL
#include <openxr/openxr.h>
#include <openxr/openxr_platform.h>

#define GL_FUNCTIONS(F)                                                                  \
    F(BINDBUFFER, BindBuffer)                                                            \
    F(BINDFRAMEBUFFER, BindFramebuffer)                                                  \
    F(BINDTEXTURE, BindTexture)                                                          \
    F(BLITFRAMEBUFFER, BlitFramebuffer)                                                  \
    F(BUFFERDATA, BufferData)                                                            \
    F(CHECKFRAMEBUFFERSTATUS, CheckFramebufferStatus)                                    \
    F(CLIENTWAITSYNC, ClientWaitSync)                                                    \
    F(DELETEBUFFERS, DeleteBuffers)                                                      \
    F(DELETEFRAMEBUFFERS, DeleteFramebuffers)                                            \
    F(DELETESYNC, DeleteSync)                                                            \
    F(DELETETEXTURES, DeleteTextures)                                                    \
    F(DRAWBUFFER, DrawBuffer)                                                            \
    F(ENABLE, Enable)                                                                    \
    F(FENCESYNC, FenceSync)                                                              \
    F(FINISH, Finish)                                                                    \
    F(FLUSH, Flush)                                                                      \
    F(FRAMEBUFFERTEXTURE2D, FramebufferTexture2D)                                        \
    F(FRAMEBUFFERTEXTURELAYER, FramebufferTextureLayer)                                  \
    F(GENBUFFERS, GenBuffers)                                                            \
    F(GENFRAMEBUFFERS, GenFramebuffers)                                                  \
    F(GENTEXTURES, GenTextures)                                                          \
    F(GETERROR, GetError)                                                                \
    F(GETSTRING, GetString)                                                              \
    F(ISSYNC, IsSync)                                                                    \
    F(MAPBUFFERRANGE, MapBufferRange)                                                    \
    F(READBUFFER, ReadBuffer)                                                            \
    F(READPIXELS, ReadPixels)                                                            \
    F(TEXIMAGE2D, TexImage2D)                                                            \
    F(TEXIMAGE3D, TexImage3D)                                                            \
    F(TEXPARAMETERI, TexParameteri)                                                      \
    F(TEXSUBIMAGE2D, TexSubImage2D)                                                      \
    F(UNMAPBUFFER, UnmapBuffer)                                                          \
    F(WAITSYNC, WaitSync)

typedef struct {
    bool is_egl;
    bool is_software; /* reads are synchronous: no buffers between */
    Display *x_display;
    GLXContext glx_context;
    GLXPbuffer glx_drawable;
    EGLDisplay egl_display;
    EGLContext egl_context;
    EGLSurface egl_surface;
    GLuint read_framebuffer, draw_framebuffer;
#define F(NAME, name) PFNGL##NAME##PROC name;
    GL_FUNCTIONS(F)
#undef F
    PFNGLCOPYIMAGESUBDATAPROC CopyImageSubData; /* NULL before OpenGL 4.3 */
} gl_context;

/* What was current on the thread. */
typedef struct {
    bool has_context;
    bool is_shared; /* it shares objects with the layer's context */
    Display *x_display;
    GLXContext glx_context;
    GLXDrawable glx_draw, glx_read;
    EGLenum egl_api;
    EGLDisplay egl_display;
    EGLContext egl_context;
    EGLSurface egl_draw, egl_read;
} gl_current;

/* Create the context for a graphics binding, of GLX or EGL; return a reason, or NULL. */
const char *gl_open(gl_context *gl, const XrBaseInStructure *binding);
void gl_close(gl_context *gl);

/* Make the context current.  Commands that the thread has submitted in the application's
 * context come before those that follow.  Returns false, with nothing changed, if that is
 * impossible on this thread. */
bool gl_enter(gl_context *gl, gl_current *before);

/* Restore what was current.  The commands since gl_enter come before those that the
 * thread submits in the application's context, or are finished if it has none. */
void gl_leave(gl_context *gl, const gl_current *before, bool has_written);

#endif
