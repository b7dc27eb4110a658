/* Images of programs that use OpenGL: copies of released ones, reads and uploads. */
#include <stdlib.h>
#include <string.h>

#include "gl_context.h"
#include "graphics.h"
#include "log.h"

typedef struct {
    gl_context gl;
    GLuint pixels; /* buffer that is read into, without software rendering */
    size_t pixels_bytes;
    GLsync is_read;
} gl_state;

typedef struct {
    image_format head;
    GLenum layout, type; /* for glTexImage */
} format_row;

static const format_row FORMATS[] = {
    {{GL_SRGB8_ALPHA8, WIRE_SRGB8, 0}, GL_RGBA, GL_UNSIGNED_BYTE},
    {{GL_RGBA8, WIRE_LINEAR8, 0}, GL_RGBA, GL_UNSIGNED_BYTE},
    {{GL_RGB10_A2, WIRE_LINEAR16F, 0}, GL_RGBA, GL_HALF_FLOAT},
    {{GL_RGBA16, WIRE_LINEAR16F, 0}, GL_RGBA, GL_HALF_FLOAT},
    {{GL_RGBA16F, WIRE_LINEAR16F, 0}, GL_RGBA, GL_HALF_FLOAT},
    {{GL_DEPTH_COMPONENT16, 0, 0}, GL_DEPTH_COMPONENT, GL_FLOAT},
    {{GL_DEPTH_COMPONENT24, 0, 0}, GL_DEPTH_COMPONENT, GL_FLOAT},
    {{GL_DEPTH_COMPONENT32F, 0, 0}, GL_DEPTH_COMPONENT, GL_FLOAT},
    {{GL_DEPTH24_STENCIL8, 0, 0}, GL_DEPTH_STENCIL, GL_UNSIGNED_INT_24_8},
    {{GL_DEPTH32F_STENCIL8, 0, 0}, GL_DEPTH_STENCIL, GL_FLOAT_32_UNSIGNED_INT_24_8_REV},
};

static const image_format *format_of(int64_t format) {
    for (size_t i = 0; i < sizeof FORMATS / sizeof *FORMATS; ++i)
        if (FORMATS[i].head.format == format) return &FORMATS[i].head;
    return NULL;
}

static const format_row *row_of(const swapchain *chain) {
    return (const format_row *)chain->format; /* its first member */
}

static gl_context *gl_of(const session *at) { return &((gl_state *)at->graphics)->gl; }

static const char *open_graphics(session *at, const XrBaseInStructure *binding) {
    gl_state *state = calloc(1, sizeof *state);
    if (!state) return "there is no memory";
    const char *reason = gl_open(&state->gl, binding);
    if (reason) free(state);
    else at->graphics = state;
    return reason;
}

static void finish_all(session *at) {
    gl_current before;
    if (!gl_enter(gl_of(at), &before)) return;
    gl_of(at)->Finish();
    gl_leave(gl_of(at), &before, false);
}

static void close_graphics(session *at) {
    gl_state *state = at->graphics;
    gl_context *gl = &state->gl;
    gl_current before;
    if (gl_enter(gl, &before)) {
        if (state->pixels) gl->DeleteBuffers(1, &state->pixels);
        if (state->is_read) gl->DeleteSync(state->is_read);
        gl->DeleteFramebuffers(1, &gl->read_framebuffer);
        gl->DeleteFramebuffers(1, &gl->draw_framebuffer);
        gl->Finish();
        gl_leave(gl, &before, false);
    }
    gl_close(gl);
    free(state);
}

static uint32_t find_images(const session *at, XrSwapchain handle,
                            uint64_t images[MAX_IMAGES]) {
    XrSwapchainImageOpenGLKHR found[MAX_IMAGES];
    for (int i = 0; i < MAX_IMAGES; ++i)
        found[i] = (XrSwapchainImageOpenGLKHR){.type = XR_TYPE_SWAPCHAIN_IMAGE_OPENGL_KHR};
    uint32_t count = 0;
    if (XR_FAILED(at->instance->EnumerateSwapchainImages(
            handle, MAX_IMAGES, &count, (XrSwapchainImageBaseHeader *)found)))
        return 0;
    for (uint32_t i = 0; i < count; ++i) images[i] = found[i].image;
    return count;
}

