/* Where things lie in the memory for patches of the hierarchical model: the same for all instruction sets. */
#ifndef MBTF_PATCHES_H
#define MBTF_PATCHES_H

#include "kernel.h"

/* Rows and columns that a module crops at every border. */
#define REACH 2
#define MAX_MODULES (MAX_LAYERS - 2)
/* Rows of a block's state before the decoder's: u', v', level, weight of the finer level, 3 slopes. */
#define PATCH_ROWS 7

/* Convolutions of a module. */
enum { ONE, BEFORE3, THREE, BEFORE5, FIVE, POOLED, BRANCHES };
#define MAX_CONVOLUTIONS (MAX_MODULES * BRANCHES + 1)

/* Where a convolution's packed weights, their transpose, and their gradients begin. */
typedef struct {
    int32_t inputs, outputs, size;
    int64_t packed, transposed, sums;
} convolution;

static inline int64_t columns_of(const convolution *c) { return (int64_t)c->inputs * c->size * c->size; }

/* All convolutions behind the first layer, the last one included; returns their number. */
static int convolutions(const mbtf_inception *d, convolution *list) {
    const int32_t pooled = d->width - d->one - d->three - d->five;
    const int32_t inputs[BRANCHES] = {d->width, d->width, d->before3, d->width, d->before5, d->width};
    const int32_t outputs[BRANCHES] = {d->one, d->before3, d->three, d->before5, d->five, pooled};
    const int32_t sizes[BRANCHES] = {1, 1, 3, 1, 5, 1};
    const int count = d->modules * BRANCHES + 1;
    int64_t packed = 0, sums = 0;
    for (int k = 0; k < count; k++) {
        const int branch = k % BRANCHES, last = k == count - 1;
        convolution *c = &list[k];
        c->inputs = last ? d->width : inputs[branch];
        c->outputs = last ? 3 : outputs[branch];
        c->size = last ? 1 : sizes[branch];
        c->packed = packed;
        c->transposed = packed + (columns_of(c) + 1) * c->outputs;
        c->sums = sums;
        packed = c->transposed + ((int64_t)c->outputs * c->size * c->size + 1) * c->inputs;
        sums += (columns_of(c) + 1) * c->outputs;
    }
    return count;
}

/* Rows that a module computes: before the two larger convolutions, the maxima, the outputs. Gradients have the
 * first three in the same order. */
typedef struct {
    float *before3, *before5, *most, *y;
} module_buffers;

static inline module_buffers buffers_of(const mbtf_inception *d, float *rows, int64_t pitch) {
    module_buffers r;
    r.before3 = rows;
    r.before5 = r.before3 + d->before3 * pitch;
    r.most = r.before5 + d->before5 * pitch;
    r.y = r.most + d->width * pitch;
    return r;
}

/* Memory of a group of patches. Their positions are numbered one after the other. Flat activations have rows of
 * `pitch` floats, gradients of a single patch rows of `wide` floats, of which `lead` come before its first
 * number. */
typedef struct {
    int64_t area, positions, blocks, pitch, flat_floats, block_floats, lead, wide, scratch_floats;
    int32_t features, module_rows, patch_rows;
} patch_layout;

static patch_layout layout_of(const mbtf_model *m, int64_t rows, int64_t columns, int64_t items) {
    const mbtf_inception *d = &m->inception;
    /* What the windows of the last position reach, and what vectors write behind it. */
    const int64_t behind = (2 * REACH * (columns + 1) + 2 * 64 + 15) / 16 * 16;
    patch_layout l;
    l.area = rows * columns;
    l.positions = l.area * items;
    l.blocks = (l.positions + BLOCK - 1) / BLOCK;
    l.pitch = l.blocks * BLOCK + behind;
    l.features = m->pyramid.channels + 4 * m->bands;
    l.module_rows = d->before3 + d->before5 + 2 * d->width;
    const int64_t flat_rows = d->modules ? d->width + (int64_t)d->modules * l.module_rows + 6 : 0;
    l.flat_floats = flat_rows * l.pitch;
    const int64_t offset_rows = m->offset.layers ? network_rows(&m->offset) : 0;
    l.block_floats = BLOCK * (PATCH_ROWS + network_rows(&m->decoder) + offset_rows);
    l.lead = behind;
    l.wide = l.lead + (l.area + 15) / 16 * 16 + behind;
    /* Two modules' gradients in turn, those within a module, and the positions of the maxima. */
    l.patch_rows = d->modules ? d->width + l.module_rows + 1 : 0;
    l.scratch_floats = 2 * MAX_WIDTH * BLOCK + l.patch_rows * l.wide + (d->modules ? d->width * l.pitch : 0);
    return l;
}

/* Numbers of a patch's values. */
static inline int64_t values_of(const mbtf_model *m, const mbtf_patches *p) {
    const int64_t crop = 2 * REACH * m->inception.modules;
    return 3 * (p->rows - crop) * (p->columns - crop);
}

/* Items [first, first + group) of patches. */
static mbtf_patches part_of(const mbtf_model *m, const mbtf_patches *p, int64_t first, int64_t group) {
    mbtf_patches part = *p;
    part.items = p->items - first < group ? p->items - first : group;
    part.u += first * p->rows * p->columns * 2;
    part.sigma += first;
    part.omega_o += 3 * first;
    part.factors += first * 2 * m->bands;
    part.inputs += first * m->inputs;
    return part;
}

#endif
