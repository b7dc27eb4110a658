// The image in square cells, each with kernels of its own (filter_service/rendering/image_cells.py).
// cell_px is 0 where one cell is the whole image.

uniform int cell_px;
uniform int cell_columns;
uniform int first_row;            // of the strip within the frame
uniform int border_px;            // of the frame around the image, whose edge it repeats
uniform ivec2 image_size_px;

// Pixel of the image that a pixel of the strip is, or repeats.
ivec2 image_place(ivec2 at) {
    ivec2 place = at + ivec2(0, first_row) - border_px;
    return clamp(place, ivec2(0), image_size_px - 1);
}

int cell_of(ivec2 at) {
    if (cell_px == 0) return 0;
    ivec2 cell = image_place(at) / cell_px;
    return cell.y * cell_columns + cell.x;
}
