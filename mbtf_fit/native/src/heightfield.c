/* Rays and horizons of a periodic height field: the traversal of mbtf_gen/tile/tracers/heightfield_tracer.py, one ray
 * after the other. Lengths are in tile widths.
 */
#include "kernel.h"

#include <math.h>

#define EXPORT __attribute__((visibility("default")))
/* Level of the blocks at which rays from above begin. */
#define START 4
#define PI 3.14159265358979

static inline float smaller(float a, float b) { return a < b ? a : b; }
static inline float larger(float a, float b) { return a > b ? a : b; }
static inline float inverse(float x) { return 1.0f / (x >= 0 ? larger(x, 1e-18f) : smaller(x, -1e-18f)); }
static inline int32_t clip(int32_t i, int32_t last) { return i < 0 ? 0 : i > last ? last : i; }

/* Cell and position in it of a coordinate in cells, modulo the period; not a number becomes cell 0. */
static float place(float position, int32_t cells, int32_t *cell) {
    float p = position - floorf(position / (float)cells) * (float)cells;
    *cell = clip((int32_t)p, cells - 1);
    return p - (float)*cell;
}

/* Height at which the line through uv of the plane z = 0, along omega towards the viewer, meets the surface. */
float mbtf_height(const mbtf_heightfield *f, float u, float v, const float *omega, int32_t most) {
    const int32_t W = f->columns, H = f->rows, cells = W * H;
    const float dx = -omega[0] * (float)W, dy = -omega[1] * (float)H / f->aspect, dz = -omega[2];
    const float both = dx + dy, over_x = inverse(dx), over_y = inverse(dy), over_both = -inverse(both);
    const int right = dx >= 0, up = dy >= 0;
    int32_t column, row, level = f->finest < START ? f->finest : START, crossings = 0;
    float x = place(u * (float)W - 0.5f, W, &column), y = place(v * (float)H - 0.5f, H, &row), z = 0.0f;
    for (;;) {
        const int32_t size = 1 << level, i0 = column & (size - 1), j0 = row & (size - 1);
        const int32_t left = column - i0, low = row - j0;
        const float px = (float)i0 + x, py = (float)j0 + y;
        int32_t index = row * W + column;
        if (level)
            index = cells + (1 << (f->both_log2 - 2 * level)) + (row >> level << (f->columns_log2 - level)) +
                    (column >> level);
        const int32_t width = size < W - left ? size : W - left, height = size < H - low ? size : H - low;
        const float *node = f->nodes + 4 * (int64_t)index;
        const float to_x = ((right ? (float)width : 0.0f) - px) * over_x;
        const float to_y = ((up ? (float)height : 0.0f) - py) * over_y;
        const float end = larger(smaller(to_x, to_y), 0.0f);
        const float here = z - (px * node[1] + (py * node[2] + node[0]));
        const float slope = dz - dx * node[1] - dy * node[2];
        const float across = px + py - 1.0f;
        const float fold = larger(end * both + across, 0.0f) * node[3];
        const float diagonal = across * over_both;
        const int under = diagonal > 0 && diagonal < end && diagonal * slope + here <= 0;
        const int leaf = level == 0;
        const int open = end * slope + here - fold > 0 && (leaf || here > 0) && !under;
        if (!open) {
            if (leaf) {
                int second = across > 0 || (across == 0 && both > 0);
                if (diagonal > 0 && diagonal < end && diagonal * slope + here > 0) second = !second;
                const float bend = second ? node[3] : 0.0f;
                float t = (here - across * bend) / (both * bend - slope);
                t = t > 0 ? smaller(t, end) : 0.0f;
                return t * dz + z;
            }
            level--;
            continue;
        }
        const float nx = end * dx + px, ny = end * dy + py;
        z += end * dz;
        int32_t i, j;
        if (to_x <= to_y) {
            i = right ? width : -1;
            j = clip((int32_t)ny, height - 1);
            x = right ? 0.0f : 1.0f;
            y = ny - (float)j;
        } else {
            i = clip((int32_t)nx, width - 1);
            j = up ? height : -1;
            x = nx - (float)i;
            y = up ? 0.0f : 1.0f;
        }
        i += left;
        j += low;
        if (((i ^ column) | (j ^ row)) >> (level + 1)) level = level + 1 < f->finest ? level + 1 : f->finest;
        const int32_t wi = i < 0 ? W - 1 : i >= W ? 0 : i, wj = j < 0 ? H - 1 : j >= H ? 0 : j;
        if ((wi != i || wj != j) && ++crossings > most) break;
        column = wi;
        row = wj;
    }
    return z;
}

/* Heights z (n) at which the lines through uv (n, 2) of the plane z = 0 along omega (n, 3) meet the surface. A
 * ray may cross `most` borders of the tile. */
EXPORT void mbtf_trace(const mbtf_heightfield *f, int64_t n, const float *uv, const float *omega, int32_t most,
                       float *z) {
    for (int64_t k = 0; k < n; k++) z[k] = mbtf_height(f, uv[2 * k], uv[2 * k + 1], omega + 3 * k, most);
}

/* Elevation angles (vertices, count) of the horizon at vertices [from, to), for azimuths 2 pi k / count: of the
 * highest direction that meets the surface within a distance. Heights are read where the direction crosses the
 * grid's lines, those that it crosses more often; there they are linear between two vertices. */
EXPORT void mbtf_horizons(const mbtf_heightfield *f, int32_t count, float distance, int64_t from, int64_t to,
                          float *out) {
    const int32_t columns = f->columns, rows = f->rows;
    const float *z = f->z;
    for (int32_t k = 0; k < count; k++) {
        const double angle = 2.0 * PI * k / count;
        const float dx = (float)cos(angle) * (float)columns, dy = (float)sin(angle) * (float)rows / f->aspect;
        const int along_x = fabsf(dx) >= fabsf(dy);
        const float step = 1.0f / larger(fabsf(dx), fabsf(dy)), drift = (along_x ? dy : dx) * step;
        const int32_t sign = (along_x ? dx : dy) > 0 ? 1 : -1, most = (int32_t)(distance / step);
        /* The axis that the steps follow, and the other one: cells, and distance in memory. */
        const int32_t n = along_x ? columns : rows, m = along_x ? rows : columns;
        const int64_t down = along_x ? 1 : columns, over = along_x ? columns : 1;
        for (int64_t at = from; at < to; at++) {
            int32_t i = (int32_t)(along_x ? at % columns : at / columns);
            int32_t j = (int32_t)(along_x ? at / columns : at % columns);
            float between = 0.0f, tangent = 0.0f;
            for (int32_t s = 1; s <= most; s++) {
                const float length = (float)s * step;
                /* No vertex is higher than 0. */
                if (-z[at] <= length * tangent) break;
                i += sign;
                i = i == n ? 0 : i < 0 ? n - 1 : i;
                between += drift;
                if (between >= 1.0f) {
                    between -= 1.0f;
                    j = j + 1 == m ? 0 : j + 1;
                } else if (between < 0.0f) {
                    between += 1.0f;
                    j = j ? j - 1 : m - 1;
                }
                const float a = z[i * down + j * over], b = z[i * down + (j + 1 == m ? 0 : j + 1) * over];
                tangent = larger(tangent, (a + between * (b - a) - z[at]) / length);
            }
            out[at * count + k] = atanf(tangent);
        }
    }
}
