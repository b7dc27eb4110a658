/* Copies of the images that the application releases.
 *
 * All functions run in the layer's context, with the session locked. */
#include "layer.h"
#include "log.h"

typedef struct {
    int64_t format;
    GLenum layout, type; /* for glTexImage */
    uint32_t wire;       /* of color; 0 for depth */
} format_row;

static const format_row FORMATS[] = {
    {GL_SRGB8_ALPHA8, GL_RGBA, GL_UNSIGNED_BYTE, WIRE_SRGB8},
    {GL_RGBA8, GL_RGBA, GL_UNSIGNED_BYTE, WIRE_LINEAR8},
    {GL_RGB10_A2, GL_RGBA, GL_HALF_FLOAT, WIRE_LINEAR16F},
    {GL_RGBA16, GL_RGBA, GL_HALF_FLOAT, WIRE_LINEAR16F},
    {GL_RGBA16F, GL_RGBA, GL_HALF_FLOAT, WIRE_LINEAR16F},
    {GL_DEPTH_COMPONENT16, GL_DEPTH_COMPONENT, GL_FLOAT, 0},
    {GL_DEPTH_COMPONENT24, GL_DEPTH_COMPONENT, GL_FLOAT, 0},
    {GL_DEPTH_COMPONENT32F, GL_DEPTH_COMPONENT, GL_FLOAT, 0},
    {GL_DEPTH24_STENCIL8, GL_DEPTH_STENCIL, GL_UNSIGNED_INT_24_8, 0},
    {GL_DEPTH32F_STENCIL8, GL_DEPTH_STENCIL, GL_FLOAT_32_UNSIGNED_INT_24_8_REV, 0},
};

static const format_row *row_of(int64_t format) {
    for (size_t i = 0; i < sizeof FORMATS / sizeof *FORMATS; ++i)
        if (FORMATS[i].format == format) return FORMATS + i;
    return NULL;
}

uint32_t wire_format_of(int64_t format) {
    const format_row *row = row_of(format);
    return row ? row->wire : 0;
}

bool is_depth_format(int64_t format) {
    const format_row *row = row_of(format);
    return row && !row->wire;
}

bool swapchain_can_copy(const swapchain *chain) {
    const XrSwapchainCreateInfo *info = &chain->info;
    return row_of(info->format) && info->faceCount == 1 && chain->image_count;
}

static GLenum target_of(const swapchain *chain) {
    return chain->info.arraySize > 1 ? GL_TEXTURE_2D_ARRAY : GL_TEXTURE_2D;
}

static bool make_copy(swapchain *chain) {
    gl_context *gl = &chain->session->gl;
    const format_row *row = row_of(chain->info.format);
    const XrSwapchainCreateInfo *info = &chain->info;
    GLenum target = target_of(chain);
    GLsizei width = (GLsizei)info->width, height = (GLsizei)info->height;
    gl->GenTextures(1, &chain->copy);
    gl->BindTexture(target, chain->copy);
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
    GLenum layout = row_of(chain->info.format)->layout;
    return layout == GL_RGBA            ? GL_COLOR_ATTACHMENT0
           : layout == GL_DEPTH_STENCIL ? GL_DEPTH_STENCIL_ATTACHMENT
                                        : GL_DEPTH_ATTACHMENT;
}

/* Attach a layer of a texture of a swapchain's kind; 0 detaches. */
static void attach(const swapchain *chain, GLenum framebuffer, GLuint texture, GLint layer) {
    gl_context *gl = &chain->session->gl;
    GLenum attachment = attachment_of(chain);
    if (chain->info.arraySize > 1) {
        gl->FramebufferTextureLayer(framebuffer, attachment, texture, 0, layer);
        return;
    }
    bool is_multisampled = chain->info.sampleCount > 1 && texture != chain->copy;
    GLenum target = is_multisampled ? GL_TEXTURE_2D_MULTISAMPLE : GL_TEXTURE_2D;
    gl->FramebufferTexture2D(framebuffer, attachment, texture ? target : GL_TEXTURE_2D,
                             texture, 0);
}

static void select_buffers(const swapchain *chain, bool is_color) {
    gl_context *gl = &chain->session->gl;
    GLenum buffer = is_color ? GL_COLOR_ATTACHMENT0 : GL_NONE;
    gl->ReadBuffer(buffer);
    gl->DrawBuffer(buffer);
}

/* Average the samples, or copy where glCopyImageSubData is missing. */
static void blit(swapchain *chain, GLuint image) {
    gl_context *gl = &chain->session->gl;
    GLint width = (GLint)chain->info.width, height = (GLint)chain->info.height;
    bool is_color = !is_depth_format(chain->info.format);
    select_buffers(chain, is_color);
    for (GLint layer = 0; layer < (GLint)chain->info.arraySize; ++layer) {
        attach(chain, GL_READ_FRAMEBUFFER, image, layer);
        attach(chain, GL_DRAW_FRAMEBUFFER, chain->copy, layer);
        gl->BlitFramebuffer(0, 0, width, height, 0, 0, width, height,
                            is_color ? GL_COLOR_BUFFER_BIT : GL_DEPTH_BUFFER_BIT,
                            GL_NEAREST);
    }
    attach(chain, GL_READ_FRAMEBUFFER, 0, 0);
    attach(chain, GL_DRAW_FRAMEBUFFER, 0, 0);
}

void swapchain_copy(swapchain *chain, GLuint image) {
    session *at = chain->session;
    gl_context *gl = &at->gl;
    const XrSwapchainCreateInfo *info = &chain->info;
    chain->has_copy = false;
    if (!chain->copy && !make_copy(chain)) return;
    GLenum error = GL_INVALID_OPERATION;
    if (gl->CopyImageSubData && info->sampleCount <= 1) {
        GLenum target = target_of(chain);
        /* Changes by another context are visible from the next binding on. */
        gl->BindTexture(target, image);
        gl->CopyImageSubData(image, target, 0, 0, 0, 0, chain->copy, target, 0, 0, 0, 0,
                             (GLsizei)info->width, (GLsizei)info->height,
                             (GLsizei)info->arraySize);
        gl->BindTexture(target, 0);
        error = gl->GetError();
    }
    if (error) { /* also for images of another format than the one they are named by */
        blit(chain, image);
        error = gl->GetError();
    }
    chain->has_copy = error == GL_NO_ERROR;
    if (error)
        LOG_ONCE(&at->reported, REASON_GL_ERROR,
                 "a released image cannot be copied (OpenGL error 0x%x)", error);
}

/* The target is a pointer, or an offset in the bound pixel pack buffer. */
void swapchain_read(const swapchain *chain, const XrSwapchainSubImage *part,
                    uint32_t format, void *target) {
    gl_context *gl = &chain->session->gl;
    select_buffers(chain, format != 0);
    attach(chain, GL_READ_FRAMEBUFFER, chain->copy, (GLint)part->imageArrayIndex);
    gl->ReadPixels(part->imageRect.offset.x, part->imageRect.offset.y,
                   part->imageRect.extent.width, part->imageRect.extent.height,
                   format ? GL_RGBA : GL_DEPTH_COMPONENT,
                   format == 0                ? GL_FLOAT
                   : format == WIRE_LINEAR16F ? GL_HALF_FLOAT
                                              : GL_UNSIGNED_BYTE,
                   target);
    attach(chain, GL_READ_FRAMEBUFFER, 0, 0);
}
