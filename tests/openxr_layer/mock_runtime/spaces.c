/* Where the head, the gaze and spaces are. */
#include "mock.h"

enum { N_PAST = 256 }; /* frames whose display time is remembered */
static const float EYE_X_M[] = {-0.032f, 0.032f};
static const XrFovf EYE_FOV[] = {{-0.80f, 0.75f, 0.78f, -0.82f},
                                 {-0.75f, 0.80f, 0.78f, -0.82f}};
static const float FLOOR_M = -1.6f;
/* of the second LOCAL in the first: aside and turned left by 30 degrees */
static const XrPosef RECENTERED = {{0, 0.258819045f, 0, 0.965925826f},
                                   {0.25f, 0, -0.5f}};

static struct {
    XrTime time;
    int64_t number;
} past[N_PAST];
static int64_t frames_waited;
static XrTime recentered_from = INT64_MAX;
static XrPosef *head_poses;
static size_t head_count;

static XrVector3f rotated(XrQuaternionf q, XrVector3f v) {
    double x = 2 * ((double)q.y * v.z - (double)q.z * v.y);
    double y = 2 * ((double)q.z * v.x - (double)q.x * v.z);
    double z = 2 * ((double)q.x * v.y - (double)q.y * v.x);
    return (XrVector3f){(float)(v.x + q.w * x + q.y * z - q.z * y),
                        (float)(v.y + q.w * y + q.z * x - q.x * z),
                        (float)(v.z + q.w * z + q.x * y - q.y * x)};
}

/* Return where something is that has a pose within another one. */
static XrPosef within(XrPosef outer, XrPosef inner) {
    XrQuaternionf a = outer.orientation, b = inner.orientation;
    XrVector3f moved = rotated(a, inner.position);
    return (XrPosef){{a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
                      a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
                      a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
                      a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z},
                     {outer.position.x + moved.x, outer.position.y + moved.y,
                      outer.position.z + moved.z}};
}

static XrPosef inverse(XrPosef pose) {
    XrQuaternionf q = pose.orientation;
    XrQuaternionf back = {-q.x, -q.y, -q.z, q.w};
    XrVector3f moved = rotated(back, pose.position);
    return (XrPosef){back, {-moved.x, -moved.y, -moved.z}};
}

void recenter(struct object *session) {
    recentered_from = session->session.time + 1;
    for (int i = 0; i < 2; i++) {
        XrEventDataReferenceSpaceChangePending *event =
            queue_event(XR_TYPE_EVENT_DATA_REFERENCE_SPACE_CHANGE_PENDING);
        event->session = HANDLE(XrSession, session);
        event->referenceSpaceType =
            i ? XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR : XR_REFERENCE_SPACE_TYPE_LOCAL;
        event->changeTime = recentered_from;
        event->poseValid = XR_TRUE;
        event->poseInPreviousSpace = RECENTERED;
    }
}

/* Return the number of a frame that is waited for. */
int64_t remember_frame(XrTime time) {
    past[frames_waited % N_PAST].time = time;
    past[frames_waited % N_PAST].number = frames_waited;
    return frames_waited++;
}

static void read_head_poses(void) {
    const char *path = setting("MOCK_XR_HEAD", NULL);
    FILE *file = path && !head_poses ? fopen(path, "r") : NULL;
    if (!file) return;
    XrPosef p;
    while (fscanf(file, "%f %f %f %f %f %f %f", &p.position.x, &p.position.y,
                  &p.position.z, &p.orientation.x, &p.orientation.y, &p.orientation.z,
                  &p.orientation.w) == 7) {
        head_poses = realloc(head_poses, (head_count + 1) * sizeof p);
        head_poses[head_count++] = p;
    }
    fclose(file);
}

static XrPosef head_at(XrTime time) {
    read_head_poses();
    if (!head_count) return IDENTITY;
    int64_t number = 0;
    for (int i = 0; i < N_PAST; i++)
        if (past[i].time && past[i].time <= time && past[i].number > number)
            number = past[i].number;
    return head_poses[(size_t)number < head_count ? (size_t)number : head_count - 1];
}

/* Return the direction of the gaze in the head: -z turned up, then aside. */
static XrPosef gaze_pose(void) {
    double h_deg = 0, v_deg = 0;
    sscanf(setting("MOCK_XR_GAZE_DEG", "0,0"), "%lf,%lf", &h_deg, &v_deg);
    double aside = -h_deg * acos(-1) / 360, up = v_deg * acos(-1) / 360;
    return (XrPosef){{(float)(cos(aside) * sin(up)), (float)(sin(aside) * cos(up)),
                      (float)(-sin(aside) * sin(up)), (float)(cos(aside) * cos(up))},
                     {0, 0, 0}};
}

