#version 330 core
// Flat shading: the light is in the vertices.  They and the texture are multiplied as
// sRGB values, as pyrender does, so that both show the same.

uniform sampler2D surface;

in vec3 vertex_srgb;
in vec2 vertex_uv;
in float vertex_depth_m;

layout(location = 0) out vec4 srgb;
layout(location = 1) out float per_m;

void main()
{
    vec3 product = vertex_srgb * texture(surface, vertex_uv).rgb;
    srgb = vec4(clamp(product, 0.0, 1.0), 1.0);
    per_m = 1.0 / vertex_depth_m;
}
