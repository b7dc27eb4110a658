/* Frames on their way to the helper and back, and the layers that show them. */
#ifndef OCU_LAYER_FRAMES_H
#define OCU_LAYER_FRAMES_H

#include "registry.h"

void frames_begin(session *at);
XrResult frames_end(session *at, const XrFrameEndInfo *info);
void frames_close(session *at);

/* own_images.c: swapchains of the layer's own */

/* Acquire an image for each eye; false if the runtime still reads it. */
bool own_images_acquire(session *at);
void own_images_release(session *at, bool is_written);
void own_images_destroy(session *at);

#endif