/* Copies ------------------------------------------------------------------------------- */

static GLuint copy_of(const swapchain *chain) { return (GLuint)(uintptr_t)chain->copy; }

static GLenum target_of(const swapchain *chain) {
    return chain->info.arraySize > 1 ? GL_TEXTURE_2D_ARRAY : GL_TEXTURE_2D;
}

static bool make_copy(swapchain *chain) {
    gl_context *gl = gl_of(chain->session);
    const format_row *row = row_of(chain);
    const XrSwapchainCreateInfo *info = &chain->info;
    GLenum target = target_of(chain);
    GLsizei width = (GLsizei)info->width, height = (GLsizei)info->height;
    GLuint made = 0;
    gl->GenTextures(1, &made);
    chain->copy = (void *)(uintptr_t)made;
    gl->BindTexture(target, made);
    gl->TexParameteri(target, GL_TEXTURE_MAX_LEVEL, 0);
    if (target == GL_TEXTURE_2D_ARRAY)
        gl->TexImage3D(target, 0, (GLint)info->format, width, height,
                       (GLsizei)info->arraySize, 0, row->layout, row->type, NULL);
    else
        gl->TexImage2D(target, 0, (GLint)info->format, width, height, 0, row->layout,
                       row->type, NULL);
    gl->BindTexture(target, 0);
    return gl->GetError() == GL_NO_ERROR;
}

static GLenum attachment_of(const swapchain *chain) {
    GLenum layout = row_of(chain)->layout;
    return layout == GL_RGBA            ? GL_COLOR_ATTACHMENT0
           : layout == GL_DEPTH_STENCIL ? GL_DEPTH_STENCIL_ATTACHMENT
                                        : GL_DEPTH_ATTACHMENT;
}

/* Attach a layer of a texture of a swapchain's kind; 0 detaches. */
static void attach(const swapchain *chain, GLenum framebuffer, GLuint texture, GLint layer) {
    gl_context *gl = gl_of(chain->session);
    GLenum attachment = attachment_of(chain);
    if (chain->info.arraySize > 1) {
        gl->FramebufferTextureLayer(framebuffer, attachment, texture, 0, layer);
        return;
    }
    bool is_multisampled = chain->info.sampleCount > 1 && texture != copy_of(chain);
    GLenum target = is_multisampled ? GL_TEXTURE_2D_MULTISAMPLE : GL_TEXTURE_2D;
    gl->FramebufferTexture2D(framebuffer, attachment, texture ? target : GL_TEXTURE_2D,
                             texture, 0);
}

static void select_buffers(const swapchain *chain, bool is_color) {
    gl_context *gl = gl_of(chain->session);
    GLenum buffer = is_color ? GL_COLOR_ATTACHMENT0 : GL_NONE;
    gl->ReadBuffer(buffer);
    gl->DrawBuffer(buffer);
}

/* Average the samples, or copy where glCopyImageSubData is missing. */
static void blit(swapchain *chain, GLuint image) {
    gl_context *gl = gl_of(chain->session);
    GLint width = (GLint)chain->info.width, height = (GLint)chain->info.height;
    bool is_color = chain->format->wire;
    select_buffers(chain, is_color);
    for (GLint layer = 0; layer < (GLint)chain->info.arraySize; ++layer) {
        attach(chain, GL_READ_FRAMEBUFFER, image, layer);
        attach(chain, GL_DRAW_FRAMEBUFFER, copy_of(chain), layer);
        gl->BlitFramebuffer(0, 0, width, height, 0, 0, width, height,
                            is_color ? GL_COLOR_BUFFER_BIT : GL_DEPTH_BUFFER_BIT,
                            GL_NEAREST);
    }
    attach(chain, GL_READ_FRAMEBUFFER, 0, 0);
    attach(chain, GL_DRAW_FRAMEBUFFER, 0, 0);
}

