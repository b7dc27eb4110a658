#version 330 core
// Projects the triangles of a scene.

uniform mat4 clip_from_world;
uniform vec4 planar_depth;        // its product with (x, y, z, 1) is the planar depth

in vec3 vertex_m;
in vec3 srgb;
in vec2 uv;

out vec3 vertex_srgb;
out vec2 vertex_uv;
out float vertex_depth_m;

void main()
{
    vec4 place = vec4(vertex_m, 1.0);
    gl_Position = clip_from_world * place;
    vertex_srgb = srgb;
    vertex_uv = uv;
    vertex_depth_m = dot(planar_depth, place);
}
