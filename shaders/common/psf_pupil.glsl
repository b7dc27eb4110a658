// Polynomials and amplitudes over a pupil.  The 28 coefficients of a record lie by powers
// of x and within them of y: 1 y .. y^6, x xy .. xy^5, and so on.

#define PSF_C(k) p[(k) / 4][(k) % 4]

// Coefficients in x of W for two rows y.
void psf_row_values(vec4 p[7], vec2 y, out vec2 row[7]) {
    row[0] = PSF_C(0) + y * (PSF_C(1) + y * (PSF_C(2) + y * (PSF_C(3)
           + y * (PSF_C(4) + y * (PSF_C(5) + y * PSF_C(6))))));
    row[1] = PSF_C(7) + y * (PSF_C(8) + y * (PSF_C(9) + y * (PSF_C(10)
           + y * (PSF_C(11) + y * PSF_C(12)))));
    row[2] = PSF_C(13) + y * (PSF_C(14) + y * (PSF_C(15) + y * (PSF_C(16) + y * PSF_C(17))));
    row[3] = PSF_C(18) + y * (PSF_C(19) + y * (PSF_C(20) + y * PSF_C(21)));
    row[4] = PSF_C(22) + y * (PSF_C(23) + y * PSF_C(24));
    row[5] = PSF_C(25) + y * PSF_C(26);
    row[6] = vec2(PSF_C(27));
}

// Coefficients in x of W (c), dW/dy (d) and d²W/dy² (e) for one row y.
void psf_row_slopes(vec4 p[7], float y, out float c[7], out float d[6], out float e[5]) {
    vec2 values[7];
    psf_row_values(p, vec2(y), values);
    for (int a = 0; a < 7; ++a) c[a] = values[a].x;
    d[0] = PSF_C(1) + y * (2.0 * PSF_C(2) + y * (3.0 * PSF_C(3) + y * (4.0 * PSF_C(4)
         + y * (5.0 * PSF_C(5) + y * 6.0 * PSF_C(6)))));
    d[1] = PSF_C(8) + y * (2.0 * PSF_C(9) + y * (3.0 * PSF_C(10) + y * (4.0 * PSF_C(11)
         + y * 5.0 * PSF_C(12))));
    d[2] = PSF_C(14) + y * (2.0 * PSF_C(15) + y * (3.0 * PSF_C(16) + y * 4.0 * PSF_C(17)));
    d[3] = PSF_C(19) + y * (2.0 * PSF_C(20) + y * 3.0 * PSF_C(21));
    d[4] = PSF_C(23) + y * 2.0 * PSF_C(24);
    d[5] = PSF_C(26);
    e[0] = 2.0 * PSF_C(2) + y * (6.0 * PSF_C(3) + y * (12.0 * PSF_C(4)
         + y * (20.0 * PSF_C(5) + y * 30.0 * PSF_C(6))));
    e[1] = 2.0 * PSF_C(9) + y * (6.0 * PSF_C(10) + y * (12.0 * PSF_C(11)
         + y * 20.0 * PSF_C(12)));
    e[2] = 2.0 * PSF_C(15) + y * (6.0 * PSF_C(16) + y * 12.0 * PSF_C(17));
    e[3] = 2.0 * PSF_C(20) + y * 6.0 * PSF_C(21);
    e[4] = 2.0 * PSF_C(24);
}

// Slope (x, y) of W at x in the row; `curvature` gets its xx, xy and yy derivatives.
vec2 psf_slope(float c[7], float d[6], float e[5], float x, out vec3 curvature) {
    float sx = c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4]
             + x * (5.0 * c[5] + x * 6.0 * c[6]))));
    float sy = d[0] + x * (d[1] + x * (d[2] + x * (d[3] + x * (d[4] + x * d[5]))));
    curvature.x = 2.0 * c[2] + x * (6.0 * c[3] + x * (12.0 * c[4] + x * (20.0 * c[5]
                + x * 30.0 * c[6])));
    curvature.y = d[1] + x * (2.0 * d[2] + x * (3.0 * d[3] + x * (4.0 * d[4]
                + x * 5.0 * d[5])));
    curvature.z = e[0] + x * (e[1] + x * (e[2] + x * (e[3] + x * e[4])));
    return vec2(sx, sy);
}

// Logarithm of the apodisation at (x, y); `high` are the terms xy and y².
float psf_log_amplitude(vec4 low, vec2 high, float x, float y) {
    return low.x + x * (low.y + low.w * x + high.x * y) + y * (low.z + high.y * y);
}
