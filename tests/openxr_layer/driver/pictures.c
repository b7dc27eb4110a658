/* Known pictures with a known depth. */
#include "driver.h"

static const char VERTEX[] =
    "#version 330 core\n"
    "void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - "
    "1.0,"
    " 0, 1); }";
static const char FRAGMENT[] =
    "#version 330 core\n"
    "uniform ivec4 part; uniform int frame, view; uniform bool flipped, alpha, noise;\n"
    "uniform float depth; out vec4 color;\n"
    "void main() {\n"
    "  ivec2 at = ivec2(gl_FragCoord.xy) - part.xy;\n"
    "  if (flipped) at.y = part.w - 1 - at.y;\n"
    "  vec3 own = vec3(view == 0, view == 2, view == 1);\n"
    "  bool bit = ((frame >> (at.x / 4)) & 1) == 1;\n"
    "  bool is_number = at.y < 8 && at.x < 64;\n"
    "  color.rgb = is_number ? vec3(0, bit, 0)\n"
    "                        : ((at.x + frame) / 4) % 2 == 0 ? vec3(1) : own;\n"
    "  color.a = alpha ? float(at.x) / float(part.z) : 1.0;\n"
    "  float random = fract(sin(dot(vec2(at), vec2(12.9898, 78.233)) + float(frame))"
    " * 43758.5453);\n"
    "  gl_FragDepth = noise ? random : depth;\n"
    "}";

static GLuint program, vertex_array, framebuffer;

static GLuint compiled(GLenum kind, const char *text) {
    GLint ok;
    GLuint shader = glCreateShader(kind);
    glShaderSource(shader, 1, &text, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &ok);
    if (!ok) fail("glCompileShader", "a shader does not compile");
    return shader;
}

void make_drawing(void) {
    program = glCreateProgram();
    glAttachShader(program, compiled(GL_VERTEX_SHADER, VERTEX));
    glAttachShader(program, compiled(GL_FRAGMENT_SHADER, FRAGMENT));
    glLinkProgram(program);
    glGenVertexArrays(1, &vertex_array);
    glGenFramebuffers(1, &framebuffer);
}

/* Return what a depth buffer holds at a distance: 0 at nearZ, 1 at farZ. */
float window_depth(float z_m) {
    double near_z = (double)options.near_z, far_z = (double)options.far_z;
    double z = (double)z_m;
    if (isinf(far_z)) return (float)(1 - near_z / z);
    if (isinf(near_z)) return (float)(far_z / z);
    return (float)(far_z * (z - near_z) / (z * (far_z - near_z)));
}

void attach(GLenum point, GLuint texture, bool is_array, uint32_t layer) {
    glBindFramebuffer(GL_FRAMEBUFFER, framebuffer);
    if (is_array)
        glFramebufferTextureLayer(GL_FRAMEBUFFER, point, texture, 0, (GLint)layer);
    else glFramebufferTexture(GL_FRAMEBUFFER, point, texture, 0);
}

static GLint uniform(const char *name) { return glGetUniformLocation(program, name); }

/* Draw into what is attached. */
void draw_picture(const struct picture *picture) {
    const XrRect2Di *part = &picture->part;
    glUseProgram(program);
    glBindVertexArray(vertex_array);
    glUniform4i(uniform("part"), part->offset.x, part->offset.y, part->extent.width,
                part->extent.height);
    glUniform1i(uniform("frame"), picture->frame);
    glUniform1i(uniform("view"), picture->view);
    glUniform1i(uniform("flipped"), picture->is_flipped);
    glUniform1i(uniform("alpha"), picture->has_alpha);
    glUniform1i(uniform("noise"), picture->has_noise);
    glUniform1f(uniform("depth"), picture->depth);
    glViewport(part->offset.x, part->offset.y, part->extent.width, part->extent.height);
    glDrawArrays(GL_TRIANGLES, 0, 3);
}
