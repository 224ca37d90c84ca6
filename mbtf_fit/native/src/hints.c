/* Hints of queries: what is known of the surface that they see (mbtf_fit/surface/known.py). */
#include "kernel.h"

#include <math.h>

#define EXPORT __attribute__((visibility("default")))
#define PI 3.14159265f
/* Channels of the maps: center of the slopes (x, y), moments (xx, xy, yy), base color; squared alpha, metallic of
 * glossy ones; weight, squared alpha of the clear coat of coated ones. */
#define GLOSSY 10
#define COATED 12
/* Rays that are traced before the first of them is shaded. */
#define AHEAD 8

static inline float clamped(float x, float low, float high) { return x > low ? (x < high ? x : high) : low; }

static inline float wrapped(float i, float size) {
    const float w = i - size * floorf(i / size);
    return w >= 0.0f && w < size ? w : 0.0f;
}

/* Rows of a table around a point, and their weights: four of each of two levels. */
typedef struct {
    int64_t rows[8];
    float weights[8];
} place;

static void find(const mbtf_textures *t, float level, float u, float v, place *p) {
    const int last = t->levels - 1;
    level = clamped(level, 0.0f, (float)last);
    int coarse = (int)level;
    if (coarse > last - 1) coarse = last > 0 ? last - 1 : 0;
    const float finer = level - (float)coarse;
    for (int k = 0; k < 2; k++) {
        const int s = coarse + k < last ? coarse + k : last;
        const float columns = (float)t->columns[s], rows = (float)t->rows[s], scale = k ? finer : 1.0f - finer;
        const float x = u * columns - 0.5f, y = (1.0f - v) * rows - 0.5f;
        const float fx = x - floorf(x), fy = y - floorf(y);
        const int64_t left = (int64_t)wrapped(floorf(x), columns), top = (int64_t)wrapped(floorf(y), rows);
        const int64_t right = left + 1 < t->columns[s] ? left + 1 : 0, bottom = top + 1 < t->rows[s] ? top + 1 : 0;
        const int64_t upper = t->starts[s] + top * t->columns[s], lower = t->starts[s] + bottom * t->columns[s];
        p->rows[4 * k] = upper + left;
        p->rows[4 * k + 1] = upper + right;
        p->rows[4 * k + 2] = lower + left;
        p->rows[4 * k + 3] = lower + right;
        p->weights[4 * k] = scale * (1.0f - fx) * (1.0f - fy);
        p->weights[4 * k + 1] = scale * fx * (1.0f - fy);
        p->weights[4 * k + 2] = scale * (1.0f - fx) * fy;
        p->weights[4 * k + 3] = scale * fx * fy;
    }
}

/* Where a view ray meets the surface: rows that are read there. */
typedef struct {
    /* Height; visibility by the shadow ray, where one is traced. */
    float z, lit;
    place maps, horizons, fibers;
} hit;

/* Ask for a place's rows ahead of their use. */
static void prefetch(const mbtf_textures *t, const place *p) {
    for (int k = 0; k < 8; k++)
        for (int c = 0; c < t->channels; c += 16) __builtin_prefetch(t->table + p->rows[k] * t->channels + c);
}

/* Share of the footprint's horizons that are lower than the light. */
static float lower_horizons(const mbtf_surface *s, const place *p, const float *light) {
    const int count = s->horizons.channels / 2;
    /* A vertical light has azimuth 0, whatever the signs of its zeros. */
    float azimuth = atan2f(light[1] + 0.0f, light[0] + 0.0f) * ((float)count / (2.0f * PI));
    azimuth -= (float)count * floorf(azimuth / (float)count);
    const int first = (int)clamped(azimuth, 0.0f, (float)(count - 1)), after = (first + 1) % count;
    const float weight = azimuth - (float)first;
    float mean = 0.0f, square = 0.0f;
    for (int k = 0; k < 8; k++) {
        const float *row = s->horizons.table + p->rows[k] * s->horizons.channels;
        mean += p->weights[k] * (row[first] + weight * (row[after] - row[first]));
        square += p->weights[k] * (row[count + first] + weight * (row[count + after] - row[count + first]));
    }
    const float blur = s->light_blur * s->light_width, variance = square - mean * mean;
    const float total = (variance > 0.0f ? variance : 0.0f) + blur * blur;
    const float elevation = asinf(clamped(light[2], 0.0f, 1.0f));
    return 0.5f + 0.5f * erff((elevation - mean) / sqrtf(2.0f * (total > 1e-8f ? total : 1e-8f)));
}

