// Square cells of the image, each with its own kernels
// (filter_service/rendering/image_cells.py).  cell_px is 0 if one cell is the whole image.

uniform int cell_px;
uniform int cell_columns;
uniform int first_row;            // of the strip within the frame
uniform int border_px;            // around the image, with its edge repeated
uniform ivec2 image_size_px;

// Pixel of the image that a pixel of the strip shows or repeats.
ivec2 image_place(ivec2 at) {
    ivec2 place = at + ivec2(0, first_row) - border_px;
    return clamp(place, ivec2(0), image_size_px - 1);
}

int cell_of(ivec2 at) {
    if (cell_px == 0) return 0;
    ivec2 cell = image_place(at) / cell_px;
    return cell.y * cell_columns + cell.x;
}
