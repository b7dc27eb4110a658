/* Gaze of an eye tracker, by an action of the layer's own beside the application's.
 *
 * Action sets can be attached only once per session, so the layer attaches its own set with
 * the application's.  If the application attaches none, there is no gaze. */
#include <stdlib.h>
#include <string.h>

#include "gaze.h"
#include "log.h"

#define PROFILE "/interaction_profiles/ext/eye_gaze_interaction"
#define BINDING "/user/eyes_ext/input/gaze_ext/pose"

void gaze_create(instance *own) {
    XrActionSetCreateInfo set = {.type = XR_TYPE_ACTION_SET_CREATE_INFO,
                                 .actionSetName = "ocufilter_layer",
                                 .localizedActionSetName = "ocufilter layer"};
    XrActionCreateInfo action = {.type = XR_TYPE_ACTION_CREATE_INFO,
                                 .actionName = "ocufilter_gaze",
                                 .actionType = XR_ACTION_TYPE_POSE_INPUT,
                                 .localizedActionName = "ocufilter gaze"};
    if (XR_FAILED(own->CreateActionSet(own->handle, &set, &own->gaze_set)) ||
        XR_FAILED(own->CreateAction(own->gaze_set, &action, &own->gaze_action)))
        own->has_gaze = false;
}

/* Suggest the layer's binding, with those that the application suggests for the same
 * profile: a later suggestion replaces an earlier one. */
XrResult gaze_suggest(instance *own, const XrInteractionProfileSuggestedBinding *given) {
    XrPath profile = XR_NULL_PATH, path = XR_NULL_PATH;
    if (own->has_gaze) {
        own->StringToPath(own->handle, PROFILE, &profile);
        own->StringToPath(own->handle, BINDING, &path);
    }
    if (given && given->interactionProfile != profile)
        return own->SuggestInteractionProfileBindings(own->handle, given);
    uint32_t count = given ? given->countSuggestedBindings : 0;
    XrActionSuggestedBinding *all = calloc(count + 1, sizeof *all);
    if (!all) return XR_ERROR_OUT_OF_MEMORY;
    if (count) memcpy(all, given->suggestedBindings, count * sizeof *all);
    all[count] = (XrActionSuggestedBinding){own->gaze_action, path};
    XrInteractionProfileSuggestedBinding mine = {
        XR_TYPE_INTERACTION_PROFILE_SUGGESTED_BINDING, given ? given->next : NULL, profile,
        count + 1, all};
    XrResult result = own->SuggestInteractionProfileBindings(own->handle, &mine);
    own->is_gaze_suggested = XR_SUCCEEDED(result);
    free(all);
    if (given && XR_FAILED(result))
        result = own->SuggestInteractionProfileBindings(own->handle, given);
    return result;
}

static void create_spaces(session *at) {
    instance *own = at->instance;
    XrActionSpaceCreateInfo info = {.type = XR_TYPE_ACTION_SPACE_CREATE_INFO,
                                    .action = own->gaze_action,
                                    .poseInActionSpace.orientation.w = 1.0f};
    pthread_mutex_lock(&at->lock);
    at->is_gaze_attached =
        XR_SUCCEEDED(own->CreateActionSpace(at->handle, &info, &at->gaze_space));
    pthread_mutex_unlock(&at->lock);
}

XrResult gaze_attach(session *at, const XrSessionActionSetsAttachInfo *given) {
    instance *own = at->instance;
    if (own->has_gaze && !own->is_gaze_suggested) gaze_suggest(own, NULL);
    XrActionSet *all = NULL;
    if (own->is_gaze_suggested)
        all = calloc(given->countActionSets + 1, sizeof *all);
    if (all) {
        for (uint32_t i = 0; i < given->countActionSets; ++i) all[i] = given->actionSets[i];
        all[given->countActionSets] = own->gaze_set;
        XrSessionActionSetsAttachInfo mine = *given;
        mine.countActionSets = given->countActionSets + 1;
        mine.actionSets = all;
        XrResult result = own->AttachSessionActionSets(at->handle, &mine);
        free(all);
        if (XR_SUCCEEDED(result)) {
            create_spaces(at);
            return result;
        }
    }
    return own->AttachSessionActionSets(at->handle, given);
}

XrResult gaze_sync(session *at, const XrActionsSyncInfo *given) {
    XrActiveActionSet *all = NULL;
    if (at->is_gaze_attached)
        all = calloc(given->countActiveActionSets + 1, sizeof *all);
    if (!all) return at->instance->SyncActions(at->handle, given);
    for (uint32_t i = 0; i < given->countActiveActionSets; ++i)
        all[i] = given->activeActionSets[i];
    all[given->countActiveActionSets] =
        (XrActiveActionSet){at->instance->gaze_set, XR_NULL_PATH};
    XrActionsSyncInfo mine = *given;
    mine.countActiveActionSets = given->countActiveActionSets + 1;
    mine.activeActionSets = all;
    XrResult result = at->instance->SyncActions(at->handle, &mine);
    free(all);
    return result;
}

void gaze_locate(session *at, XrTime time, wire_frame *frame) {
    if (!at->is_gaze_attached || !at->view_space) return;
    XrEyeGazeSampleTimeEXT sample = {.type = XR_TYPE_EYE_GAZE_SAMPLE_TIME_EXT};
    XrSpaceLocation found = {.type = XR_TYPE_SPACE_LOCATION, .next = &sample};
    const XrSpaceLocationFlags needed = XR_SPACE_LOCATION_ORIENTATION_VALID_BIT |
                                        XR_SPACE_LOCATION_ORIENTATION_TRACKED_BIT;
    if (XR_FAILED(at->instance->LocateSpace(at->gaze_space, at->view_space, time, &found)) ||
        (found.locationFlags & needed) != needed)
        return;
    memcpy(frame->gaze, &found.pose.orientation, sizeof frame->gaze);
    frame->gaze_time_ns = sample.time;
    frame->flags |= WIRE_HAS_GAZE;
}
