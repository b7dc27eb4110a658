#version 330 core
// Pixels from their samples: the mean light and the depth of one sample, that of rank
// RANK from the nearest.  Rows are turned: what is read back has the top row first.
// The program defines SAMPLES, those per axis, COUNT, its square, and all other numbers.

uniform sampler2D samples_light;  // OpenGL decodes its sRGB
uniform sampler2D samples_per_m;  // 1 / planar depth, 0 where nothing is
uniform float infinite_to_per_m;  // what is no nearer counts as background
uniform int last_row;

layout(location = 0) out vec4 srgb;
layout(location = 1) out float depth_m;

vec3 srgb_from_linear(vec3 light)
{
    vec3 curve = SRGB_GAIN * pow(light, vec3(1.0 / SRGB_POWER)) - (SRGB_GAIN - 1.0);
    return mix(curve, SRGB_SLOPE * light, lessThanEqual(light, vec3(SRGB_KNEE)));
}

void main()
{
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    ivec2 first = SAMPLES * ivec2(pixel.x, last_row - pixel.y);
    vec3 sum = vec3(0.0);
    float per_m[COUNT];
    for (int i = 0; i < COUNT; i++) {
        ivec2 place = first + ivec2(i % SAMPLES, i / SAMPLES);
        sum += texelFetch(samples_light, place, 0).rgb;
        per_m[i] = texelFetch(samples_per_m, place, 0).r;
    }
    float picked = per_m[0];
    for (int i = 0; i < COUNT; i++) {
        int nearer = 0;
        for (int j = 0; j < COUNT; j++)
            nearer += int(per_m[j] > per_m[i] || (per_m[j] == per_m[i] && j < i));
        if (nearer == RANK) picked = per_m[i];
    }
    srgb = vec4(srgb_from_linear(sum / float(COUNT)), 1.0);
    // Division by zero need not give infinity: its bits do.
    depth_m = picked > infinite_to_per_m ? 1.0 / picked : uintBitsToFloat(INFINITY_BITS);
}
