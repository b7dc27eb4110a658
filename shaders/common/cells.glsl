// The image in square cells, each with kernels of its own (filter_service/rendering/image_cells.py).
// cell_px is 0 where one cell is the whole image.

uniform int cell_px;
uniform int cell_columns;
uniform int first_row;            // of the strip within the image

int cell_of(ivec2 at) {
    if (cell_px == 0) return 0;
    return ((at.y + first_row) / cell_px) * cell_columns + at.x / cell_px;
}
