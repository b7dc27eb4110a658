"""Constants shared by Python and GLSL; each becomes a ``#define`` of the same name."""

TILE_SIZE_PX = 8
"""Edge of a screen tile and of a fragment block; each has 64 threads."""

THREADS = TILE_SIZE_PX * TILE_SIZE_PX
"""Threads in a tile's work group, and fragment slots in a block."""

QUADS_ACROSS = TILE_SIZE_PX // 2
QUADS = QUADS_ACROSS * QUADS_ACROSS
"""Quads of pixels in a block, and along one side of it."""

BIN_TILES = 2
BIN_SIZE_PX = BIN_TILES * TILE_SIZE_PX
TILES_PER_BIN = BIN_TILES * BIN_TILES
ALL_TILES = (1 << TILES_PER_BIN) - 1
"""Lists are built and sorted for bins of 2 x 2 tiles and evaluated tile by tile.  An
entry is a word: a bit for each tile of the bin that the fragment lights, and above them
its slot, so a strip may have 2**28 slots (a storage block of 2 GiB holds 2**27).  Bins
of 4 x 4 tiles save more time on the lists, but each tile then reads more entries for
each that it evaluates, which costs more (measured at 320 x 180 on a software renderer).
"""

BATCH = 128
HIT_WORDS = BATCH // 32
"""Entries of a list that the splat pass processes at a time, and words with a bit for
each of them."""

SCAN_THREADS = 256
"""Threads in the single group that sums the bins' counts."""

TOTAL_ENTRIES = 0
TOTAL_ENTRIES_FLOAT = 1
TOTAL_LOST = 2
TOTAL_LONGEST = 3
TOTAL_TILES = 4
TILE_KINDS = 4
TOTAL_WORDS = TOTAL_TILES + TILE_KINDS
"""Words after the bins' offsets: entries of all lists, the same as a float, dropped
entries, length of the longest list, tiles of each kind: those in which order does not
matter, those in which it does, of these the ones that light of a hidden surface
reaches, and of the first the ones with excess light.  The splat has a dispatch for each
kind, because llvmpipe executes both sides of every branch."""

STAT_MISSING = 0
STAT_CLAMPED = 1
STAT_BAD_COLOR = 2
STAT_FRAGMENTS = 3
STAT_MERGED = 4
STAT_WORDS = 8
STAT_LANES = 32
"""Counters of a frame: pixels without depth, at a distance that was not prepared, and
without a finite color; fragments, and merged pixels.  There are several rows, because
work groups that all add to one word wait for each other."""

DISPATCH_SCATTER = 0
DISPATCH_SORT = 1
DISPATCH_SPLAT = 4
DISPATCH_COUNT = DISPATCH_SPLAT + TILE_KINDS
DISPATCH_WORDS = 4
DISPATCH_BYTES = 4 * DISPATCH_WORDS
"""Dispatches whose size a pass determines: the scatter, a sort for each of three size
classes, a splat for each kind of tiles; each is group counts along three axes, and an
unused word."""

ENTRIES_EXACT = 2.0**31
"""Sums of list lengths below this fit in a word."""

EXACT_FLOAT = 2.0**23
EXACT_FLOAT_BITS = 0x4B000000
"""Float from which on all floats are whole numbers, and its bits."""

FLOAT_INFINITY_BITS = 0x7F800000
"""Infinity as a 32-bit float; larger bits, without the sign, are NaN."""

RADIX_BITS = 4
RADIX = 1 << RADIX_BITS
"""Buckets of one sorting pass; with a group of 64 they fill 4 KiB of shared memory."""

SORT_KEY_BITS = 16
PAPER_SORT_KEY_BITS = 20
"""Depth steps within a bin's own depth range: diopters / 2**16; for the paper's rule,
which weighs every pair by its order, the float steps of the distance, at most 2**20.
Equal keys keep the order of the list, which is scan order."""

SORT_INDEX_BITS = 12
SORT_SMALL = 512
SORT_LARGE = 2048
SORT_CAPACITIES = (SORT_SMALL, SORT_LARGE)
"""Size classes of the sort: lists up to these lengths are sorted in shared memory, 4
and 16 KiB, as words of depth and index in the list; longer ones in global memory."""

NEAREST_M = 0.02
"""Smaller distances count as this: 50 dpt, more than may be prepared."""

