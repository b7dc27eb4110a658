// Color and depth of a frame in textures of the caller, with the row of the image's top
// first or last.
// COLOR_IS_ARRAY, DEPTH_IS_ARRAY: a layer of an array texture.
// Needs common/color.glsl.

#ifdef COLOR_IS_ARRAY
layout(binding = TEXTURE_COLOR) uniform sampler2DArray color_image;
#define COLOR_AT(place) textureLod(color_image, vec3(place, color_layer), 0.0)
#else
layout(binding = TEXTURE_COLOR) uniform sampler2D color_image;
#define COLOR_AT(place) textureLod(color_image, place, 0.0)
#endif
#ifdef DEPTH_IS_ARRAY
layout(binding = TEXTURE_DEPTH) uniform sampler2DArray depth_image;
#define DEPTH_FETCH(place) texelFetch(depth_image, ivec3(place, depth_layer), 0)
#else
layout(binding = TEXTURE_DEPTH) uniform sampler2D depth_image;
#define DEPTH_FETCH(place) texelFetch(depth_image, place, 0)
#endif

uniform int color_layer;
uniform int depth_layer;
uniform int color_is_encoded;     // sRGB values, which the sampler has not decoded
uniform vec2 inverse_depth;       // of a depth buffer: 1 / depth = x + y value
uniform int depth_is_projected;   // 0: planar depth in meters
uniform int is_top_first;

// Place in a texture of a pixel of the image, whose first row is the top.
ivec2 texture_place(ivec2 at, int height, int top_first) {
    return ivec2(at.x, top_first != 0 ? at.y : height - 1 - at.y);
}

// Linear light, and the texture's alpha.  Not a fetch of a texel, which would decode sRGB
// whatever the sampler says.
vec4 input_color(ivec2 at, ivec2 size) {
    vec2 place = vec2(texture_place(at, size.y, is_top_first)) + 0.5;
    vec4 color = COLOR_AT(place / vec2(size));
    if (color_is_encoded == 0) return color;
    return vec4(linear_from_srgb(whole_bytes(color.rgb)), color.a);
}

// Planar depth in meters; 0 or less, or NaN, where it is missing.
float input_depth_m(ivec2 at, ivec2 size) {
    float value = DEPTH_FETCH(texture_place(at, size.y, is_top_first)).r;
    if (depth_is_projected == 0) return value;
    float inverse = inverse_depth.x + inverse_depth.y * value;
    return inverse > 0.0 ? 1.0 / inverse : uintBitsToFloat(uint(FLOAT_INFINITY_BITS));
}
