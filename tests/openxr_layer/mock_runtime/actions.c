/* Paths and actions: no controllers, and at most an eye tracker. */
#include "mock.h"

static char **paths;
static XrPath path_count;

static const char GAZE_PROFILE[] = "/interaction_profiles/ext/eye_gaze_interaction";
static const char GAZE_PATH[] = "/user/eyes_ext/input/gaze_ext/pose";
static const char GAZE_USER[] = "/user/eyes_ext";

static XrPath path_of(const char *text) {
    for (XrPath i = 0; i < path_count; i++)
        if (!strcmp(paths[i], text)) return i + 1;
    paths = realloc(paths, (path_count + 1) * sizeof *paths);
    paths[path_count++] = strdup(text);
    return path_count;
}

XrResult XRAPI_CALL xrStringToPath(XrInstance instance, const char *text,
                                   XrPath *path) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE(*text == '/' && text[1] &&
                !text[strspn(text, "abcdefghijklmnopqrstuvwxyz0123456789-_./")],
            XR_ERROR_PATH_FORMAT_INVALID, "'%s' is no path", text);
    *path = path_of(text);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrPathToString(XrInstance instance, XrPath path, uint32_t capacity,
                                   uint32_t *count, char *text) {
    ENTER;
    FIND(found, INSTANCE, instance);
    REQUIRE(path && path <= path_count, XR_ERROR_PATH_INVALID, "there is no such path");
    uint32_t size = (uint32_t)strlen(paths[path - 1]) + 1;
    TWO_CALLS(capacity, count, size);
    memcpy(text, paths[path - 1], size);
    return XR_SUCCESS;
}

/* Give a new action or set its names, which no sibling has. */
static XrResult name_action(struct object *made, const char *name,
                            const char *localized) {
    for (uint64_t i = 0; i < mock.object_count; i++) {
        const struct object *other = mock.objects[i];
        if (other == made || other->kind != made->kind || !other->is_alive ||
            other->parent != made->parent)
            continue;
        made->is_alive = false;
        REQUIRE(strcmp(other->action.name, name), XR_ERROR_NAME_DUPLICATED,
                "there is a '%s'", name);
        REQUIRE(strcmp(other->action.localized, localized),
                XR_ERROR_LOCALIZED_NAME_DUPLICATED, "there is a '%s'", localized);
        made->is_alive = true;
    }
    snprintf(made->action.name, sizeof made->action.name, "%s", name);
    snprintf(made->action.localized, sizeof made->action.localized, "%s", localized);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrCreateActionSet(XrInstance instance,
                                      const XrActionSetCreateInfo *info,
                                      XrActionSet *set) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(info, XR_TYPE_ACTION_SET_CREATE_INFO);
    struct object *made = create(ACTION_SET, found);
    *set = HANDLE(XrActionSet, made);
    return name_action(made, info->actionSetName, info->localizedActionSetName);
}

XrResult XRAPI_CALL xrCreateAction(XrActionSet set, const XrActionCreateInfo *info,
                                   XrAction *action) {
    ENTER;
    FIND(found, ACTION_SET, set);
    STRUCTURE(info, XR_TYPE_ACTION_CREATE_INFO);
    REQUIRE(!found->action.is_attached, XR_ERROR_ACTIONSETS_ALREADY_ATTACHED,
            "the set '%s' is attached", found->action.name);
    struct object *made = create(ACTION, found);
    made->action.type = info->actionType;
    *action = HANDLE(XrAction, made);
    return name_action(made, info->actionName, info->localizedActionName);
}