bool is_gaze_active(struct object *action) {
    return action->action.is_gaze && strcmp(setting("MOCK_XR_GAZE_DEG", ""), "none");
}

/* Return where a space is in the first LOCAL space; false: nobody knows. */
static bool space_at(struct object *space, XrTime time, XrPosef *pose) {
    XrPosef origin = IDENTITY;
    switch (space->space.type) {
    case XR_REFERENCE_SPACE_TYPE_VIEW: origin = head_at(time); break;
    case XR_REFERENCE_SPACE_TYPE_STAGE: origin.position.y = FLOOR_M; break;
    case XR_REFERENCE_SPACE_TYPE_LOCAL:
    case XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR:
        if (time >= recentered_from) origin = RECENTERED;
        if (space->space.type == XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR)
            origin.position.y += FLOOR_M;
        break;
    default:
        if (!space->space.action->is_alive || !is_gaze_active(space->space.action))
            return false;
        origin = within(head_at(time), gaze_pose());
    }
    *pose = within(origin, space->space.pose);
    return true;
}

bool is_unit(const XrPosef *pose) {
    const XrQuaternionf *q = &pose->orientation;
    double length = sqrt((double)q->x * q->x + (double)q->y * q->y +
                         (double)q->z * q->z + (double)q->w * q->w);
    return isfinite(pose->position.x) && isfinite(pose->position.y) &&
           isfinite(pose->position.z) && fabs(length - 1) < 0.01;
}

static uint32_t reference_space_count(void) {
    return XR_VERSION_MINOR(mock.api_version) >= 1 ? 4 : 3;
}

static const XrReferenceSpaceType REFERENCE_SPACES[] = {
    XR_REFERENCE_SPACE_TYPE_VIEW, XR_REFERENCE_SPACE_TYPE_LOCAL,
    XR_REFERENCE_SPACE_TYPE_STAGE, XR_REFERENCE_SPACE_TYPE_LOCAL_FLOOR};

XrResult XRAPI_CALL xrEnumerateReferenceSpaces(XrSession session, uint32_t capacity,
                                               uint32_t *count,
                                               XrReferenceSpaceType *types) {
    ENTER;
    FIND(found, SESSION, session);
    TWO_CALLS(capacity, count, reference_space_count());
    memcpy(types, REFERENCE_SPACES, *count * sizeof *types);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrCreateReferenceSpace(XrSession session,
                                           const XrReferenceSpaceCreateInfo *info,
                                           XrSpace *space) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_REFERENCE_SPACE_CREATE_INFO);
    REQUIRE(is_unit(&info->poseInReferenceSpace), XR_ERROR_POSE_INVALID,
            "the pose is not one");
    bool is_known = false;
    for (uint32_t i = 0; i < reference_space_count(); i++)
        is_known |= REFERENCE_SPACES[i] == info->referenceSpaceType;
    REQUIRE(is_known, XR_ERROR_REFERENCE_SPACE_UNSUPPORTED, "type %d is not offered",
            (int)info->referenceSpaceType);
    struct object *made = create(SPACE, found);
    made->space.type = info->referenceSpaceType;
    made->space.pose = info->poseInReferenceSpace;
    *space = HANDLE(XrSpace, made);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrGetReferenceSpaceBoundsRect(XrSession session,
                                                  XrReferenceSpaceType type,
                                                  XrExtent2Df *bounds) {
    ENTER;
    FIND(found, SESSION, session);
    (void)type;
    *bounds = (XrExtent2Df){0, 0};
    return XR_SPACE_BOUNDS_UNAVAILABLE;
}

XrResult XRAPI_CALL xrCreateActionSpace(XrSession session,
                                        const XrActionSpaceCreateInfo *info,
                                        XrSpace *space) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_ACTION_SPACE_CREATE_INFO);
    FIND(action, ACTION, info->action);
    REQUIRE(action->action.type == XR_ACTION_TYPE_POSE_INPUT,
            XR_ERROR_ACTION_TYPE_MISMATCH, "the action is no pose");
    REQUIRE(is_unit(&info->poseInActionSpace), XR_ERROR_POSE_INVALID,
            "the pose is not one");
    struct object *made = create(SPACE, found);
    made->space.pose = info->poseInActionSpace;
    made->space.action = action;
    *space = HANDLE(XrSpace, made);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrDestroySpace(XrSpace space) {
    ENTER;
    struct object *found = find(SPACE, ID(space));
    REQUIRE(found, XR_ERROR_HANDLE_INVALID, "there is no such space");
    found->is_alive = false;
    return XR_SUCCESS;
}

