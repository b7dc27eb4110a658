/* All functions of the library, compiled once for each variant (core_any.c, core_avx2.c). */
#include "variant.h"
#include "vectors.h"

#include "psf_job.h"
#include "psf_pupils.h"
#include "psf_tails.h"
#include "psf_rays.h"
#include "psf_fft.h"
#include "psf_waves.h"
#include "psfs.h"
#include "psf_discs.h"
#include "psf_surveys.h"
#include "field_defocus.h"

#include "moved_plane.h"
#include "wavefronts.h"
#include "enz.h"

static const named_function functions[] = {
    FUNCTION(psfs),
    FUNCTION(take_psfs),
    FUNCTION(psf_discs),
    FUNCTION(frame_pupils),
    FUNCTION(survey_pupils),
    FUNCTION(needed_radii),
    FUNCTION(edge_lights_outside),
    FUNCTION(fill_defocus),
    FUNCTION(trace_rays),
    FUNCTION(trace_pupils),
    FUNCTION(trace_circles),
    FUNCTION(trace_shifts),
    FUNCTION(magnifications),
    FUNCTION(gradient_indices),
    FUNCTION(hankel_table),
    FUNCTION(image_light),
    FUNCTION(moved_fits),
    {NULL, NULL},
};

const variant OCU_VARIANT = {OCU_NAME, functions};
