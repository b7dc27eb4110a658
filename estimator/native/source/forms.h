/* Table of the surface forms that have no closed intersection with a ray. */
#ifndef OCU_FORMS_H
#define OCU_FORMS_H

#include "form_even_asphere.h"
#include "form_separate_profiles.h"
#include "form_toroid.h"
#include "form_two_conics.h"

enum { REVOLVED = 0, BICONIC = 1, WITH_OFFSET = 2 };

/* By FORM; from the third on, in the order of FORMS in estimator/optics/forms. */
static const sag_function FORM_SAGS[] = {
    biconic_sag, /* REVOLVED has a closed intersection */
    biconic_sag,
    biconic_sag,
    even_asphere_sag,
    two_conics_sag,
    toroid_sag,
    separate_profiles_sag,
};

enum { N_FORMS = sizeof FORM_SAGS / sizeof *FORM_SAGS };

INLINE sags surface_sag(const double *row, lanes x, lanes y) {
    int form = (int)row[FORM];
    if (form >= N_FORMS) return (sags){all_lanes(NAN), all_lanes(NAN), all_lanes(NAN), {0}};
    sags s = form <= WITH_OFFSET ? biconic_sag(row, x, y) : FORM_SAGS[form](row, x, y);
    if (form == WITH_OFFSET || row[HAS_OFFSET] != 0.0) add_offset(row, x, y, &s);
    return s;
}

#endif
