// One PSF on its way through the passes `psf_*`; psfs/gpu_build_records.py writes it.  Pupil
// coordinates x, y in -1..1 over the bounding box, pixels x right, y up, as
// estimator/psf/pupil.py has them.

struct PsfRecord {
    vec4 polynomial[7];  // of W, by powers of x, then of y; waves: turns, rays: um
    vec4 edge_px[6];     // twelve slopes along the pupil's edge, two each
    vec4 log_amplitude;  // 1, x, y, x²
    vec4 pupil;          // half width x, y (um/px), shear, edge light (um)
    vec4 more;           // log amplitude of xy and y², share of the method, 1 to add
    ivec4 place;         // kernel's start, radius (px), slot of its total, scratch start
    vec4 light;          // waves: samples across x, y, light per intensity
                         // rays: passed, wavelength (um), steps of light per cell
    ivec4 grid;          // waves: lit columns, lit rows, centre x, y in samples
                         // rays: cells across, points on the edge
    ivec4 pixels;        // waves: samples a pixel x, y, start of the stripes
    ivec4 window;        // pixels x0, x1, y0, y1 that the waves reach
    ivec4 taps;          // filter of x: start, reach; of y: start, reach
};

const int PSF_TERMS = 7;
