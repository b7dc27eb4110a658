"""Signatures of the functions of `source/loops.h`; see `estimator.native.functions`."""

FUNCTIONS = {
    "pixels": "record",
    "merge": "record",
    "place": "record",
    "blend": "record",
    "splat": "record",
    "shrink": "record",
    "map_ratios": "f8[] i8 f8[] f8[]",
    "fill_recipes": "record -> int",
    "fill_sizes": "record",
    "cell_means": "pool f4[] i8 i8[] f8[] i8 i8 i8[] f8[] i8 i8 f4[]",
    "add_scattered": "pool f4[] i8 i8 f4[] i8 i8 f8[] f8[] f8 f8[]",
    "resample": "pool f4[] f4[] i8 i8 f8[] f8[] f4[] f4[]",
    "needed_intervals": "record",
    "spread_nodes": "f8[] f8[] f8[] i8[] f8[] i8 i8 -> int",
    "node_blur": "f8[] f8[] f8[] i8[] f8[] f8[] f4[] i8 i8 i8",
    "count_bright": "pool i4[] i2[] i8 i8 i8 i8[]",
    "list_bright": "pool i4[] i2[] i8 i8 i8 i8[] i8[] i8[]",
    "fade_light": "f4[] i8 f8 f8 f8 f4[] f8[]",
    "merge_pixels": "i8[] i8[] i8[] f8[] i8 i8 i4[] i8 i8 i8[] f8[] i8[] -> int",
    "dim_pixels": "i8[] i8[] i8[] f4[] i8 i8[] f8[] f4[] i8",
}