static void locate(struct object *space, struct object *base, XrTime time,
                   XrSpaceLocationFlags *flags, XrPosef *pose) {
    XrPosef inner, outer;
    *flags = 0;
    *pose = IDENTITY;
    if (!space_at(space, time, &inner) || !space_at(base, time, &outer)) return;
    *flags = XR_SPACE_LOCATION_ORIENTATION_VALID_BIT |
             XR_SPACE_LOCATION_POSITION_VALID_BIT |
             XR_SPACE_LOCATION_ORIENTATION_TRACKED_BIT |
             XR_SPACE_LOCATION_POSITION_TRACKED_BIT;
    *pose = space == base ? IDENTITY : within(inverse(outer), inner);
}

XrResult XRAPI_CALL xrLocateSpace(XrSpace space, XrSpace base, XrTime time,
                                  XrSpaceLocation *location) {
    ENTER;
    FIND(found, SPACE, space);
    FIND(found_base, SPACE, base);
    XrStructureType sample = XR_TYPE_EYE_GAZE_SAMPLE_TIME_EXT;
    STRUCTURE(location, XR_TYPE_SPACE_LOCATION, XR_TYPE_SPACE_VELOCITY,
              mock.is_enabled[GAZE] ? sample : 0);
    REQUIRE(found->parent == found_base->parent, XR_ERROR_VALIDATION_FAILURE,
            "the spaces are of two sessions");
    REQUIRE_TIME(time);
    locate(found, found_base, time, &location->locationFlags, &location->pose);
    XrSpaceVelocity *velocity =
        (void *)(uintptr_t)chained_structure(location->next, XR_TYPE_SPACE_VELOCITY);
    if (velocity) velocity->velocityFlags = 0;
    XrEyeGazeSampleTimeEXT *sampled =
        (void *)(uintptr_t)chained_structure(location->next, sample);
    if (sampled) sampled->time = location->locationFlags ? time : 0;
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrLocateSpaces(XrSession session, const XrSpacesLocateInfo *info,
                                   XrSpaceLocations *locations) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_SPACES_LOCATE_INFO);
    STRUCTURE(locations, XR_TYPE_SPACE_LOCATIONS);
    FIND(base, SPACE, info->baseSpace);
    REQUIRE_TIME(info->time);
    REQUIRE(info->spaceCount == locations->locationCount, XR_ERROR_VALIDATION_FAILURE,
            "%u spaces and %u locations", info->spaceCount, locations->locationCount);
    for (uint32_t i = 0; i < info->spaceCount; i++) {
        FIND(space, SPACE, info->spaces[i]);
        locate(space, base, info->time, &locations->locations[i].locationFlags,
               &locations->locations[i].pose);
    }
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrLocateViews(XrSession session, const XrViewLocateInfo *info,
                                  XrViewState *state, uint32_t capacity,
                                  uint32_t *count, XrView *views) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_VIEW_LOCATE_INFO);
    STRUCTURE(state, XR_TYPE_VIEW_STATE);
    FIND(space, SPACE, info->space);
    REQUIRE(space->parent == found, XR_ERROR_VALIDATION_FAILURE,
            "the space is of another session");
    REQUIRE_VIEWS(info->viewConfigurationType);
    REQUIRE_TIME(info->displayTime);
    uint32_t n = views_of(info->viewConfigurationType);
    XrPosef base, head = head_at(info->displayTime);
    state->viewStateFlags = 0;
    if (space_at(space, info->displayTime, &base))
        state->viewStateFlags =
            XR_VIEW_STATE_ORIENTATION_VALID_BIT | XR_VIEW_STATE_POSITION_VALID_BIT |
            XR_VIEW_STATE_ORIENTATION_TRACKED_BIT | XR_VIEW_STATE_POSITION_TRACKED_BIT;
    else base = IDENTITY;
    TWO_CALLS(capacity, count, n);
    for (uint32_t i = 0; i < n; i++) {
        STRUCTURE(&views[i], XR_TYPE_VIEW);
        XrPosef eye = IDENTITY;
        if (n == 2) eye.position.x = EYE_X_M[i];
        views[i].pose = within(inverse(base), within(head, eye));
        views[i].fov = EYE_FOV[i];
    }
    return XR_SUCCESS;
}
