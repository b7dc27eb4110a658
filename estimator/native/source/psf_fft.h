/* Stockham FFTs of sixteen columns at a time, with radices 2, 3, 4 and 5. */

#define STRIP 16

typedef struct { f32x8 re[2], im[2]; } strip_row; /* one row of a strip */

/* Transposes eight vectors of eight. */
INLINE void turn8(f32x8 v[8]) {
    f32x8 a[8], b[8];
    for (int i = 0; i < 8; i += 2) {
        a[i] = MIXED(v[i], v[i + 1], 0, 8, 1, 9, 4, 12, 5, 13);
        a[i + 1] = MIXED(v[i], v[i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    }
    for (int i = 0; i < 8; i += 4)
        for (int k = 0; k < 2; ++k) {
            b[i + 2 * k] = MIXED(a[i + k], a[i + k + 2], 0, 1, 8, 9, 4, 5, 12, 13);
            b[i + 2 * k + 1] = MIXED(a[i + k], a[i + k + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        }
    for (int i = 0; i < 4; ++i) {
        v[i] = MIXED(b[i], b[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        v[i + 4] = MIXED(b[i], b[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
}

INLINE void turned(strip_row *to, int h, f32x8 re, f32x8 im, float cosine, float sine) {
    to->re[h] = re * all8(cosine) - im * all8(sine);
    to->im[h] = re * all8(sine) + im * all8(cosine);
}

/* A step of a radix, from rows q + s (p + k m) to rows q + s (radix p + k); tw holds
 * exp(-2 pi i p / n) for the whole length, of which the step uses every s-th. */
static void fft_step2(const strip_row *from, strip_row *to, int m, int s, const float *tw) {
    for (int p = 0; p < m; ++p) {
        const float *w = tw + 2 * p * s;
        for (int q = 0; q < s; ++q) {
            const strip_row *a = from + q + s * p, *b = a + s * m;
            strip_row *out = to + q + s * 2 * p;
            for (int h = 0; h < 2; ++h) {
                f32x8 re = a->re[h] - b->re[h], im = a->im[h] - b->im[h];
                f32x8 sum_re = a->re[h] + b->re[h], sum_im = a->im[h] + b->im[h];
                out[0].re[h] = sum_re;
                out[0].im[h] = sum_im;
                turned(out + s, h, re, im, w[0], w[1]);
            }
        }
    }
}

static void fft_step4(const strip_row *from, strip_row *to, int m, int s, const float *tw) {
    for (int p = 0; p < m; ++p) {
        const float *w1 = tw + 2 * p * s, *w2 = tw + 4 * p * s, *w3 = tw + 6 * p * s;
        for (int q = 0; q < s; ++q) {
            const strip_row *a = from + q + s * p, *b = a + s * m, *c = b + s * m;
            const strip_row *d = c + s * m;
            strip_row *out = to + q + s * 4 * p;
            for (int h = 0; h < 2; ++h) {
                f32x8 ac_re = a->re[h] + c->re[h], ac_im = a->im[h] + c->im[h];
                f32x8 bd_re = b->re[h] + d->re[h], bd_im = b->im[h] + d->im[h];
                f32x8 a_c_re = a->re[h] - c->re[h], a_c_im = a->im[h] - c->im[h];
                f32x8 b_d_re = b->re[h] - d->re[h], b_d_im = b->im[h] - d->im[h];
                out[0].re[h] = ac_re + bd_re;
                out[0].im[h] = ac_im + bd_im;
                turned(out + s, h, a_c_re + b_d_im, a_c_im - b_d_re, w1[0], w1[1]);
                turned(out + 2 * s, h, ac_re - bd_re, ac_im - bd_im, w2[0], w2[1]);
                turned(out + 3 * s, h, a_c_re - b_d_im, a_c_im + b_d_re, w3[0], w3[1]);
            }
        }
    }
}

static void fft_step3(const strip_row *from, strip_row *to, int m, int s, const float *tw) {
    f32x8 half = all8(0.5f), root = all8(0.86602540378443865f);
    for (int p = 0; p < m; ++p) {
        const float *w1 = tw + 2 * p * s, *w2 = tw + 4 * p * s;
        for (int q = 0; q < s; ++q) {
            const strip_row *a = from + q + s * p, *b = a + s * m, *c = b + s * m;
            strip_row *out = to + q + s * 3 * p;
            for (int h = 0; h < 2; ++h) {
                f32x8 sum_re = b->re[h] + c->re[h], sum_im = b->im[h] + c->im[h];
                f32x8 by_re = root * (b->im[h] - c->im[h]);
                f32x8 by_im = root * (c->re[h] - b->re[h]);
                f32x8 at_re = a->re[h] - half * sum_re, at_im = a->im[h] - half * sum_im;
                out[0].re[h] = a->re[h] + sum_re;
                out[0].im[h] = a->im[h] + sum_im;
                turned(out + s, h, at_re + by_re, at_im + by_im, w1[0], w1[1]);
                turned(out + 2 * s, h, at_re - by_re, at_im - by_im, w2[0], w2[1]);
            }
        }
    }
}

static void fft_step5(const strip_row *from, strip_row *to, int m, int s, const float *tw) {
    f32x8 c1 = all8(0.30901699437494742f), c2 = all8(-0.80901699437494742f);
    f32x8 s1 = all8(0.95105651629515357f), s2 = all8(0.58778525229247313f);
    for (int p = 0; p < m; ++p)
        for (int q = 0; q < s; ++q) {
            const strip_row *a = from + q + s * p, *b = a + s * m, *c = b + s * m;
            const strip_row *d = c + s * m, *e = d + s * m;
            strip_row *out = to + q + s * 5 * p;
            for (int h = 0; h < 2; ++h) {
                f32x8 be_re = b->re[h] + e->re[h], be_im = b->im[h] + e->im[h];
                f32x8 cd_re = c->re[h] + d->re[h], cd_im = c->im[h] + d->im[h];
                f32x8 b_e_re = b->re[h] - e->re[h], b_e_im = b->im[h] - e->im[h];
                f32x8 c_d_re = c->re[h] - d->re[h], c_d_im = c->im[h] - d->im[h];
                out[0].re[h] = a->re[h] + be_re + cd_re;
                out[0].im[h] = a->im[h] + be_im + cd_im;
                f32x8 re1 = a->re[h] + c1 * be_re + c2 * cd_re;
                f32x8 im1 = a->im[h] + c1 * be_im + c2 * cd_im;
                f32x8 re2 = a->re[h] + c2 * be_re + c1 * cd_re;
                f32x8 im2 = a->im[h] + c2 * be_im + c1 * cd_im;
                f32x8 by1_re = s1 * b_e_im + s2 * c_d_im, by1_im = s1 * b_e_re + s2 * c_d_re;
                f32x8 by2_re = s2 * b_e_im - s1 * c_d_im, by2_im = s2 * b_e_re - s1 * c_d_re;
                const float *w = tw + 2 * p * s;
                turned(out + s, h, re1 + by1_re, im1 - by1_im, w[0], w[1]);
                w += 2 * p * s;
                turned(out + 2 * s, h, re2 + by2_re, im2 - by2_im, w[0], w[1]);
                w += 2 * p * s;
                turned(out + 3 * s, h, re2 - by2_re, im2 + by2_im, w[0], w[1]);
                w += 2 * p * s;
                turned(out + 4 * s, h, re1 - by1_re, im1 + by1_im, w[0], w[1]);
            }
        }
}

/* Transforms n rows; returns the buffer that has the result, one of the two. */
static strip_row *fft_strip(strip_row *rows, strip_row *other, int n, const float *tw) {
    int left = n, s = 1;
    while (left > 1) {
        int radix = left % 4 == 0 ? 4 : left % 2 == 0 ? 2 : left % 3 == 0 ? 3 : 5;
        int m = left / radix;
        if (radix == 4) fft_step4(rows, other, m, s, tw);
        else if (radix == 2) fft_step2(rows, other, m, s, tw);
        else if (radix == 3) fft_step3(rows, other, m, s, tw);
        else fft_step5(rows, other, m, s, tw);
        strip_row *swapped = rows;
        rows = other;
        other = swapped;
        s *= radix;
        left = m;
    }
    return rows;
}

/* Transposes a strip to columns: floats (STRIP, 2, padded), real before imaginary. */
static void turn_strip(const strip_row *rows, int n, size_t padded, float *to) {
    for (int first = 0; first < n; first += 8) /* lengths are multiples of eight */
        for (int h = 0; h < 2; ++h)
            for (int part = 0; part < 2; ++part) {
                f32x8 v[8];
                for (int i = 0; i < 8; ++i)
                    v[i] = part ? rows[first + i].im[h] : rows[first + i].re[h];
                turn8(v);
                for (int i = 0; i < 8; ++i)
                    store8(to + ((size_t)(8 * h + i) * 2 + (size_t)part) * padded + first,
                           v[i]);
            }
    for (size_t j = (size_t)n; j < padded; ++j)
        for (int i = 0; i < 2 * STRIP; ++i) to[(size_t)i * padded + j] = 0.0f;
}
