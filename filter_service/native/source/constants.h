/* Constants of filter_service/constants.py, with the same names; a test compares them. */
#ifndef OCU_CONSTANTS_H
#define OCU_CONSTANTS_H

#define TILE_SIZE_PX 8
#define MAX_LEVEL 3
#define DISCONTINUITY_PX 0.25f
#define NEAREST_M 0.02f
#define MERGE_FADE_RATIO 0.05f
#define MERGE_MIDTONE 0.2f
#define MERGE_DARKEST 0.0155f
#define EDGE_MIX_COVERAGE 0.002f
#define GROUP_BLEND_RATIO 0.2f
#define EXCESS_RATIO 4.0f
#define NOTHING_DPT -1.0f
#define MERGE_MIN_SPREAD_PX 1.5f
#define MERGE_CONTRAST 0.0295f
#define MERGE_MAX_BLUR_STEP_PX 0.25f
#define MERGE_MAX_BLUR_RATIO 0.08f
#define MERGE_CONTRAST_POWER 1.5f
#define DETECTION_MARGIN_DEG 5.0f
#define DETECTION_OCTAVES_PER_DEG 0.103f
#define DETECTION_MAX_OCTAVES 3.0f
#define PAPER_TIE_BREAK_M 0.01f
#define PAPER_FAR_M 1000.0f
#define MIN_COVERAGE 1.0e-4f
#define MIN_BLUR_RANGE 1.0e-12f
#define HALF_MAX 65504.0f
#define RGB 3
#define RECIPE_TAPS 6
#define FIELD_CORNERS 3
#define MIN_SHIFT_PX 0.5
#define MIN_SHIFT_RATIO 0.1
#define MIN_SHIFT_FADE_PX 0.5
#define MIN_SHIFT_FADE_RATIO 0.03
#define KERNEL_TAIL_PX 2.0
#define MAX_REACH_PX 255
#define DEPTH_SQUARE_PX 16
#define WEIGHT_MAX 65535.0

#endif
