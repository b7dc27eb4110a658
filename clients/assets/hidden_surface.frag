#version 330 core
// pyrender's flat shading, of what lies behind the surface that is seen: the second
// picture of a depth peeling.  Surfaces that face away and are less than twice as far are
// left out: the far side of the thing that is seen, which shows itself to nobody.

struct Material {
    vec4 base_color_factor;
#ifdef HAS_BASE_COLOR_TEX
    sampler2D base_color_texture;
#endif
};

uniform Material material;
uniform sampler2D seen_per_m;     // 1 / planar depth of what is seen
uniform float least_gap_dpt;
uniform vec2 depth_range_m;       // of the camera: near, far

#ifdef TEXCOORD_0_LOC
in vec2 uv_0;
#endif
#ifdef COLOR_0_LOC
in vec4 color_multiplier;
#endif

out vec4 frag_color;

void main()
{
    // 1 / depth is linear in the depth buffer.
    float per_m = mix(1.0 / depth_range_m.x, 1.0 / depth_range_m.y, gl_FragCoord.z);
    float seen = texelFetch(seen_per_m, ivec2(gl_FragCoord.xy), 0).r;
    bool is_far_side = !gl_FrontFacing && 2.0 * per_m > seen;
    if (is_far_side || seen - per_m < least_gap_dpt) discard;
    vec4 base_color = material.base_color_factor;
#ifdef HAS_BASE_COLOR_TEX
    base_color = base_color * texture(material.base_color_texture, uv_0);
#endif
#ifdef COLOR_0_LOC
    base_color *= color_multiplier;
#endif
    frag_color = clamp(base_color, 0.0, 1.0);
}
