/* What the application submits, and whether it can be filtered. */
#ifndef OCU_LAYER_PLAN_H
#define OCU_LAYER_PLAN_H

#include "registry.h"

#define MAX_LAYERS 64

typedef struct {
    const XrCompositionLayerQuad *layer;
    swapchain *chain;
    XrPosef pose; /* in the space of the projection layer */
} planned_quad;

/* The projection layer of a frame that is to be filtered. */
typedef struct {
    const XrCompositionLayerProjection *layer;
    uint32_t index;
    reference_space space;
    swapchain *color[WIRE_EYES], *depth[WIRE_EYES]; /* depth: NULL without */
    const XrCompositionLayerDepthInfoKHR *depth_info[WIRE_EYES];
    planned_quad quads[WIRE_QUADS]; /* directly above it, the lowest first */
    unsigned quad_count;
} plan;

bool make_plan(session *at, const XrFrameEndInfo *info, plan *p);

/* Return the depth in a chain of structures, or NULL. */
const XrCompositionLayerDepthInfoKHR *depth_of(const void *next);

#endif
