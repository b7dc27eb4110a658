/* Media whose index, or squared index, is a polynomial in squared radius and depth. */
#ifndef OCU_GRADIENT_POLYNOMIAL_H
#define OCU_GRADIENT_POLYNOMIAL_H

#include "packed_eye.h"

/* n² and n times the gradient of n. */
typedef struct {
    lanes squared;
    vector3 slope;
} index_value;

/* Takes the parameters of a medium, and points in the axes of the surface in front of it. */
typedef index_value (*index_function)(const double *numbers, vector3 p);

/* A polynomial and its gradient.  The parameters are the number of powers of r², the number of
 * powers of z, and the coefficients, where the power of z changes fastest. */
INLINE index_value polynomial_of_depth(const double *numbers, vector3 p) {
    int n_radial = (int)numbers[0], n_depth = (int)numbers[1];
    lanes squared = p.x * p.x + p.y * p.y;
    lanes value = {0.0}, by_square = {0.0}, by_z = {0.0};
    for (int i = n_radial - 1; i >= 0; --i) {
        const double *row = numbers + 2 + (ptrdiff_t)i * n_depth;
        lanes q = {0.0}, dq = {0.0};
        for (int j = n_depth - 1; j >= 0; --j) {
            dq = dq * p.z + q;
            q = q * p.z + row[j];
        }
        by_square = by_square * squared + value;
        value = value * squared + q;
        by_z = by_z * squared + dq;
    }
    return (index_value){value, {2.0 * p.x * by_square, 2.0 * p.y * by_square, by_z}};
}

static index_value polynomial_index(const double *numbers, vector3 p) {
    index_value n = polynomial_of_depth(numbers, p);
    lanes value = n.squared;
    return (index_value){value * value,
                         {value * n.slope.x, value * n.slope.y, value * n.slope.z}};
}

static index_value squared_polynomial_index(const double *numbers, vector3 p) {
    index_value n = polynomial_of_depth(numbers, p);
    return (index_value){n.squared, {0.5 * n.slope.x, 0.5 * n.slope.y, 0.5 * n.slope.z}};
}

#endif