DISCONTINUITY_PX = 0.25
"""Blur change between neighbors above which they count as two surfaces.  Continuous
tiles need no order: at this slope the weights of a surface still sum to 1 within 3 %,
which is normalized away.  Where order matters, fragments whose blur differs by less are
of one depth and share the coverage that nearer ones leave free; hidden pixels whose
blur differs by less make no fragment.  Edges and hidden pixels have their full effect
at twice this difference, and none at this one."""

EDGE_MIX_COVERAGE = 0.002
"""Light of edge pixels, weighted with their strength, from which on a pixel takes the
light by depths alone.  Below, it takes part of the light without depths, so that the
order of depths sets in gradually where the light of an edge ends."""

GROUP_BLEND_RATIO = 0.2
"""Last part of a depth group in which fragments pass gradually to the next group.
Groups are `DISCONTINUITY_PX` of blur deep, at fixed depths."""

EXCESS_RATIO = 4.0
"""Light above this times the mean of the surroundings is not amplified where coverage
is missing: a lamp beside a near edge is not a surface that continues behind it."""

NEAREST_GROUP = -1.0e9
"""Nearer than every group of depths."""

NOTHING_DPT = -1.0
"""Object distance of an empty hidden pixel."""

MERGE_MIN_SPREAD_PX = 1.5
"""Fragments whose kernels spread less than this are not merged; the limit doubles for
each further level."""

MERGE_CONTRAST = 0.0295
"""The largest color difference within a merged 2 x 2 quad is this times spread**1.5.
The error of averaging a quad under a disc of radius r falls as r**-1.5 (rim pixels over
area), so the image error is the same at every blur: 55 dB on textured scenes.  A square
of the next level under twice the spread is the same image, twice as large."""

MERGE_CONTRAST_POWER = 1.5

MERGE_FADE_RATIO = 0.05
"""Squares that miss a limit of merging by less than this ratio do not merge, but their
pixels are moved toward the mean of the square, more so the closer they are to the
limit, so that no square merges abruptly.  The error is as if `MERGE_CONTRAST` were
larger by a third of this ratio: 0.0295 with them is as exact as 0.03 without."""

MERGE_MIDTONE = 0.2
MERGE_DARKEST = 0.0155
"""In an image encoded for a display, dark parts need finer steps: below a fifth of
white the allowed difference falls as the square root of the light (the power of the
encoding is 0.58); it is constant where sRGB is linear, below 1.55 % of that fifth."""

MERGE_MAX_BLUR_STEP_PX = 0.25
"""Largest blur difference within a merged quad; more where the blur is wide."""

MERGE_MAX_BLUR_RATIO = 0.08
"""The same relative to the spread of the kernels, which is the radius of a disc.  With
the fixed step alone, sloping surfaces do not merge at 64 px of blur: 3.7 times as many
list entries for 65 instead of 62 dB."""

DETECTION_MARGIN_DEG = 5.0
DETECTION_OCTAVES_PER_DEG = 0.103
DETECTION_MAX_OCTAVES = 3.0
"""Increase of the threshold contrast with the angle from the gaze, beyond a margin
(rendering/frame.py): 0.031 decades per degree, up to 8 times."""

PAPER_TIE_BREAK_M = 0.01
"""The paper's rule sorts by distance plus this times the scan position (0..1)."""

PAPER_FAR_M = 1000.0
"""Distance that represents infinity in the paper's sort key."""

MIN_COVERAGE = 1.0e-4
"""A pixel with less coverage keeps its own color."""

MIN_BLUR_RANGE = 1.0e-12
"""Smallest depth range used as a divisor."""

QUAD = 4.0
"""Fragments that merge into one of the next level."""

SRGB_DECODE_KNEE = 0.04045
SRGB_ENCODE_KNEE = 0.0031308
SRGB_SLOPE = 12.92
SRGB_OFFSET = 0.055
SRGB_SCALE = 1.055
SRGB_GAMMA = 2.4
BYTE_MAX = 255.0
"""IEC 61966-2-1."""

HALF_MAX = 65504.0
HALF_DROPPED_BITS = 13
"""Largest half float, and the bits by which its mantissa is shorter than a float's."""

PLACE_BITS = 16
PLACE_MASK = 0xFFFF
KERNEL_MASK = 0xFFFFFFF
LEVEL_SHIFT = 28
LEVEL_MASK = 3
EDGE_BIT = 0x40000000
BRIGHT_BIT = 0x80000000
"""Packing of a fragment's position and state words (shaders/README.md)."""