/* Symmetric 2 x 2 matrix. */
typedef struct {
    float xx, xy, yy;
} matrix;

/* Area that facets about a center show to a direction, per area of the reference plane, as half the sum of both. */
typedef struct {
    float plane, root;
} projection;

static projection project(const float *w, float cx, float cy, matrix a) {
    const float p = w[2] - cx * w[0] - cy * w[1];
    const float square = p * p + a.xx * w[0] * w[0] + 2.0f * a.xy * w[0] * w[1] + a.yy * w[1] * w[1];
    return (projection){p, sqrtf(square > 0.0f ? square : 0.0f)};
}

static float shown(projection p) { return 0.5f * (p.plane + p.root); }

/* Mean cosine of the facets that a direction sees, whose center has a normal of some z. */
static float mean_cosine(projection p, float nz) { return clamped(nz * p.root, 1e-10f, 1.0f); }

static float schlick(float cosine) {
    const float rest = 1.0f - clamped(cosine, 0.0f, 1.0f);
    return rest * rest * rest * rest * rest;
}

/* Twice the scatter of the slopes. */
static matrix spread(const float *m) {
    matrix a = {m[2] - m[0] * m[0], m[3] - m[0] * m[1], m[4] - m[1] * m[1]};
    a.xx = a.xx > 0.0f ? a.xx : 0.0f;
    a.yy = a.yy > 0.0f ? a.yy : 0.0f;
    const float most = sqrtf(a.xx * a.yy);
    return (matrix){2.0f * a.xx, 2.0f * clamped(a.xy, -most, most), 2.0f * a.yy};
}

/* Covariance of the slopes of half vectors, whose light has a width. */
static matrix light_widening(const float *i, const float *o, float width) {
    const float up = i[2] + o[2], sx = -(i[0] + o[0]) / up, sy = -(i[1] + o[1]) / up;
    const float x = i[0] + i[2] * sx, y = i[1] + i[2] * sy, scale = width * width / (up * up);
    return (matrix){scale * (1.0f + sx * sx - x * x), scale * (sx * sy - x * y), scale * (1.0f + sy * sy - y * y)};
}

/* a + factor b */
static matrix combined(matrix a, float factor, matrix b) {
    return (matrix){a.xx + factor * b.xx, a.xy + factor * b.xy, a.yy + factor * b.yy};
}

/* Root of the determinant of a matrix a, and x' a^-1 x. */
typedef struct {
    float root, square;
} form;

static form inverse(matrix a, float least, float x, float y) {
    float determinant = a.xx * a.yy - a.xy * a.xy;
    const float bound = 0.25f * least * (a.xx + a.yy);
    determinant = determinant > bound ? determinant : bound;
    const float square = (a.yy * x * x - 2.0f * a.xy * x * y + a.xx * y * y) / determinant;
    return (form){sqrtf(determinant), square > 0.0f ? square : 0.0f};
}

/* Light that facets of a squared alpha reflect of half vector w about slopes, where their reflectance is 1;
 * the light widens the slopes by b. */
