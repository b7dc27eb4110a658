#version 330 core
// Resolves samples to pixels: the mean light, and the depth of one sample, a quarter of the way
// from the nearest to the farthest.  Rows are flipped, so that the image is read back with its top row first.
// The program defines SAMPLES per axis and the constants in capitals.  With LEAST_GAP_DPT
// defined, the samples are those of the hidden layer; only samples at least that far behind
// the visible surface count, and the depth is 0 where the pixel has none.  With LINEAR
// defined, samples and pixels hold linear light.

#define COUNT (SAMPLES * SAMPLES)

uniform sampler2D samples_light;  // decoded from sRGB by OpenGL
uniform sampler2D samples_per_m;  // 1 / planar depth, 0 for the background
#ifdef LEAST_GAP_DPT
uniform sampler2D seen_per_m;     // the same of the visible surface
#endif
uniform float infinite_to_per_m;  // values up to this count as background
uniform int last_row;

layout(location = 0) out vec4 srgb;
layout(location = 1) out float depth_m;

vec3 srgb_from_linear(vec3 light)
{
    vec3 curve = SRGB_GAIN * pow(light, vec3(1.0 / SRGB_POWER)) - (SRGB_GAIN - 1.0);
    return mix(curve, SRGB_SLOPE * light, lessThanEqual(light, vec3(SRGB_KNEE)));
}

float inverse_depth(sampler2D samples, ivec2 place)
{
    float per_m = texelFetch(samples, place, 0).r;
    return per_m > infinite_to_per_m ? per_m : 0.0;
}

// The value with `rank` larger ones, that is, nearer samples.
float ranked(float per_m[COUNT], int rank)
{
    for (int i = 0; i < COUNT; i++) {
        int nearer = 0;
        for (int j = 0; j < COUNT; j++)
            nearer += int(per_m[j] > per_m[i] || (per_m[j] == per_m[i] && j < i));
        if (nearer == rank) return per_m[i];
    }
    return per_m[0];
}

void main()
{
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    ivec2 first = SAMPLES * ivec2(pixel.x, last_row - pixel.y);
    vec3 sum = vec3(0.0);
    int count = 0;
    float per_m[COUNT];
#ifdef LEAST_GAP_DPT
    float seen[COUNT];
#endif
    for (int i = 0; i < COUNT; i++) {
        ivec2 place = first + ivec2(i % SAMPLES, i / SAMPLES);
        per_m[i] = inverse_depth(samples_per_m, place);
#ifdef LEAST_GAP_DPT
        seen[i] = inverse_depth(seen_per_m, place);
        if (seen[i] - per_m[i] < LEAST_GAP_DPT) {
            per_m[i] = -1.0;  // ranks last
            continue;
        }
#endif
        sum += texelFetch(samples_light, place, 0).rgb;
        count++;
    }
    srgb = vec4(sum / float(max(count, 1)), 1.0);
#ifndef LINEAR
    srgb.rgb = srgb_from_linear(srgb.rgb);
#endif
    float picked = ranked(per_m, count / 4);
#ifdef LEAST_GAP_DPT
    // A surface behind a sliver of a nearer one is visible in this pixel already.
    if (count == 0 || ranked(seen, COUNT / 4) - picked < LEAST_GAP_DPT) {
        depth_m = 0.0;
        return;
    }
#endif
    // A division by zero need not give infinity: its bits do.
    depth_m = picked > 0.0 ? 1.0 / picked : uintBitsToFloat(INFINITY_BITS);
}
