// Fourier transform of FFT_LENGTH samples by FFT_THREADS threads: Stockham's order, the
// radices FFT_RADIX_0, FFT_RADIX_1 and, unless it is 1, FFT_RADIX_2 in registers, and an
// exchange through shared memory between them.  FFT_LINES lines a work group; each thread
// transforms two lines at once, one in .xy and one in .zw, for a memory access costs its
// address more than its width.  Source: Govindaraju et al. 2008, "High performance
// discrete Fourier transforms on graphics processors", section 4.

shared vec4 fft_exchange[FFT_LINES * FFT_LENGTH];

const float FFT_TURN = 6.28318530717958648;
const float FFT_HALF_ROOT_2 = 0.70710678118654752;
const float FFT_HALF_ROOT_3 = 0.86602540378443865;
const float FFT_COS_8 = 0.92387953251128674;  // of an eighth of pi
const float FFT_SIN_8 = 0.38268343236508977;

// Both complex numbers times w, and times -i.
vec4 fft_turned(vec4 v, vec2 w) {
    return vec4(v.x * w.x - v.y * w.y, v.x * w.y + v.y * w.x,
                v.z * w.x - v.w * w.y, v.z * w.y + v.w * w.x);
}

vec4 fft_quarter(vec4 v) { return vec4(v.y, -v.x, v.w, -v.z); }

void fft_dft4(inout vec4 a, inout vec4 b, inout vec4 c, inout vec4 d) {
    vec4 sum_ac = a + c;
    vec4 sum_bd = b + d;
    vec4 difference_ac = a - c;
    vec4 difference_bd = fft_quarter(b - d);
    a = sum_ac + sum_bd;
    b = difference_ac + difference_bd;
    c = sum_ac - sum_bd;
    d = difference_ac - difference_bd;
}

void fft_dft3(inout vec4 a, inout vec4 b, inout vec4 c) {
    vec4 sum = b + c;
    vec4 difference = fft_quarter(b - c) * FFT_HALF_ROOT_3;
    vec4 middle = a - 0.5 * sum;
    a += sum;
    b = middle + difference;
    c = middle - difference;
}

void fft_dft(inout vec4 v[4]) { fft_dft4(v[0], v[1], v[2], v[3]); }

void fft_dft(inout vec4 v[6]) {
    vec4 e0 = v[0] + v[3], e1 = v[1] + v[4], e2 = v[2] + v[5];
    vec4 o0 = v[0] - v[3], o1 = v[1] - v[4], o2 = v[2] - v[5];
    o1 = fft_turned(o1, vec2(0.5, -FFT_HALF_ROOT_3));
    o2 = fft_turned(o2, vec2(-0.5, -FFT_HALF_ROOT_3));
    fft_dft3(e0, e1, e2);
    fft_dft3(o0, o1, o2);
    v[0] = e0; v[1] = o0; v[2] = e1; v[3] = o1; v[4] = e2; v[5] = o2;
}

void fft_dft(inout vec4 v[8]) {
    vec4 e0 = v[0] + v[4], e1 = v[1] + v[5], e2 = v[2] + v[6], e3 = v[3] + v[7];
    vec4 o0 = v[0] - v[4], o1 = v[1] - v[5], o2 = v[2] - v[6], o3 = v[3] - v[7];
    o1 = fft_turned(o1, vec2(FFT_HALF_ROOT_2, -FFT_HALF_ROOT_2));
    o2 = fft_quarter(o2);
    o3 = fft_turned(o3, vec2(-FFT_HALF_ROOT_2, -FFT_HALF_ROOT_2));
    fft_dft4(e0, e1, e2, e3);
    fft_dft4(o0, o1, o2, o3);
    v[0] = e0; v[1] = o0; v[2] = e1; v[3] = o1;
    v[4] = e2; v[5] = o2; v[6] = e3; v[7] = o3;
}

void fft_dft(inout vec4 v[12]) {
    fft_dft3(v[0], v[4], v[8]);
    fft_dft3(v[1], v[5], v[9]);
    fft_dft3(v[2], v[6], v[10]);
    fft_dft3(v[3], v[7], v[11]);
    vec4 a5 = fft_turned(v[5], vec2(FFT_HALF_ROOT_3, -0.5));
    vec4 a9 = fft_turned(v[9], vec2(0.5, -FFT_HALF_ROOT_3));
    vec4 a6 = fft_turned(v[6], vec2(0.5, -FFT_HALF_ROOT_3));
    vec4 a10 = fft_turned(v[10], vec2(-0.5, -FFT_HALF_ROOT_3));
    vec4 a7 = fft_quarter(v[7]);
    vec4 a11 = -v[11];
    fft_dft4(v[0], v[1], v[2], v[3]);
    fft_dft4(v[4], a5, a6, a7);
    fft_dft4(v[8], a9, a10, a11);
    vec4 n0 = v[0], n3 = v[1], n6 = v[2], n9 = v[3], n1 = v[4], n2 = v[8];
    v[0] = n0; v[1] = n1; v[2] = n2; v[3] = n3; v[4] = a5; v[5] = a9;
    v[6] = n6; v[7] = a6; v[8] = a10; v[9] = n9; v[10] = a7; v[11] = a11;
}

