/* State of OpenGL that calls of OpenXR must leave alone. */
#include "driver.h"

#define LIST(name) {#name, name}
static const struct {
    const char *name;
    GLenum value;
} STATES[] = {
    LIST(GL_CURRENT_PROGRAM),
    LIST(GL_VERTEX_ARRAY_BINDING),
    LIST(GL_ARRAY_BUFFER_BINDING),
    LIST(GL_ELEMENT_ARRAY_BUFFER_BINDING),
    LIST(GL_PIXEL_PACK_BUFFER_BINDING),
    LIST(GL_PIXEL_UNPACK_BUFFER_BINDING),
    LIST(GL_UNIFORM_BUFFER_BINDING),
    LIST(GL_TRANSFORM_FEEDBACK_BUFFER_BINDING),
    LIST(GL_COPY_READ_BUFFER_BINDING),
    LIST(GL_COPY_WRITE_BUFFER_BINDING),
    LIST(GL_SHADER_STORAGE_BUFFER_BINDING),
    LIST(GL_DRAW_INDIRECT_BUFFER_BINDING),
    LIST(GL_DISPATCH_INDIRECT_BUFFER_BINDING),
    LIST(GL_ATOMIC_COUNTER_BUFFER_BINDING),
    LIST(GL_PROGRAM_PIPELINE_BINDING),
    LIST(GL_DRAW_FRAMEBUFFER_BINDING),
    LIST(GL_READ_FRAMEBUFFER_BINDING),
    LIST(GL_RENDERBUFFER_BINDING),
    LIST(GL_DRAW_BUFFER),
    LIST(GL_READ_BUFFER),
    LIST(GL_ACTIVE_TEXTURE),
    LIST(GL_VIEWPORT),
    LIST(GL_SCISSOR_BOX),
    LIST(GL_DEPTH_RANGE),
    LIST(GL_COLOR_WRITEMASK),
    LIST(GL_DEPTH_WRITEMASK),
    LIST(GL_DEPTH_FUNC),
    LIST(GL_STENCIL_WRITEMASK),
    LIST(GL_STENCIL_BACK_WRITEMASK),
    LIST(GL_STENCIL_FUNC),
    LIST(GL_STENCIL_REF),
    LIST(GL_STENCIL_VALUE_MASK),
    LIST(GL_STENCIL_FAIL),
    LIST(GL_STENCIL_PASS_DEPTH_FAIL),
    LIST(GL_STENCIL_PASS_DEPTH_PASS),
    LIST(GL_BLEND_SRC_RGB),
    LIST(GL_BLEND_DST_RGB),
    LIST(GL_BLEND_SRC_ALPHA),
    LIST(GL_BLEND_DST_ALPHA),
    LIST(GL_BLEND_EQUATION_RGB),
    LIST(GL_BLEND_EQUATION_ALPHA),
    LIST(GL_BLEND_COLOR),
    LIST(GL_CULL_FACE_MODE),
    LIST(GL_FRONT_FACE),
    LIST(GL_POLYGON_MODE),
    LIST(GL_POLYGON_OFFSET_FACTOR),
    LIST(GL_POLYGON_OFFSET_UNITS),
    LIST(GL_COLOR_CLEAR_VALUE),
    LIST(GL_DEPTH_CLEAR_VALUE),
    LIST(GL_STENCIL_CLEAR_VALUE),
    LIST(GL_LOGIC_OP_MODE),
    LIST(GL_SAMPLE_COVERAGE_VALUE),
    LIST(GL_POINT_SIZE),
    LIST(GL_PACK_ALIGNMENT),
    LIST(GL_PACK_ROW_LENGTH),
    LIST(GL_PACK_SKIP_ROWS),
    LIST(GL_PACK_SKIP_PIXELS),
    LIST(GL_PACK_IMAGE_HEIGHT),
    LIST(GL_PACK_SKIP_IMAGES),
    LIST(GL_PACK_SWAP_BYTES),
    LIST(GL_UNPACK_ALIGNMENT),
    LIST(GL_UNPACK_ROW_LENGTH),
    LIST(GL_UNPACK_SKIP_ROWS),
    LIST(GL_UNPACK_SKIP_PIXELS),
    LIST(GL_UNPACK_IMAGE_HEIGHT),
    LIST(GL_UNPACK_SKIP_IMAGES),
    LIST(GL_UNPACK_SWAP_BYTES),
    LIST(GL_BLEND),
    LIST(GL_DEPTH_TEST),
    LIST(GL_STENCIL_TEST),
    LIST(GL_SCISSOR_TEST),
    LIST(GL_CULL_FACE),
    LIST(GL_FRAMEBUFFER_SRGB),
    LIST(GL_MULTISAMPLE),
    LIST(GL_SAMPLE_COVERAGE),
    LIST(GL_SAMPLE_ALPHA_TO_COVERAGE),
    LIST(GL_SAMPLE_MASK),
    LIST(GL_DITHER),
    LIST(GL_COLOR_LOGIC_OP),
    LIST(GL_POLYGON_OFFSET_FILL),
    LIST(GL_DEPTH_CLAMP),
    LIST(GL_RASTERIZER_DISCARD),
    LIST(GL_PRIMITIVE_RESTART),
    LIST(GL_PROGRAM_POINT_SIZE),
    LIST(GL_TEXTURE_CUBE_MAP_SEAMLESS),
    LIST(GL_CLIP_DISTANCE0),
    LIST(GL_CLIP_ORIGIN),
    LIST(GL_CLIP_DEPTH_MODE),
};
static const struct {
    const char *name;
    GLenum value;
} UNIT_STATES[] = {
    LIST(GL_TEXTURE_BINDING_2D),
    LIST(GL_TEXTURE_BINDING_2D_ARRAY),
    LIST(GL_TEXTURE_BINDING_3D),
    LIST(GL_TEXTURE_BINDING_CUBE_MAP),
    LIST(GL_TEXTURE_BINDING_RECTANGLE),
    LIST(GL_TEXTURE_BINDING_BUFFER),
    LIST(GL_TEXTURE_BINDING_2D_MULTISAMPLE),
    LIST(GL_TEXTURE_BINDING_2D_MULTISAMPLE_ARRAY),
    LIST(GL_SAMPLER_BINDING),
};
enum { N_STATES = LENGTH(STATES), N_UNIT_STATES = LENGTH(UNIT_STATES) };
_Static_assert(N_STATES <= (int)MAX_STATES && N_UNIT_STATES <= (int)MAX_UNIT_STATES,
               "a snapshot holds all");