static float reflected(const mbtf_surface *s, float light, float alpha2, const float *m, matrix a, matrix b,
                       const float *w, const float *o) {
    const float length2 = m[0] * m[0] + m[1] * m[1];
    const float below = 1.0f / (1.0f + alpha2 * length2);
    const float kappa = (1.0f - alpha2) * below, rho = alpha2 * (1.0f + length2) * below;
    const float cx = kappa * m[0], cy = kappa * m[1];
    a = combined(a, rho, (matrix){1.0f + cx * m[0], cx * m[1], 1.0f + cy * m[1]});
    const float facing = shown(project(o, cx, cy, a));
    const float x = w[0] + w[2] * cx, y = w[1] + w[2] * cy, up2 = w[2] * w[2];
    const float own = inverse(a, alpha2, x, y).root, square = b.xx * b.yy - b.xy * b.xy;
    const float ratio = own / sqrtf(square > 1e-20f ? square : 1e-20f);
    const form wide = inverse(combined(a, s->voigt[0], b), alpha2, x, y);
    const form narrow = inverse(combined(b, s->voigt[1] + 0.5f / (ratio + s->voigt[1]), a), alpha2, x, y);
    const float share = own / wide.root, inside = up2 + wide.square;
    const float gaussian = expf(-0.5f * narrow.square / up2) / (2.0f * narrow.root * up2 * up2);
    const float density = (share / (wide.root * inside * inside) + (1.0f - share) * gaussian) / PI;
    return light * density / (4.0f * (facing > s->least_view ? facing : s->least_view));
}

/* Squared cosine that facets add to the albedo of a lobe at grazing angles. */
static float added(const mbtf_surface *s, float alpha2) {
    return alpha2 / (s->albedo_spread[0] + s->albedo_spread[1] * sqrtf(alpha2));
}

/* Energy that a lobe leaves of a direction, by what its facets add. */
static float left(float f0, float f90, float added, float cosine) {
    const float cosine2 = cosine * cosine;
    return 1.0f - f0 - (f90 - f0) * schlick(sqrtf(cosine2 + added * (1.0f - cosine2)));
}

/* Mean of that over directions, weighted by the cosine. */
static float mean_left(float f0, float f90, float added) {
    const float t = 1.0f - sqrtf(added), t2 = t * t;
    return 1.0f - f0 - (f90 - f0) * 2.0f * t2 * t2 * t2 * (1.0f / 6.0f - t / 7.0f) / (1.0f - added);
}

/* Share of the facets in the light, of those that the viewer sees. */
static float own_shadowing(float alpha2, float light, float view) {
    const float a = sqrtf(alpha2 + (1.0f - alpha2) * light * light);
    const float b = sqrtf(alpha2 + (1.0f - alpha2) * view * view);
    return light * (view + b) / (light * b + view * a);
}

