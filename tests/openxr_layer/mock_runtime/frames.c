/* The loop of frames. */
#include <errno.h>

#include "mock.h"

enum { WAIT_S = 5 }; /* until a frame that never begins is a violation */
static bool has_exited, has_recentered;

static bool is_due(int64_t number, const char *name) {
    long at = number_setting(name, -1);
    return at >= 0 && number >= at;
}

static void sleep_until(XrTime time_ns) {
    struct timespec until = {time_ns / 1000000000, time_ns % 1000000000};
    pthread_mutex_unlock(&mock.lock);
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {
    }
    pthread_mutex_lock(&mock.lock);
}

XrResult XRAPI_CALL xrWaitFrame(XrSession session, const XrFrameWaitInfo *info,
                                XrFrameState *state) {
    ENTER;
    FIND(found, SESSION, session);
    if (info) STRUCTURE(info, XR_TYPE_FRAME_WAIT_INFO);
    STRUCTURE(state, XR_TYPE_FRAME_STATE);
    REQUIRE_RUNNING(found);
    struct timespec limit;
    clock_gettime(CLOCK_REALTIME, &limit);
    limit.tv_sec += WAIT_S;
    while (found->session.waited > found->session.begun && found->is_alive)
        if (pthread_cond_timedwait(&mock.frame_has_begun, &mock.lock, &limit) ==
            ETIMEDOUT) {
            mock.call = __func__;
            return violation(XR_ERROR_CALL_ORDER_INVALID,
                             "the frame of the last call did not begin in %d s",
                             WAIT_S);
        }
    REQUIRE_RUNNING(found); /* it may have ended in the meantime */
    long rate_hz = number_setting("MOCK_XR_RATE_HZ", 90);
    XrDuration period = 1000000000 / (rate_hz ? rate_hz : 90);
    /* The frame is shown two periods after the application is woken for it. */
    XrTime time = now_ns() + 2 * period;
    XrTime earliest = found->session.waited_time + (rate_hz ? period : 1);
    if (time < earliest) time = earliest;
    found->session.waited++;
    found->session.waited_time = time;
    found->session.waited_number = remember_frame(time);
    state->predictedDisplayTime = time;
    state->predictedDisplayPeriod = period;
    state->shouldRender = found->session.state >= XR_SESSION_STATE_VISIBLE &&
                          found->session.state <= XR_SESSION_STATE_FOCUSED;
    if (rate_hz) sleep_until(time - 2 * period);
    return XR_SUCCESS;
}

XrResult XRAPI_CALL xrBeginFrame(XrSession session, const XrFrameBeginInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    if (info) STRUCTURE(info, XR_TYPE_FRAME_BEGIN_INFO);
    REQUIRE_RUNNING(found);
    REQUIRE(found->session.waited > found->session.begun, XR_ERROR_CALL_ORDER_INVALID,
            "no frame was waited for");
    bool is_discarded = found->session.in_frame;
    found->session.begun++;
    found->session.in_frame = true;
    found->session.number = found->session.waited_number;
    found->session.time = found->session.waited_time;
    if (found->session.state == XR_SESSION_STATE_READY)
        enter_state(found, XR_SESSION_STATE_SYNCHRONIZED);
    pthread_cond_broadcast(&mock.frame_has_begun);
    return is_discarded ? XR_FRAME_DISCARDED : XR_SUCCESS;
}

XrResult XRAPI_CALL xrEndFrame(XrSession session, const XrFrameEndInfo *info) {
    ENTER;
    FIND(found, SESSION, session);
    STRUCTURE(info, XR_TYPE_FRAME_END_INFO);
    REQUIRE_RUNNING(found);
    REQUIRE(found->session.in_frame, XR_ERROR_CALL_ORDER_INVALID, "no frame has begun");
    REQUIRE_TIME(info->displayTime);
    REQUIRE(info->environmentBlendMode == XR_ENVIRONMENT_BLEND_MODE_OPAQUE,
            XR_ERROR_ENVIRONMENT_BLEND_MODE_UNSUPPORTED, "blend mode %d",
            (int)info->environmentBlendMode);
    REQUIRE(info->layerCount <= MAX_LAYERS, XR_ERROR_LAYER_LIMIT_EXCEEDED, "%u layers",
            info->layerCount);
    REQUIRE(info->layers || !info->layerCount, XR_ERROR_VALIDATION_FAILURE,
            "layers is NULL");
    for (uint32_t i = 0; i < info->layerCount; i++) {
        XrResult result = check_layer(found, info->layers[i]);
        if (result != XR_SUCCESS) return result;
    }
    XrResult result = finish_application(found);
    if (result != XR_SUCCESS) return result;
    capture_frame(found, info);
    found->session.in_frame = false;
    if (found->session.state == XR_SESSION_STATE_SYNCHRONIZED) {
        enter_state(found, XR_SESSION_STATE_VISIBLE);
        enter_state(found, XR_SESSION_STATE_FOCUSED);
    }
    int64_t number = found->session.number;
    if (is_due(number, "MOCK_XR_RECENTER_AT") && !has_recentered) {
        has_recentered = true;
        recenter(found);
    }
    if (is_due(number, "MOCK_XR_EXIT_AT") && !has_exited) {
        has_exited = true;
        begin_stopping(found);
    }
    if (is_due(number, "MOCK_XR_LOSE_AT")) {
        mock.is_instance_lost = strstr(setting("MOCK_XR_LOSE_AT", ""), "instance");
        found->session.is_lost = true;
        enter_state(found, XR_SESSION_STATE_LOSS_PENDING);
        return mock.is_instance_lost ? XR_ERROR_INSTANCE_LOST : XR_ERROR_SESSION_LOST;
    }
    return XR_SUCCESS;
}