static bool is_known[N_STATES], is_unit_known[N_UNIT_STATES];

bool has_context(void) { return eglGetCurrentContext() || glXGetCurrentContext(); }

void read_state(struct snapshot *to) {
    memset(to, 0, sizeof *to);
    void *current[] = {eglGetCurrentDisplay(),
                       eglGetCurrentContext(),
                       eglGetCurrentSurface(EGL_DRAW),
                       eglGetCurrentSurface(EGL_READ),
                       glXGetCurrentDisplay(),
                       glXGetCurrentContext(),
                       (void *)(uintptr_t)glXGetCurrentDrawable(),
                       (void *)(uintptr_t)glXGetCurrentReadDrawable()};
    memcpy(to->current, current, sizeof current);
    to->api = eglQueryAPI();
    if (!has_context()) return;
    to->error = glGetError();
    for (int i = 0; i < N_STATES; i++)
        if (is_known[i]) glGetFloatv(STATES[i].value, to->values[i]);
    GLint active;
    glGetIntegerv(GL_ACTIVE_TEXTURE, &active);
    for (int unit = 0; unit < N_UNITS; unit++) {
        glActiveTexture(GL_TEXTURE0 + (GLenum)unit);
        for (int i = 0; i < N_UNIT_STATES; i++)
            if (is_unit_known[i])
                glGetIntegerv(UNIT_STATES[i].value, &to->units[unit][i]);
    }
    glActiveTexture((GLenum)active);
    for (GLuint i = 0; i < 4; i++)
        glGetIntegeri_v(GL_UNIFORM_BUFFER_BINDING, i, &to->uniform_buffers[i]);
    glGetQueryiv(GL_SAMPLES_PASSED, GL_CURRENT_QUERY, &to->query);
}