/* Adds irradiance, normal (x, y) and core at a surface point. */
static void shade(const mbtf_surface *s, const hit *h, const float *i, const float *o, float *sum) {
    float m[COATED] = {0};
    const int channels = s->maps.channels;
    for (int k = 0; k < 8; k++) {
        const float *row = s->maps.table + h->maps.rows[k] * channels;
        for (int c = 0; c < channels; c++) m[c] += h->maps.weights[k] * row[c];
    }
    const float nz = 1.0f / sqrtf(m[0] * m[0] + m[1] * m[1] + 1.0f);
    const matrix a = spread(m);
    const float lower = lower_horizons(s, &h->horizons, i);
    const float light = (s->light_depth > 0.0f ? 0.5f * (lower + h->lit) : lower) / i[2];
    const projection lit = project(i, m[0], m[1], a);
    const float irradiance = light * nz * shown(lit);
    float core[3];
    for (int c = 0; c < 3; c++) core[c] = irradiance * m[5 + c] / PI;
    if (channels >= GLOSSY) {
        float w[3] = {i[0] + o[0], i[1] + o[1], i[2] + o[2]};
        const float length = sqrtf(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
        for (int c = 0; c < 3; c++) w[c] /= length;
        const float rest = schlick(o[0] * w[0] + o[1] * w[1] + o[2] * w[2]);
        const matrix b = light_widening(i, o, s->light_width);
        const float alpha2 = clamped(m[8], s->alpha2[0], s->alpha2[1]);
        const float xi = mean_cosine(lit, nz), xo = mean_cosine(project(o, m[0], m[1], a), nz);
        const float more = added(s, alpha2), dielectric = s->dielectric, grazing = s->edge;
        const float base = (1.0f - m[9]) * left(dielectric, grazing, more, xi) * left(dielectric, grazing, more, xo) /
                           mean_left(dielectric, grazing, more);
        const float lobe = own_shadowing(alpha2, xi, xo) * reflected(s, light, alpha2, m, a, b, w, o);
        const float edge = grazing + m[9] * (1.0f - grazing);
        for (int c = 0; c < 3; c++) {
            const float f0 = dielectric + m[9] * (m[5 + c] - dielectric);
            core[c] = base * core[c] + (f0 + (edge - f0) * rest) * lobe;
        }
        if (channels == COATED) {
            const float f0 = s->coat, rough = clamped(m[11], s->alpha2[0], s->alpha2[1]);
            const float coat = m[10] * (f0 + (1.0f - f0) * rest) * own_shadowing(rough, xi, xo) *
                               reflected(s, light, rough, m, a, b, w, o);
            const float over = added(s, rough), below = left(m[10] * f0, m[10], over, xi) * left(m[10] * f0, m[10], over, xo);
            for (int c = 0; c < 3; c++) core[c] = below * core[c] + coat;
        }
    }
    sum[0] += irradiance;
    sum[1] -= nz * m[0];
    sum[2] -= nz * m[1];
    for (int c = 0; c < 3; c++) sum[3 + c] += core[c];
}

/* Symmetric 3 x 3 matrix: xx, xy, xz, yy, yz, zz. */
typedef struct {
    float m[6];
} tensor;

static float trace(const tensor *a) { return a->m[0] + a->m[3] + a->m[5]; }

/* x' a y */
static float bilinear(const tensor *a, const float *x, const float *y) {
    const float *m = a->m;
    return m[0] * x[0] * y[0] + m[3] * x[1] * y[1] + m[5] * x[2] * y[2] + m[1] * (x[0] * y[1] + x[1] * y[0]) +
           m[2] * (x[0] * y[2] + x[2] * y[0]) + m[4] * (x[1] * y[2] + x[2] * y[1]);
}

/* Product of matrices that commute. */
static tensor product(const tensor *a, const tensor *b) {
    const float *m = a->m, *n = b->m;
    return (tensor){{m[0] * n[0] + m[1] * n[1] + m[2] * n[2], m[0] * n[1] + m[1] * n[3] + m[2] * n[4],
                     m[0] * n[2] + m[1] * n[4] + m[2] * n[5], m[1] * n[1] + m[3] * n[3] + m[4] * n[4],
                     m[1] * n[2] + m[3] * n[4] + m[4] * n[5], m[2] * n[2] + m[4] * n[4] + m[5] * n[5]}};
}

/* Adds directions about the fibers at a surface point. */
static void about_fibers(const mbtf_surface *s, const hit *h, const float *i, const float *o, float *sum) {
    float found[7] = {0};
    for (int k = 0; k < 8; k++)
        for (int c = 0; c < 7; c++) found[c] += h->fibers.weights[k] * s->fibers.table[h->fibers.rows[k] * 7 + c];
    const float all = found[0] + found[3] + found[5], coverage = all > 0.0f ? all : 0.0f;
    const float covered = coverage > s->least_tangents ? coverage : s->least_tangents;
    tensor mean, axis;
    for (int c = 0; c < 6; c++) mean.m[c] = found[c] / covered;
    axis = mean;
    for (int k = 0; k < 3; k++) {
        axis = product(&axis, &axis);
        const float size = trace(&axis);
        for (int c = 0; c < 6; c++) axis.m[c] /= size > 1e-12f ? size : 1e-12f;
    }
    const float half[3] = {i[0] + o[0], i[1] + o[1], i[2] + o[2]};
    const float light = clamped(bilinear(&axis, i, i), 0.0f, 1.0f), view = clamped(bilinear(&axis, o, o), 0.0f, 1.0f);
    const float both = bilinear(&axis, i, o), cosines = sqrtf((1.0f - light) * (1.0f - view));
    const float apart = i[0] * o[0] + i[1] * o[1] + i[2] * o[2] - both, off = light + view + 2.0f * both;
    const tensor shared = product(&mean, &axis);
    const float spread = bilinear(&mean, half, half) - off * trace(&shared);
    float variance = found[6] / covered + (spread > 0.0f ? spread : 0.0f);
    variance = variance > s->least_spread ? variance : s->least_spread;
    sum[0] += coverage * expf(-0.5f * off / variance) / sqrtf(2.0f * PI * variance);
    sum[1] += clamped(apart / (cosines > s->least_cosine ? cosines : s->least_cosine), -1.0f, 1.0f);
    sum[2] += light;
    sum[3] += view;
    sum[4] += both;
    sum[5] += coverage;
}

/* Traces one view ray of a query, and from there a shadow ray. */
static void meet(const mbtf_surface *s, const mbtf_queries *q, int64_t k, int p, float top, int32_t most, hit *h) {
    const float aspect = s->heightfield.aspect, *u = q->u + 2 * k, *o = q->omega_o + 3 * k;
    const float size = 2.0f * q->sigma[k];
    const float level = clamped(-log2f(size > 1e-30f ? size : 1e-30f), 0.0f, top);
    const float sigma = 0.5f * exp2f(-level);
    /* Unit vector of the view's azimuth; (1, 0) of a vertical one. */
    const float length = sqrtf(o[0] * o[0] + o[1] * o[1]);
    const float ax = length > 0.0f ? o[0] / length : 1.0f, ay = length > 0.0f ? o[1] / length : 0.0f;
    const float across = sigma * s->offsets[2 * p], along = sigma * s->offsets[2 * p + 1];
    /* Far from the first tile, the rounding of uv would count as depth below the surface. */
    const float x = u[0] - floorf(u[0]) + along * ax - across * ay;
    const float y = u[1] - floorf(u[1]) + (along * ay + across * ax) / aspect;
    h->z = mbtf_height(&s->heightfield, x, y, o, most);
    const float t = h->z / o[2], at = level + s->finer, hx = x + t * o[0], hy = y + t * o[1] / aspect;
    find(&s->maps, at, hx, hy, &h->maps);
    find(&s->horizons, at, hx, hy, &h->horizons);
    if (s->light_depth > 0.0f) {
        const float *i = q->omega_i + 3 * k, down = h->z / i[2];
        const float first = mbtf_height(&s->heightfield, hx - down * i[0], hy - down * i[1] / aspect, i, most);
        h->lit = first > h->z ? expf((h->z - first) / (i[2] * s->light_depth)) : 1.0f;
    }
    if (s->fibers.levels) find(&s->fibers, level + s->fiber_finer, hx, hy, &h->fibers);
}

/* Hints (n, HINTS) of queries, with fibers (n, HINTS + FIBER_HINTS); `top` is the finest level of the data. Rows of some queries are on their way from
 * memory while the rays of others are traced. */
EXPORT void mbtf_hints(const mbtf_surface *s, const mbtf_queries *q, float top, int32_t most, float *out) {
    hit hits[AHEAD];
    const int64_t places = s->places, rays = q->n * places;
    const int columns = s->fibers.levels ? HINTS + FIBER_HINTS : HINTS;
    for (int64_t ray = 0; ray < rays + AHEAD; ray++) {
        hit *h = hits + ray % AHEAD;
        if (ray >= AHEAD) {
            const int64_t before = ray - AHEAD, k = before / places;
            float *to = out + columns * k;
            if (before % places == 0)
                for (int c = 0; c < columns; c++) to[c] = 0.0f;
            to[0] += h->z;
            shade(s, h, q->omega_i + 3 * k, q->omega_o + 3 * k, to + 1);
            if (s->fibers.levels) about_fibers(s, h, q->omega_i + 3 * k, q->omega_o + 3 * k, to + HINTS);
            if (before % places == places - 1)
                for (int c = 0; c < columns; c++) to[c] /= (float)places;
        }
        if (ray >= rays) continue;
        meet(s, q, ray / places, (int)(ray % places), top, most, h);
        prefetch(&s->maps, &h->maps);
        prefetch(&s->horizons, &h->horizons);
        if (s->fibers.levels) prefetch(&s->fibers, &h->fibers);
    }
}