XrResult XRAPI_CALL xrDestroyActionSet(XrActionSet set) {
    ENTER;
    FIND(found, ACTION_SET, set);
    for (uint64_t i = 0; i < mock.object_count; i++)
        if (mock.objects[i]->parent == found) mock.objects[i]->is_alive = false;
    found->is_alive = false;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrDestroyAction(XrAction action) {
    ENTER;
    FIND(found, ACTION, action);
    found->is_alive = false;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrSuggestInteractionProfileBindings(
    XrInstance instance, const XrInteractionProfileSuggestedBinding *suggested) {
    ENTER;
    FIND(found, INSTANCE, instance);
    STRUCTURE(suggested, XR_TYPE_INTERACTION_PROFILE_SUGGESTED_BINDING);
    XrPath profile = suggested->interactionProfile;
    REQUIRE(profile && profile <= path_count, XR_ERROR_PATH_INVALID,
            "there is no such path");
    bool is_gaze = !strcmp(paths[profile - 1], GAZE_PROFILE);
    REQUIRE(!is_gaze || mock.is_enabled[GAZE], XR_ERROR_PATH_UNSUPPORTED,
            "%s is not enabled", GAZE_PROFILE);
    REQUIRE(suggested->countSuggestedBindings, XR_ERROR_VALIDATION_FAILURE,
            "nothing is suggested");
    for (uint32_t i = 0; i < suggested->countSuggestedBindings; i++) {
        FIND(action, ACTION, suggested->suggestedBindings[i].action);
        REQUIRE(!action->parent->action.is_attached,
                XR_ERROR_ACTIONSETS_ALREADY_ATTACHED, "the set of '%s' is attached",
                action->action.name);
    }
    if (!is_gaze) return XR_SUCCESS; /* there are no controllers */
    for (uint64_t i = 0; i < mock.object_count;
         i++) /* it replaces the last suggestion */
        if (mock.objects[i]->kind == ACTION) mock.objects[i]->action.is_gaze = false;
    for (uint32_t i = 0; i < suggested->countSuggestedBindings; i++) {
        const XrActionSuggestedBinding *one = &suggested->suggestedBindings[i];
        if (one->binding == path_of(GAZE_PATH))
            find(ACTION, ID(one->action))->action.is_gaze = true;
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrAttachSessionActionSets(
    XrSession session, const XrSessionActionSetsAttachInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SESSION_ACTION_SETS_ATTACH_INFO);
    REQUIRE(!found->session.has_actions, XR_ERROR_ACTIONSETS_ALREADY_ATTACHED,
            "the session has its action sets");
    REQUIRE(info->countActionSets && info->countActionSets <= MAX_ACTION_SETS,
            XR_ERROR_VALIDATION_FAILURE, "%u action sets", info->countActionSets);
    for (uint32_t i = 0; i < info->countActionSets; i++) {
        FIND(set, ACTION_SET, info->actionSets[i]);
        set->action.is_attached = true;
        found->session.attached[i] = set;
    }
    found->session.attached_count = info->countActionSets;
    found->session.has_actions = true;
    return XR_SUCCESS;
}

static bool is_attached(const struct object *session, const struct object *set) {
    for (uint32_t i = 0; i < session->session.attached_count; i++)
        if (session->session.attached[i] == set) return true;
    return false;
}

XrResult XRAPI_CALL xrSyncActions(XrSession session, const XrActionsSyncInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_ACTIONS_SYNC_INFO);
    for (uint32_t i = 0; i < info->countActiveActionSets; i++) {
        FIND(set, ACTION_SET, info->activeActionSets[i].actionSet);
        REQUIRE(is_attached(found, set), XR_ERROR_ACTIONSET_NOT_ATTACHED,
                "the set '%s' is not attached", set->action.name);
    }
    found->session.is_synced = found->session.state == XR_SESSION_STATE_FOCUSED;
    return found->session.is_synced ? XR_SUCCESS : XR_SESSION_NOT_FOCUSED;
}

/* Begin a function that tells the state of an action. */
#define ACTION_STATE(action_type, structure_type) \
    ENTER; \
    FIND(found, SESSION, session); \
    STRUCTURE(info, XR_TYPE_ACTION_STATE_GET_INFO); \
    STRUCTURE(state, structure_type); \
    FIND(action, ACTION, info->action); \
    REQUIRE(action->action.type == action_type, XR_ERROR_ACTION_TYPE_MISMATCH, \
            "'%s' has another type", action->action.name); \
    REQUIRE(is_attached(found, action->parent), XR_ERROR_ACTIONSET_NOT_ATTACHED, \
            "the set of '%s' is not attached", action->action.name); \
    state->isActive = XR_FALSE

XrResult XRAPI_CALL xrGetActionStateBoolean(XrSession session,
                                            const XrActionStateGetInfo *info,
                                            XrActionStateBoolean *state) {
    ACTION_STATE(XR_ACTION_TYPE_BOOLEAN_INPUT, XR_TYPE_ACTION_STATE_BOOLEAN);
    state->currentState = state->changedSinceLastSync = XR_FALSE;
    state->lastChangeTime = 0;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetActionStateFloat(XrSession session,
                                          const XrActionStateGetInfo *info,
                                          XrActionStateFloat *state) {
    ACTION_STATE(XR_ACTION_TYPE_FLOAT_INPUT, XR_TYPE_ACTION_STATE_FLOAT);
    state->currentState = 0;
    state->changedSinceLastSync = XR_FALSE;
    state->lastChangeTime = 0;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetActionStateVector2f(XrSession session,
                                             const XrActionStateGetInfo *info,
                                             XrActionStateVector2f *state) {
    ACTION_STATE(XR_ACTION_TYPE_VECTOR2F_INPUT, XR_TYPE_ACTION_STATE_VECTOR2F);
    state->currentState = (XrVector2f){0, 0};
    state->changedSinceLastSync = XR_FALSE;
    state->lastChangeTime = 0;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetActionStatePose(XrSession session,
                                         const XrActionStateGetInfo *info,
                                         XrActionStatePose *state) {
    ACTION_STATE(XR_ACTION_TYPE_POSE_INPUT, XR_TYPE_ACTION_STATE_POSE);
    state->isActive = found->session.is_synced && is_gaze_active(action);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetCurrentInteractionProfile(XrSession session, XrPath user,
                                                   XrInteractionProfileState *state) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(state, XR_TYPE_INTERACTION_PROFILE_STATE);
    REQUIRE(found->session.has_actions, XR_ERROR_ACTIONSET_NOT_ATTACHED,
            "the session has no action sets");
    bool is_gaze = mock.is_enabled[GAZE] && user == path_of(GAZE_USER);
    state->interactionProfile = is_gaze ? path_of(GAZE_PROFILE) : XR_NULL_PATH;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrEnumerateBoundSourcesForAction(
    XrSession session, const XrBoundSourcesForActionEnumerateInfo *info,
    uint32_t capacity, uint32_t *count, XrPath *sources) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_BOUND_SOURCES_FOR_ACTION_ENUMERATE_INFO);
    FIND(action, ACTION, info->action);
    uint32_t n = action->action.is_gaze;
    TWO_CALLS(capacity, count, n);
    if (n) sources[0] = path_of(GAZE_PATH);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetInputSourceLocalizedName(
    XrSession session, const XrInputSourceLocalizedNameGetInfo *info, uint32_t capacity,
    uint32_t *count, char *text) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_INPUT_SOURCE_LOCALIZED_NAME_GET_INFO);
    TWO_CALLS(capacity, count, (uint32_t)sizeof "gaze");
    strcpy(text, "gaze");
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrApplyHapticFeedback(XrSession session,
                                          const XrHapticActionInfo *info,
                                          const XrHapticBaseHeader *feedback) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_HAPTIC_ACTION_INFO);
    (void)feedback;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrStopHapticFeedback(XrSession session,
                                         const XrHapticActionInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_HAPTIC_ACTION_INFO);
    return XR_SUCCESS;
}