/* Fail with the first difference; where the context is another one, all else is too. */
void compare_states(const char *call, const struct snapshot *a,
                    const struct snapshot *b) {
    static const char *const CURRENT[] = {"display", "context", "draw surface",
                                          "read surface"};
    char why[128] = "";
#define DIFFER(differs, ...) \
    if (!*why && (differs)) snprintf(why, sizeof why, __VA_ARGS__)
    for (int i = 0; i < 8; i++)
        DIFFER(a->current[i] != b->current[i], "the current %s changed",
               CURRENT[i % 4]);
    DIFFER(a->api != b->api, "EGL's API changed");
    DIFFER(a->error, "OpenGL's error 0x%x before it", a->error);
    DIFFER(b->error, "OpenGL's error 0x%x", b->error);
    for (int i = 0; i < N_STATES; i++)
        DIFFER(memcmp(a->values[i], b->values[i], sizeof a->values[i]),
               "%s was %g, is %g", STATES[i].name, (double)a->values[i][0],
               (double)b->values[i][0]);
    for (int unit = 0; unit < N_UNITS; unit++)
        for (int i = 0; i < N_UNIT_STATES; i++)
            DIFFER(a->units[unit][i] != b->units[unit][i],
                   "%s of unit %d was %d, is %d", UNIT_STATES[i].name, unit,
                   a->units[unit][i], b->units[unit][i]);
    for (int i = 0; i < 4; i++)
        DIFFER(a->uniform_buffers[i] != b->uniform_buffers[i],
               "uniform buffer %d was %d, is %d", i, a->uniform_buffers[i],
               b->uniform_buffers[i]);
    DIFFER(a->query != b->query, "the query was %d, is %d", a->query, b->query);
    if (*why) fail(call, why);
}

static GLuint made[8]; /* objects that are bound while calls are made */

void make_unusual_objects(void) {
    for (int i = 0; i < N_STATES; i++) { /* some came with later versions of OpenGL */
        GLfloat values[16];
        glGetFloatv(STATES[i].value, values);
        is_known[i] = glGetError() == GL_NO_ERROR;
    }
    for (int i = 0; i < N_UNIT_STATES; i++) {
        GLint value;
        glGetIntegerv(UNIT_STATES[i].value, &value);
        is_unit_known[i] = glGetError() == GL_NO_ERROR;
    }
    glGenTextures(3, made);
    glGenBuffers(1, &made[3]);
    glGenSamplers(1, &made[4]);
    glGenRenderbuffers(1, &made[5]);
    glGenQueries(1, &made[6]);
}