void fft_dft(inout vec4 v[16]) {
    fft_dft4(v[0], v[4], v[8], v[12]);
    fft_dft4(v[1], v[5], v[9], v[13]);
    fft_dft4(v[2], v[6], v[10], v[14]);
    fft_dft4(v[3], v[7], v[11], v[15]);
    const vec2 w1 = vec2(FFT_COS_8, -FFT_SIN_8);
    const vec2 w2 = vec2(FFT_HALF_ROOT_2, -FFT_HALF_ROOT_2);
    const vec2 w3 = vec2(FFT_SIN_8, -FFT_COS_8);
    const vec2 w6 = vec2(-FFT_HALF_ROOT_2, -FFT_HALF_ROOT_2);
    v[5] = fft_turned(v[5], w1);
    v[6] = fft_turned(v[6], w2);
    v[7] = fft_turned(v[7], w3);
    v[9] = fft_turned(v[9], w2);
    v[10] = fft_quarter(v[10]);
    v[11] = fft_turned(v[11], w6);
    v[13] = fft_turned(v[13], w3);
    v[14] = fft_turned(v[14], w6);
    v[15] = fft_turned(v[15], -w1);
    fft_dft4(v[0], v[1], v[2], v[3]);
    fft_dft4(v[4], v[5], v[6], v[7]);
    fft_dft4(v[8], v[9], v[10], v[11]);
    fft_dft4(v[12], v[13], v[14], v[15]);
    vec4 t;  // columns become rows
    t = v[1]; v[1] = v[4]; v[4] = t;
    t = v[2]; v[2] = v[8]; v[8] = t;
    t = v[3]; v[3] = v[12]; v[12] = t;
    t = v[6]; v[6] = v[9]; v[9] = t;
    t = v[7]; v[7] = v[13]; v[13] = t;
    t = v[11]; v[11] = v[14]; v[14] = t;
}

// Between two radices: thread j of a line puts its results where the next one looks;
// `before` is the product of the radices that are done.
#define FFT_DEFINE_MOVES(RADIX) \
    void fft_put(vec4 v[RADIX], int line, int j, int before) { \
        if (j >= FFT_LENGTH / RADIX) return; \
        int low = j % before; \
        int to = line * FFT_LENGTH + (j - low) * RADIX + low; \
        for (int r = 0; r < RADIX; ++r) fft_exchange[to + r * before] = v[r]; \
    } \
    void fft_take(out vec4 v[RADIX], int line, int j, int before) { \
        int low = j % before; \
        float angle = -FFT_TURN * float(low) / float(before * RADIX); \
        vec2 step_turn = vec2(cos(angle), sin(angle)); \
        vec2 turn = step_turn; \
        int from = line * FFT_LENGTH + min(j, FFT_LENGTH / RADIX - 1); \
        v[0] = fft_exchange[from]; \
        for (int r = 1; r < RADIX; ++r) { \
            v[r] = fft_turned(fft_exchange[from + r * (FFT_LENGTH / RADIX)], turn); \
            turn = vec2(turn.x * step_turn.x - turn.y * step_turn.y, \
                        turn.x * step_turn.y + turn.y * step_turn.x); \
        } \
    }

FFT_DEFINE_MOVES(4)
FFT_DEFINE_MOVES(6)
FFT_DEFINE_MOVES(8)
FFT_DEFINE_MOVES(12)
FFT_DEFINE_MOVES(16)

#if FFT_RADIX_2 > 1
#define FFT_LAST FFT_RADIX_2
#else
#define FFT_LAST FFT_RADIX_1
#endif

// From samples j + r * FFT_LENGTH / FFT_RADIX_0 of a line to frequencies
// j + r * FFT_LENGTH / FFT_LAST.  All threads of the group must come here.
void fft_transform(inout vec4 first[FFT_RADIX_0], int line, int j,
                   out vec4 last[FFT_LAST]) {
    fft_dft(first);
    fft_put(first, line, j, 1);
    barrier();
#if FFT_RADIX_2 > 1
    vec4 middle[FFT_RADIX_1];
    fft_take(middle, line, j, FFT_RADIX_0);
    fft_dft(middle);
    barrier();
    fft_put(middle, line, j, FFT_RADIX_0);
    barrier();
    fft_take(last, line, j, FFT_RADIX_0 * FFT_RADIX_1);
#else
    fft_take(last, line, j, FFT_RADIX_0);
#endif
    fft_dft(last);
}
