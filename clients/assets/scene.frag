#version 330 core
// Flat shading: the light is baked into the vertices.  It is multiplied by the texture in
// sRGB values.  With LEAST_GAP_DPT defined, the shader renders the hidden layer: it discards
// fragments that are less than that behind the visible surface, and back faces that are less
// than twice as far away, because these are the far side of the visible object.  With LINEAR
// defined, it writes linear light, which may exceed 1.

uniform sampler2D surface;
#ifdef LEAST_GAP_DPT
uniform sampler2D seen_per_m;     // 1 / planar depth of the visible surface
#endif

in vec3 vertex_srgb;
in vec2 vertex_uv;
in float vertex_depth_m;

layout(location = 0) out vec4 srgb;
layout(location = 1) out float per_m;

void main()
{
    per_m = 1.0 / vertex_depth_m;
#ifdef LEAST_GAP_DPT
    float seen = texelFetch(seen_per_m, ivec2(gl_FragCoord.xy), 0).r;
    bool is_far_side = !gl_FrontFacing && 2.0 * per_m > seen;
    if (is_far_side || seen - per_m < LEAST_GAP_DPT) discard;
#endif
    vec3 product = vertex_srgb * texture(surface, vertex_uv).rgb;
#ifdef LINEAR
    product = max(product, 0.0);
    vec3 curve = pow((product + (SRGB_GAIN - 1.0)) / SRGB_GAIN, vec3(SRGB_POWER));
    bvec3 is_dark = lessThanEqual(product, vec3(SRGB_SLOPE * SRGB_KNEE));
    srgb = vec4(mix(curve, product / SRGB_SLOPE, is_dark), 1.0);
#else
    srgb = vec4(clamp(product, 0.0, 1.0), 1.0);
#endif
}