ATLAS_WIDTH_BITS = 12
ATLAS_WIDTH = 1 << ATLAS_WIDTH_BITS
"""Texels in one row of the kernel atlas, a 2D texture addressed as one line.  A texel
fetch costs half of a storage buffer load on a software renderer, and a texture may be
larger than a storage block."""

IMAGE_ATLAS = 0
IMAGE_NODES = 1
TEXTURE_ATLAS = 0
TEXTURE_NODES = 1
TEXTURE_STORE = 2
TEXTURE_COLOR = 3
TEXTURE_DEPTH = 4
"""Image and texture units: the frame's kernels, the kernels of field nodes, the cache,
and color and depth of a frame in textures."""

STORE_SIDE_BITS = 12
STORE_SIDE = 1 << STORE_SIDE_BITS
"""Edge of a page of the cache, a texture array addressed as one line: no storage block
could hold a cache over the whole field."""

KERNEL_WORDS = 3
NODE_WORDS = 2
PART_MAPS = 3
PART_WORDS = PART_MAPS + 6
"""uvec4 words of one record: a frame's kernel, a node kernel, the parts of a kernel
(nodes, weights at both ends of the interval, and from PART_MAPS on maps)."""

FIELD_CORNERS = 3
"""Field nodes around a cell, and nodes of pupil and accommodation around a state: the
corners of the surrounding triangle.  With four each, a frame needed 1.06 to 1.38 times
as many PSFs, and five eyes between nodes had 45.1 to 46.2 dB in the median against the
dense reference, instead of 45.1 to 46.4."""

MAX_LEVEL = 3
NO_LEVEL = 0x7FFFFFFF
"""Fragments merge to squares of up to 2**3 pixels, a block; NO_LEVEL is the offset of a
level for which a kernel is too sharp."""

MAX_LAYERS = 2048
"""Largest number of layers of a frame."""

NO_INDEX = 0xFFFFFFFF
"""Kernel of a (cell, interval) pair, or node kernel of a (field node, interval) pair,
that no frame has used yet."""

PLAN_FOR_NODES = 0
PLAN_FOR_KERNELS = 1
PLAN_FOR_WORK = 2
PLAN_DISPATCHES = 7
"""Dispatches of the passes that plan and blend kernels, each four words as in
DISPATCHES: nodes, kernels, and five work lists (texels of node kernels, and of the
kernels at each level)."""

PLAN_KERNELS = DISPATCH_WORDS * PLAN_DISPATCHES
PLAN_NODES = PLAN_KERNELS + 1
PLAN_NODE_TEXELS = PLAN_KERNELS + 2
PLAN_TEXELS = PLAN_KERNELS + 3
PLAN_BASE_TEXELS = PLAN_KERNELS + 4
PLAN_REACH = PLAN_KERNELS + 5
PLAN_OVERFLOWS = PLAN_KERNELS + 6
PLAN_MISSING = PLAN_KERNELS + 7
PLAN_OLD_KERNELS = PLAN_KERNELS + 8
PLAN_OLD_NODES = PLAN_KERNELS + 9
PLAN_WORK = PLAN_KERNELS + 10
PLAN_WORDS = PLAN_WORK + 6
"""Words of the plan of an eye's kernels: kernels, node kernels, texels of both, texels
of the kernels at level 0, largest reach px, whether something did not fit, missing
PSFs; kernels and node kernels of earlier frames; lengths of the work lists."""

PSF_WORDS = 5
"""Words of a cached kernel's record: offset, reach, radius px, spread px, peak."""

MIN_NODE_SHARE = 5e-5
"""Share of a node of defocus below which the passes do not read it: a state at a node
does not read its neighbor for the rounding of 32-bit floats."""

MAP_WORDS = 4
CELL_WORDS = FIELD_CORNERS * (2 + MAP_WORDS)
"""Words of a linear map, and of a cell's record: three field nodes, their weights, and
three maps."""

READ_WORDS = 3
"""Words of a neighbor in pupil and accommodation: first group, scale, weight."""

MIN_SHIFT_PX = 0.5
"""Maps that would displace light by less are not applied: interpolation between stored
pixels blurs light by as much."""

MIN_SHIFT_RATIO = 0.1
"""Maps that change a kernel's size by less are not applied: blending the three field
nodes averages such differences.  At 5 mm over the field of the demo, the PSNR against
the image with all maps is 63 to 69 dB (cataract, myopia, keratoconus), and blending
takes half of the time."""

