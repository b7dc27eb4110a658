#ifndef OCU_DITHER_H
#define OCU_DITHER_H

/* Ordered dither of 4 x 4 texels, added before truncation to steps of 15 bits.  Rounding
 * alone loses all of a tail that is darker than half a step, 1e-3 of the light of a wide
 * kernel. */
static const float before_cut[4][4] = {{0.03125f, 0.53125f, 0.15625f, 0.65625f},
                                       {0.78125f, 0.28125f, 0.90625f, 0.40625f},
                                       {0.21875f, 0.71875f, 0.09375f, 0.59375f},
                                       {0.96875f, 0.46875f, 0.84375f, 0.34375f}};

/* The same for weights that were cut before, in steps of twice the size.  The ranks of the first
 * pattern in reversed order of bits: half of the texels that the first cut raises are raised
 * again.  With one pattern for both, it would be all of them, and tails that are darker than a
 * step would get twice their light. */
static const float before_next_cut[4][4] = {{0.03125f, 0.09375f, 0.28125f, 0.34375f},
                                            {0.21875f, 0.15625f, 0.46875f, 0.40625f},
                                            {0.78125f, 0.84375f, 0.53125f, 0.59375f},
                                            {0.96875f, 0.90625f, 0.71875f, 0.65625f}};

#endif
