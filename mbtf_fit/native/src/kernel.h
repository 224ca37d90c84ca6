/* The fitter's kernel: what Python hands over, and what is compiled once per instruction set.
 *
 * Everything is float32. Queries are processed in blocks of BLOCK; within a block an activation is a row of
 * BLOCK floats, so that each instruction works on neighboring queries. Functions never allocate, keep no
 * state and start no threads: callers hand over memory and call them from as many threads as they like.
 */
#ifndef MBTF_KERNEL_H
#define MBTF_KERNEL_H

#include <stdint.h>

/* Version of what the functions mean; raised where sizes of structures do not show a change. */
#define INTERFACE 9
#define BLOCK 128
#define MAX_CHANNELS 64
#define MAX_WIDTH 128
#define MAX_LAYERS 16
#define MAX_LEVELS 16
#define MAX_PLACES 16
#define HINTS 7
/* Directions about fibers, which follow the hints of surfaces that have some. */
#define FIBER_HINTS 6
/* Floats that a vector register may hold at most; a weight's gradient is kept as so many partial sums. */
#define LANES 16

/* A fully connected network: `layers` matrices between `layers + 1` widths, packed by mbtf_pack. Gradients are
 * computed of its first `wanted` inputs. */
typedef struct {
    int32_t layers, wanted;
    int32_t widths[MAX_LAYERS + 1];
    const float *packed;
} mbtf_network;

/* Periodic textures of some levels, one after the other: rows of `channels` floats. */
typedef struct {
    int32_t levels;
    int32_t channels;
    int32_t rows[MAX_LEVELS], columns[MAX_LEVELS];
    int64_t starts[MAX_LEVELS + 1];
    const float *table;
} mbtf_textures;

/* Operations that mbtf_fit/backends/cpu/pattern.py matches: a neural offset unless offset.layers is 0, or traced heights
 * where depth_weights (a number per level) are given. Where height_scale is not 0, the offset texture holds
 * learned heights over height_scale, in one channel. The decoder sees so many coordinates of light and of view:
 * 2 (x, y) or 3; then, where they are not 0, half vector and difference vector, hints, light and view about the
 * known normal, the height times depth_scale and directions about fibers. With `gate`, its last output is that
 * of the gate. */
typedef struct {
    mbtf_textures pyramid, offset_texture;
    mbtf_network decoder, offset;
    float unit, most, offset_scale, grazing, aspect, irradiance_scale, depth_scale, height_scale, least_facing;
    int32_t coordinates, half_vector, hints, frame, fibers, gate;
    const float *depth_weights;
} mbtf_model;

/* A periodic height field: nodes and logarithms as in mbtf_core/height_planes.py; heights z (rows,
 * columns) at most 0, row index along +y. */
typedef struct {
    const float *nodes, *z;
    int32_t columns, rows, columns_log2, both_log2, finest;
    float aspect;
} mbtf_heightfield;

float mbtf_height(const mbtf_heightfield *f, float u, float v, const float *omega, int32_t most);

/* What is known of a surface, see mbtf_fit/surface/known.py: heights, filtered maps and horizons, places of a
 * footprint (offsets x, y in sigma), levels by which lookups are finer there, RMS angle per axis of the light,
 * reflectances of the dielectric (along the normal, and grazing) and of the clear coat, constants of R6 and R8. Where
 * `fibers` has levels, bounds of the coverage, of cosines and of the variance (mbtf_fit/ops/fibers.py). `light_depth`
 * is 0 without shadow rays. */
typedef struct {
    mbtf_heightfield heightfield;
    mbtf_textures maps, horizons, fibers;
    int32_t places;
    float offsets[2 * MAX_PLACES];
    float finer, light_width, light_blur, dielectric, edge, coat, least_view, albedo_spread[2], alpha2[2], voigt[2];
    float fiber_finer, least_tangents, least_cosine, least_spread, light_depth;
} mbtf_surface;

/* u (n, 2), sigma (n), omega_i and omega_o (n, 3), hints (n, HINTS) for relief, with fibers (n, HINTS + FIBER_HINTS). */
typedef struct {
    int64_t n;
    const float *u, *sigma, *omega_i, *omega_o, *hints;
} mbtf_queries;

/* Sums that one thread adds to. Texture rows are padded to a multiple of 8 floats, weights are LANES
 * partial sums each, depth weights are single numbers. */
typedef struct {
    float *pyramid, *offset_texture, *decoder, *offset, *depth_weights;
} mbtf_gradients;

/* Loss of a prediction p on a value t that the kernel takes by itself, the mean over queries and colors of
 *     relative · e² + squared · d² / scale² + chroma · (e - ē)²,   e = d / √(p² + scale²),   d = p - t,
 * ē the mean over the colors; p held still under the root and in the bound on d:
 *     |d| <= √(bound[0] + bound[1] |p| + bound[2] p²)   where `bounded`. */
typedef struct {
    float relative, squared, chroma, scale, bound[3];
    int32_t bounded;
} mbtf_loss;

/* Optimizer of one tensor: Adam (Kingma and Ba 2015) with the corrections of its means worked in. */
typedef struct {
    float rate, beta1, beta2, epsilon, root_correction2;
} mbtf_adam_step;

#endif
