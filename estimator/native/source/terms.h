/* Largest number of terms of a wavefront; estimator/optics/zernike.py has the same. */
#ifndef OCU_TERMS_H
#define OCU_TERMS_H

#define MOST_ORDER 10 /* degree of a wavefront's polynomial: 6 to 10 */
#define MOST_POWERS (MOST_ORDER + 1)
#define MOST_TERMS 66

#endif