/* Set what a layer might rely on, or change, to values that are not the defaults. */
void set_unusual_state(void) {
    static const GLenum BUFFERS[] = {GL_ARRAY_BUFFER,        GL_PIXEL_PACK_BUFFER,
                                     GL_PIXEL_UNPACK_BUFFER, GL_UNIFORM_BUFFER,
                                     GL_COPY_READ_BUFFER,    GL_COPY_WRITE_BUFFER};
    static const GLenum TOGGLES[] = {
        GL_BLEND,     GL_DEPTH_TEST,       GL_STENCIL_TEST,       GL_SCISSOR_TEST,
        GL_CULL_FACE, GL_FRAMEBUFFER_SRGB, GL_RASTERIZER_DISCARD, GL_SAMPLE_COVERAGE};
    for (size_t i = 0; i < LENGTH(BUFFERS); i++) glBindBuffer(BUFFERS[i], made[3]);
    for (size_t i = 0; i < LENGTH(TOGGLES); i++) glEnable(TOGGLES[i]);
    for (GLuint unit = 0; unit < N_UNITS; unit++) {
        glActiveTexture(GL_TEXTURE0 + unit);
        glBindTexture(GL_TEXTURE_2D, made[0]);
        glBindTexture(GL_TEXTURE_2D_ARRAY, made[1]);
        glBindTexture(GL_TEXTURE_2D_MULTISAMPLE, made[2]);
        glBindSampler(unit, made[4]);
    }
    glActiveTexture(GL_TEXTURE3);
    glBindBufferBase(GL_UNIFORM_BUFFER, 1, made[3]);
    glBindRenderbuffer(GL_RENDERBUFFER, made[5]);
    glViewport(3, 5, 7, 11);
    glScissor(1, 2, 3, 4);
    glDepthRange(0.25, 0.75);
    glColorMask(GL_TRUE, GL_FALSE, GL_TRUE, GL_FALSE);
    glDepthMask(GL_FALSE);
    glDepthFunc(GL_GEQUAL);
    glStencilFunc(GL_NOTEQUAL, 3, 0x55);
    glStencilMask(0x0f);
    glBlendFuncSeparate(GL_ONE, GL_SRC_ALPHA, GL_ZERO, GL_DST_COLOR);
    glBlendEquation(GL_FUNC_REVERSE_SUBTRACT);
    glBlendColor(0.1f, 0.2f, 0.3f, 0.4f);
    glCullFace(GL_FRONT);
    glFrontFace(GL_CW);
    glPolygonMode(GL_FRONT_AND_BACK, GL_LINE);
    glClearColor(0.5f, 0.25f, 0.125f, 1);
    glClearDepth(0.5);
    glClearStencil(7);
    glSampleCoverage(0.5f, GL_TRUE);
    glPixelStorei(GL_PACK_ALIGNMENT, 8);
    glPixelStorei(GL_PACK_ROW_LENGTH, 77);
    glPixelStorei(GL_UNPACK_ALIGNMENT, 2);
    glPixelStorei(GL_UNPACK_ROW_LENGTH, 55);
    glPixelStorei(GL_UNPACK_SKIP_PIXELS, 1);
    glBeginQuery(GL_SAMPLES_PASSED, made[6]);
}

void set_usual_state(void) {
    static const GLenum OFF[] = {
        GL_BLEND,          GL_STENCIL_TEST,     GL_CULL_FACE,
        GL_SCISSOR_TEST,   GL_FRAMEBUFFER_SRGB, GL_RASTERIZER_DISCARD,
        GL_SAMPLE_COVERAGE};
    for (size_t i = 0; i < LENGTH(OFF); i++) glDisable(OFF[i]);
    for (GLuint unit = 0; unit < N_UNITS; unit++) glBindSampler(unit, 0);
    glEnable(GL_DEPTH_TEST); /* without it no depth is written */
    glDepthFunc(GL_ALWAYS);
    glDepthMask(GL_TRUE);
    glDepthRange(0, 1);
    glColorMask(GL_TRUE, GL_TRUE, GL_TRUE, GL_TRUE);
    glPolygonMode(GL_FRONT_AND_BACK, GL_FILL);
    glBindBuffer(GL_PIXEL_UNPACK_BUFFER, 0);
    glPixelStorei(GL_UNPACK_ALIGNMENT, 4);
    glPixelStorei(GL_UNPACK_ROW_LENGTH, 0);
    glPixelStorei(GL_UNPACK_SKIP_PIXELS, 0);
    glActiveTexture(GL_TEXTURE0);
    glEndQuery(GL_SAMPLES_PASSED);
}

double now_ms(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return 1e3 * (double)now.tv_sec + 1e-6 * (double)now.tv_nsec;
}
