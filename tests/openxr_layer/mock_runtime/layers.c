/* Whether what is submitted is valid. */
#include "mock.h"

XrResult check_sub_image(struct object *session, const XrSwapchainSubImage *part,
                         bool is_depth) {
    const char *what = is_depth ? "depth" : "color";
    FIND(swapchain, SWAPCHAIN, part->swapchain);
    unsigned long long id = swapchain->id;
    const XrSwapchainCreateInfo *info = &swapchain->swapchain.info;
    REQUIRE(swapchain->parent == session, XR_ERROR_VALIDATION_FAILURE,
            "%s: swapchain %llu is of another session", what, id);
    REQUIRE(swapchain->swapchain.release_count, XR_ERROR_LAYER_INVALID,
            "%s: no image of swapchain %llu was ever released", what, id);
    REQUIRE(swapchain->swapchain.format->is_depth == is_depth,
            XR_ERROR_VALIDATION_FAILURE, "%s: swapchain %llu has the format %s", what,
            id, swapchain->swapchain.format->name);
    const XrRect2Di *rect = &part->imageRect;
    REQUIRE(rect->offset.x >= 0 && rect->offset.y >= 0 && rect->extent.width > 0 &&
                rect->extent.height > 0 &&
                (int64_t)rect->offset.x + rect->extent.width <= info->width &&
                (int64_t)rect->offset.y + rect->extent.height <= info->height,
            XR_ERROR_SWAPCHAIN_RECT_INVALID, "%s: %d,%d %dx%d of %ux%u", what,
            rect->offset.x, rect->offset.y, rect->extent.width, rect->extent.height,
            info->width, info->height);
    REQUIRE(part->imageArrayIndex < info->arraySize, XR_ERROR_VALIDATION_FAILURE,
            "%s: array index %u of %u", what, part->imageArrayIndex, info->arraySize);
    return XR_SUCCESS;
}

static XrResult check_depth(struct object *session,
                            const XrCompositionLayerDepthInfoKHR *depth) {
    XrResult result = check_sub_image(session, &depth->subImage, true);
    if (result != XR_SUCCESS) return result;
    REQUIRE(depth->minDepth >= 0 && depth->minDepth < depth->maxDepth &&
                depth->maxDepth <= 1,
            XR_ERROR_VALIDATION_FAILURE, "depth from %g to %g", (double)depth->minDepth,
            (double)depth->maxDepth);
    REQUIRE(depth->nearZ >= 0 && depth->farZ >= 0 && depth->nearZ != depth->farZ,
            XR_ERROR_VALIDATION_FAILURE, "near plane %g, far plane %g",
            (double)depth->nearZ, (double)depth->farZ);
    return XR_SUCCESS;
}

static XrResult check_view(struct object *session,
                           const XrCompositionLayerProjectionView *view) {
    XrStructureType depth = XR_TYPE_COMPOSITION_LAYER_DEPTH_INFO_KHR;
    STRUCTURE(view, XR_TYPE_COMPOSITION_LAYER_PROJECTION_VIEW,
              mock.is_enabled[DEPTH] ? depth : 0);
    REQUIRE(is_unit(&view->pose), XR_ERROR_POSE_INVALID,
            "the pose of a view is not one");
    const float angles[] = {view->fov.angleLeft, view->fov.angleRight,
                            view->fov.angleUp, view->fov.angleDown};
    for (int i = 0; i < 4; i++)
        REQUIRE(fabs((double)angles[i]) < acos(0), XR_ERROR_VALIDATION_FAILURE,
                "an angle of the field of view is %g", (double)angles[i]);
    XrResult result = check_sub_image(session, &view->subImage, false);
    const void *chained = chained_structure(view->next, depth);
    if (result != XR_SUCCESS || !chained) return result;
    result = check_depth(session, chained);
    return number_setting("MOCK_XR_LENIENT_DEPTH", 0) ? XR_SUCCESS : result;
}

XrResult check_layer(struct object *session,
                     const XrCompositionLayerBaseHeader *layer) {
    const XrCompositionLayerFlags KNOWN_FLAGS =
        XR_COMPOSITION_LAYER_CORRECT_CHROMATIC_ABERRATION_BIT |
        XR_COMPOSITION_LAYER_BLEND_TEXTURE_SOURCE_ALPHA_BIT |
        XR_COMPOSITION_LAYER_UNPREMULTIPLIED_ALPHA_BIT;
    REQUIRE(layer, XR_ERROR_LAYER_INVALID, "a layer is NULL");
    const XrCompositionLayerProjection *projection = (const void *)layer;
    const XrCompositionLayerQuad *quad = (const void *)layer;
    REQUIRE(layer->type == XR_TYPE_COMPOSITION_LAYER_PROJECTION ||
                layer->type == XR_TYPE_COMPOSITION_LAYER_QUAD,
            XR_ERROR_LAYER_INVALID, "a layer has the type %d", (int)layer->type);
    STRUCTURE(layer, layer->type);
    REQUIRE(!(layer->layerFlags & ~KNOWN_FLAGS), XR_ERROR_VALIDATION_FAILURE,
            "the flags are 0x%llx", (unsigned long long)layer->layerFlags);
    FIND(space, SPACE, layer->space);
    REQUIRE(space->parent == session, XR_ERROR_VALIDATION_FAILURE,
            "a layer's space is of another session");
    if (layer->type == XR_TYPE_COMPOSITION_LAYER_QUAD) {
        REQUIRE(is_unit(&quad->pose), XR_ERROR_POSE_INVALID,
                "a quad's pose is not one");
        REQUIRE(quad->eyeVisibility <= XR_EYE_VISIBILITY_RIGHT,
                XR_ERROR_VALIDATION_FAILURE, "a quad's visibility is %d",
                (int)quad->eyeVisibility);
        return check_sub_image(session, &quad->subImage, false);
    }
    REQUIRE(projection->viewCount == session->session.view_count,
            XR_ERROR_VALIDATION_FAILURE, "a layer has %u views", projection->viewCount);
    for (uint32_t i = 0; i < projection->viewCount; i++) {
        XrResult result = check_view(session, &projection->views[i]);
        if (result != XR_SUCCESS) return result;
    }
    return XR_SUCCESS;
}