MIN_SHIFT_FADE_PX = 0.5
MIN_SHIFT_FADE_RATIO = 0.03
"""Above these limits, maps fade in: they are applied in full at this much more."""

KERNEL_TAIL_PX = 2.0
"""Light that a map displaces reaches about this far beyond the spread of a kernel."""

MAP_ROUNDING_PX = 1e-4
"""Tolerance with which a mapped reach ends on a pixel, for sums in 32-bit floats."""

MIN_SPREAD_PX = 1e-9
"""Spread of kernels that are empty."""

DEPTH_SQUARE_PX = 16
"""Edge of the squares of pixels whose nearest depth bounds the search for occluders."""

MAX_REACH_PX = 255
"""Reaches are stored in one byte per side; light that a map moves farther is lost."""

REACH_MARGIN_PX = 1.5
"""Light reaches this farther than a kernel: half a pixel for the edge of its disk, and
one for rounding."""

MAX_GROUPS = 65535
"""Work groups along one axis that every OpenGL 4.3 implementation allows."""

RECIPE_TAPS = 6
"""Cached kernels that one layer of a field node is blended from: three states, two
nodes of defocus each."""

WEIGHT_BITS = 16
WEIGHT_MASK = 0xFFFF
WEIGHT_MAX = 65535.0
"""A kernel texel holds the weights of both ends of its interval, in 16 bits each
relative to the interval's largest weight: one fetch instead of two, 1.4 times the
evaluations per second on a software renderer, and finer than half floats near the
peak."""

RECIPE_WORDS = 3 * RECIPE_TAPS
"""Words of one blending recipe: offsets, reaches, weights."""

BITS_PER_WORD = 32
BYTES_PER_WORD = 4
HALVES_PER_WORD = 2
BYTE_BITS = 8
BYTE_MASK = 0xFF
RGB = 3

ENGINES = ("auto", "gl", "native")
"""Frame engines: automatic choice, compute shaders, or compiled loops."""

BINDINGS = {
    "BINDING_COLOR_IN": 0,
    "BINDING_DEPTH_IN": 1,
    "BINDING_PIXELS": 2,
    "BINDING_PIXEL_LAYER": 3,
    "BINDING_FRAGMENT_COLOR": 4,
    "BINDING_FRAGMENT_PLACE": 5,
    "BINDING_BLOCKS": 6,
    "BINDING_BIN_COUNTS": 7,
    "BINDING_BIN_OFFSETS": 8,
    "BINDING_ENTRIES": 9,
    "BINDING_ENTRIES_SPARE": 10,
    "BINDING_KERNELS": 11,
    "BINDING_KERNEL_OF": 12,
    "BINDING_LAYER_DPT": 13,
    "BINDING_USED": 14,
    "BINDING_COLOR_OUT": 15,
    # The passes that build lists do not use the input color, those before them do not
    # use the output color, and the scan does not use fragments.  Fragments are made
    # after the used pairs are read, and before bins are counted.
    "BINDING_FRAGMENT_EDGE": 14,
    "BINDING_BLOCK_LIGHT": 7,
    "BINDING_TILES": 3,
    "BINDING_WINDOWS": 0,
    "BINDING_STATS": 15,
    "BINDING_DISPATCHES": 5,
    "BINDING_NODES": 0,
    "BINDING_PARTS": 1,
    "BINDING_RECIPES": 2,
    "BINDING_WORK": 3,
    "BINDING_FIELD_DEFOCUS": 12,
    "BINDING_ATLAS": 13,
    "BINDING_NODE_ATLAS": 14,
    "BINDING_PLAN": 10,
    "BINDING_READ_PSFS": 11,
    "BINDING_CELLS": 4,
    "BINDING_NODE_OF": 5,
    "BINDING_KERNEL_PAIRS": 6,
    "BINDING_NODE_PAIRS": 7,
    "BINDING_NODE_DEFOCUS": 8,
    "BINDING_READS": 9,
    "BINDING_STORE_VALUES": 1,
    "BINDING_STORE_SHIFTS": 4,
    "BINDING_STORE_STARTS": 5,
    "BINDING_STORE_PSFS": 6,
    "BINDING_SAMPLES": 0,
}
"""Storage buffer bindings; the reference software renderer allows 16 per stage.  The
passes that plan and blend kernels reuse numbers of the frame's bindings."""
