/* Gaze of an eye tracker, by an action of the layer's own beside the application's. */
#ifndef OCU_LAYER_GAZE_H
#define OCU_LAYER_GAZE_H

#include "registry.h"

void gaze_create(instance *own);
XrResult gaze_suggest(instance *own, const XrInteractionProfileSuggestedBinding *given);
XrResult gaze_attach(session *at, const XrSessionActionSetsAttachInfo *given);
XrResult gaze_sync(session *at, const XrActionsSyncInfo *given);
void gaze_locate(session *at, XrTime time, wire_frame *frame);

#endif