static GLenum copy_image(swapchain *chain, GLuint image) {
    gl_context *gl = gl_of(chain->session);
    const XrSwapchainCreateInfo *info = &chain->info;
    if (!chain->copy && !make_copy(chain)) return GL_OUT_OF_MEMORY;
    if (gl->CopyImageSubData && info->sampleCount <= 1) {
        GLenum target = target_of(chain);
        /* Changes by another context are visible from the next binding on. */
        gl->BindTexture(target, image);
        gl->CopyImageSubData(image, target, 0, 0, 0, 0, copy_of(chain), target, 0, 0, 0, 0,
                             (GLsizei)info->width, (GLsizei)info->height,
                             (GLsizei)info->arraySize);
        gl->BindTexture(target, 0);
        /* It also fails for images of another format than the one they are named by. */
        if (gl->GetError() == GL_NO_ERROR) return GL_NO_ERROR;
    }
    blit(chain, image);
    return gl->GetError();
}

static bool copy(swapchain *chain, uint64_t image) {
    session *at = chain->session;
    gl_current before;
    if (!gl_enter(gl_of(at), &before)) {
        LOG_ONCE(&at->reported, REASON_OTHER_API,
                 "images are released with a context of another window system; not "
                 "filtered");
        return false;
    }
    GLenum error = copy_image(chain, (GLuint)image);
    if (error)
        LOG_ONCE(&at->reported, REASON_COPY,
                 "a released image cannot be copied (OpenGL error 0x%x)", error);
    gl_leave(gl_of(at), &before, true);
    return !error;
}

/* Textures would live on in the application's context, which shares them. */
static void destroy_copies(session *at, swapchain *chains) {
    gl_current before;
    if (!gl_enter(gl_of(at), &before)) return;
    for (swapchain *chain = chains; chain; chain = chain->next) {
        GLuint texture = copy_of(chain);
        if (texture) gl_of(at)->DeleteTextures(1, &texture);
        chain->copy = NULL;
    }
    gl_leave(gl_of(at), &before, false);
}

/* Reads -------------------------------------------------------------------------------- */

/* The target is a pointer, or an offset in the bound pixel pack buffer. */
static void read_part(const image_read *read, uint8_t *target) {
    const swapchain *chain = read->chain;
    const XrRect2Di *rect = &read->part->imageRect;
    gl_context *gl = gl_of(chain->session);
    uint32_t format = chain->format->wire;
    select_buffers(chain, format != 0);
    attach(chain, GL_READ_FRAMEBUFFER, copy_of(chain), (GLint)read->part->imageArrayIndex);
    gl->ReadPixels(rect->offset.x, rect->offset.y, rect->extent.width, rect->extent.height,
                   format ? GL_RGBA : GL_DEPTH_COMPONENT,
                   format == 0                ? GL_FLOAT
                   : format == WIRE_LINEAR16F ? GL_HALF_FLOAT
                                              : GL_UNSIGNED_BYTE,
                   target);
    attach(chain, GL_READ_FRAMEBUFFER, 0, 0);
}

/* Bind a buffer, which is read without waiting for the GPU. */
static void bind_pixels(gl_state *state, size_t bytes) {
    gl_context *gl = &state->gl;
    if (state->is_read) gl->DeleteSync(state->is_read); /* of a helper that has ended */
    state->is_read = NULL;
    if (!state->pixels) gl->GenBuffers(1, &state->pixels);
    gl->BindBuffer(GL_PIXEL_PACK_BUFFER, state->pixels);
    if (state->pixels_bytes == bytes) return;
    state->pixels_bytes = bytes;
    gl->BufferData(GL_PIXEL_PACK_BUFFER, (GLsizeiptr)bytes, NULL, GL_STREAM_READ);
}

