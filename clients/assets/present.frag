#version 330 core
// Draws an image and its depth into a headset's images.  Rows are flipped, because images
// have their top row first and OpenGL has its bottom row first.  Colors are sRGB already.

uniform sampler2D seen;
uniform sampler2D plain;          // shown to the left of the split
uniform sampler2D depth_m;        // planar; infinity for the background
uniform float plain_ratio;        // fraction of the width to the left of the split
uniform float near_m;
uniform ivec2 size_px;

layout(location = 0) out vec4 srgb;

void main()
{
    ivec2 place = ivec2(gl_FragCoord.xy);
    place.y = size_px.y - 1 - place.y;
    float split_px = plain_ratio * float(size_px.x);
    vec3 color = texelFetch(seen, place, 0).rgb;
    if (float(place.x) < split_px) color = texelFetch(plain, place, 0).rgb;
    // A line at the split.
    if (plain_ratio > 0.0 && abs(float(place.x) + 0.5 - split_px) < 1.0)
        color = vec3(1.0);
    srgb = vec4(color, 1.0);
    float depth = texelFetch(depth_m, place, 0).r;
    // The far plane is at infinity, where invalid depth is drawn, too.
    gl_FragDepth = depth >= near_m ? 1.0 - near_m / depth : (depth > 0.0 ? 0.0 : 1.0);
}