static read_state begin_read(session *at, const image_read *reads, size_t count) {
    gl_state *state = at->graphics;
    gl_context *gl = &state->gl;
    gl_current before;
    if (!gl_enter(gl, &before)) {
        LOG_ONCE(&at->reported, REASON_OTHER_API,
                 "frames end with a context of another window system; not filtered");
        return READ_FAILED;
    }
    if (!gl->is_software) bind_pixels(state, at->link.memory_bytes);
    uint8_t *base = gl->is_software ? at->link.memory : NULL;
    for (size_t i = 0; i < count; ++i) read_part(reads + i, base + reads[i].start);
    if (!gl->is_software) {
        gl->BindBuffer(GL_PIXEL_PACK_BUFFER, 0);
        state->is_read = gl->FenceSync(GL_SYNC_GPU_COMMANDS_COMPLETE, 0);
        gl->Flush();
    }
    gl_leave(gl, &before, false);
    return gl->is_software ? READ_DONE : READ_BEGUN;
}

/* Copy the buffer that has been read. */
static read_state take_pixels(session *at, uint64_t limit_ns) {
    gl_state *state = at->graphics;
    gl_context *gl = &state->gl;
    if (gl->ClientWaitSync(state->is_read, GL_SYNC_FLUSH_COMMANDS_BIT, limit_ns) ==
        GL_TIMEOUT_EXPIRED)
        return READ_BEGUN;
    gl->DeleteSync(state->is_read);
    state->is_read = NULL;
    gl->BindBuffer(GL_PIXEL_PACK_BUFFER, state->pixels);
    const void *found = gl->MapBufferRange(
        GL_PIXEL_PACK_BUFFER, 0, (GLsizeiptr)state->pixels_bytes, GL_MAP_READ_BIT);
    if (found) memcpy(at->link.memory, found, state->pixels_bytes);
    gl->UnmapBuffer(GL_PIXEL_PACK_BUFFER);
    gl->BindBuffer(GL_PIXEL_PACK_BUFFER, 0);
    return found ? READ_DONE : READ_FAILED;
}

static read_state finish_read(session *at, uint64_t limit_ns) {
    gl_current before;
    if (!gl_enter(gl_of(at), &before)) return READ_BEGUN;
    read_state read = take_pixels(at, limit_ns);
    gl_leave(gl_of(at), &before, false);
    return read;
}

/* Uploads ------------------------------------------------------------------------------ */

static bool write_images(session *at, const image_write *writes, size_t count) {
    gl_context *gl = gl_of(at);
    bool is_half = at->frame.wire.color_format == WIRE_LINEAR16F;
    gl_current before;
    if (!gl_enter(gl, &before)) return false;
    for (size_t i = 0; i < count; ++i) {
        const own_image *to = writes[i].to;
        const wire_image *from = writes[i].from;
        gl->BindTexture(GL_TEXTURE_2D, (GLuint)to->images[to->index]);
        gl->TexSubImage2D(GL_TEXTURE_2D, 0, 0, 0, (GLsizei)from->width_px,
                          (GLsizei)from->height_px, GL_RGBA,
                          is_half ? GL_HALF_FLOAT : GL_UNSIGNED_BYTE,
                          at->link.memory + from->start);
    }
    gl->BindTexture(GL_TEXTURE_2D, 0);
    GLenum error = gl->GetError();
    if (error)
        LOG_ONCE(&at->reported, REASON_UPLOAD,
                 "filtered images cannot be uploaded (OpenGL error 0x%x)", error);
    gl_leave(gl, &before, true);
    return !error;
}

const graphics_api gl_api = {
    .name = "OpenGL",
    .formats = "SRGB8_ALPHA8, RGBA8, RGB10_A2, RGBA16, RGBA16F",
    .open = open_graphics,
    .close = close_graphics,
    .format_of = format_of,
    .find_images = find_images,
    .copy = copy,
    .destroy_copies = destroy_copies,
    .begin_read = begin_read,
    .finish_read = finish_read,
    .write = write_images,
    .finish = finish_all,
};
