/* Exported functions, and which instruction set runs them. */
#include "kernel.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#if !defined(__GNUC__)
#error "the kernel needs a compiler with vector types (GCC or Clang)"
#endif

#define EXPORT __attribute__((visibility("default")))

enum { PLAIN, RECTIFY, GATE, ADD };

static inline int32_t padded(int32_t channels) { return (channels + 7) / 8 * 8; }

/* Floats of a layer's packed matrix with its biases, and of that and its transposed without them. */
static inline int64_t packed_forward(int64_t inputs, int64_t outputs) { return (inputs + 1) * outputs; }
static inline int64_t packed_layer(int64_t inputs, int64_t outputs) {
    return packed_forward(inputs, outputs) + packed_forward(outputs, inputs);
}

/* Rows of a network's activations, its inputs and its answer included. */
static inline int64_t network_rows(const mbtf_network *net) {
    int64_t rows = 0;
    for (int k = 0; k <= net->layers; k++) rows += net->widths[k];
    return rows;
}

static int64_t state_floats(const mbtf_model *m) {
    return BLOCK * (8 + network_rows(&m->decoder) + (m->offset.layers ? network_rows(&m->offset) : 0));
}

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define NAME(x) JOIN(x, SUFFIX)
#define FUNCTION static TARGET
#if defined(__clang__)
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
typedef int32_t eight_indices __attribute__((vector_size(32)));
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, (eight_indices){__VA_ARGS__})
#endif
#define INLINE static inline __attribute__((always_inline)) TARGET

/* Portable: whatever the compiler's default is. */
#define SUFFIX _portable
#define TARGET
#define LANES_HERE 4
#if defined(__aarch64__)
#define VECTORS 4
#define TILE_OUTPUTS 6
#define OUTER_OUTPUTS 5
#define OUTER_INPUTS 4
#else
#define VECTORS 2
#define TILE_OUTPUTS 6
#define OUTER_OUTPUTS 4
#define OUTER_INPUTS 3
#endif
#include "variant.inc"

#if defined(__x86_64__)
#define SUFFIX _avx2
#define TARGET __attribute__((target("avx2,fma")))
#define LANES_HERE 8
#define VECTORS 2
#define TILE_OUTPUTS 6
#define OUTER_OUTPUTS 4
#define OUTER_INPUTS 3
#include "variant.inc"

#define SUFFIX _avx512
#define TARGET __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")))
#define LANES_HERE 16
#define VECTORS 4
#define TILE_OUTPUTS 6
#define OUTER_OUTPUTS 5
#define OUTER_INPUTS 4
#include "variant.inc"
#endif

static const mbtf_variant *const VARIANTS[] = {
#if defined(__x86_64__)
    &variant_avx512, &variant_avx2,
#endif
    &variant_portable,
};
#define COUNT ((int)(sizeof VARIANTS / sizeof *VARIANTS))

static int supported(const mbtf_variant *v) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (v == &variant_avx512)
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
               __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
               __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (v == &variant_avx2) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
    (void)v;
    return 1;
}

/* Variant number `k`, fastest first: its name, or NULL where there is none or this processor lacks it. */
EXPORT const char *mbtf_variant_name(int32_t k) {
    return k >= 0 && k < COUNT && supported(VARIANTS[k]) ? VARIANTS[k]->name : NULL;
}

EXPORT int32_t mbtf_variants(void) { return COUNT; }
EXPORT int32_t mbtf_block(void) { return BLOCK; }
EXPORT int32_t mbtf_lanes(void) { return LANES; }
/* Sizes of what the caller lays out, so that a kernel of another build is noticed. */
EXPORT int32_t mbtf_layout(void) {
    return (int32_t)(sizeof(mbtf_model) + 4096 * sizeof(mbtf_queries) + INTERFACE);
}

EXPORT int64_t mbtf_state_floats(const mbtf_model *m) { return state_floats(m); }
EXPORT int64_t mbtf_scratch_floats(void) { return 2 * MAX_WIDTH * BLOCK; }

/* Weights (outputs, inputs, taps), element (o, i, t) at w[o·down + i·across + t], into tiles of at most `most`
 * outputs. */
static float *pack_matrix(const float *w, int64_t down, int64_t across, int taps, const float *bias,
                          int outputs, int inputs, int most, float *to) {
    const int tiles = (outputs + most - 1) / most;
    for (int t = 0, o = 0; t < tiles; t++) {
        const int R = outputs / tiles + (t < outputs % tiles);
        for (int r = 0; r < R; r++) *to++ = bias ? bias[o + r] : 0.0f;
        for (int i = 0; i < inputs; i++)
            for (int tap = 0; tap < taps; tap++)
                for (int r = 0; r < R; r++) *to++ = w[(o + r) * down + i * across + tap];
        o += R;
    }
    return to;
}

EXPORT int64_t mbtf_packed_floats(const mbtf_network *net) {
    int64_t floats = 0;
    for (int k = 0; k < net->layers; k++) floats += packed_layer(net->widths[k], net->widths[k + 1]);
    return floats;
}

/* `parameters`: weight 0 (outputs, inputs), bias 0, weight 1, ... */
EXPORT void mbtf_pack(int32_t variant, const mbtf_network *net, const float *const *parameters, float *packed) {
    const int most = VARIANTS[variant]->tile_outputs;
    for (int k = 0; k < net->layers; k++) {
        const int inputs = net->widths[k], outputs = net->widths[k + 1];
        const float *w = parameters[2 * k];
        pack_matrix(w, inputs, 1, 1, parameters[2 * k + 1], outputs, inputs, most, packed);
        float *transposed = packed + packed_forward(inputs, outputs);
        pack_matrix(w, 1, inputs, 1, NULL, k ? inputs : net->wanted, outputs, most, transposed);
        packed += packed_layer(inputs, outputs);
    }
}

/* Values (n, 3). `state` keeps all blocks' activations where `keep`, one block's otherwise. */
EXPORT void mbtf_forward(int32_t variant, const mbtf_model *m, const mbtf_queries *q, int32_t clamp,
                         int32_t keep, float *state, float *out) {
    VARIANTS[variant]->forward(m, q, clamp, state, keep ? state_floats(m) : 0, out);
}

/* Gradients by textures and weights, from those by the values (n, 3), after a forward that kept its state. */
EXPORT void mbtf_backward(int32_t variant, const mbtf_model *m, const mbtf_queries *q, const float *state,
                          const float *by_value, float *scratch, const mbtf_gradients *to) {
    VARIANTS[variant]->backward(m, q, state, by_value, scratch, to);
}

/* Forward, loss and backward at once: the sum of the loss over queries and colors. `share` is what one of them
 * counts in the mean. `state` has room for one block, `out` for 6 BLOCK floats. */
EXPORT double mbtf_learn(int32_t variant, const mbtf_model *m, const mbtf_queries *q, const float *targets,
                         const mbtf_loss *loss, float share, float *state, float *scratch, float *out,
                         const mbtf_gradients *to) {
    return VARIANTS[variant]->learn(m, q, targets, loss, share, state, scratch, out, to);
}

/* Partial sums of all threads, from number `at` on, into gradients, in a fixed order; clears them. */
static void collect_sums(float *const *sums, int64_t at, int64_t threads, int64_t count, float *gradient) {
    for (int64_t i = 0; i < count; i++, at += LANES) {
        double sum = 0.0;
        for (int64_t t = 0; t < threads; t++)
            for (int lane = 0; lane < LANES; lane++) {
                sum += sums[t][at + lane];
                sums[t][at + lane] = 0.0f;
            }
        gradient[i] = (float)sum;
    }
}

/* Those of a network (weight 0, bias 0, ...). */
EXPORT void mbtf_collect_weights(const mbtf_network *net, float *const *sums, int64_t threads,
                                 float *const *gradients) {
    int64_t at = 0;
    for (int k = 0; k < 2 * net->layers; k++) {
        const int64_t outputs = net->widths[k / 2 + 1];
        const int64_t count = k % 2 ? outputs : outputs * net->widths[k / 2];
        collect_sums(sums, at, threads, count, gradients[k]);
        at += LANES * count;
    }
}

EXPORT void mbtf_collect(int32_t variant, float *const *sums, int64_t threads, int64_t channels, int64_t from,
                         int64_t to, float *out) {
    VARIANTS[variant]->collect(sums, threads, channels, from, to, out);
}

EXPORT void mbtf_adam(int32_t variant, const mbtf_adam_step *step, int64_t n, const float *gradient,
                      float *parameter, float *mean, float *square) {
    VARIANTS[variant]->adam(step, n, gradient, parameter, mean, square);
}

EXPORT void mbtf_blur_down(int32_t variant, const float *texture, int64_t rows, int64_t width,
                           const float *taps, int64_t number, int64_t from, int64_t to, const float **pointers,
                           float *out) {
    VARIANTS[variant]->blur_down(texture, rows, width, taps, number, from, to, pointers, out);
}

EXPORT void mbtf_blur_across(int32_t variant, const float *texture, int64_t columns, int64_t channels,
                             const float *taps, int64_t number, int64_t from, int64_t to,
                             const float **pointers, float *wide, float *out) {
    VARIANTS[variant]->blur_across(texture, columns, channels, taps, number, from, to, pointers, wide, out);
}

EXPORT void mbtf_resample(int32_t variant, const float *texture, int64_t width, int64_t channels,
                          int64_t columns, const int32_t *down_index, const float *down, int64_t down_taps,
                          const int32_t *across_index, const float *across, int64_t across_taps, int64_t from,
                          int64_t to, float *wide, float *out) {
    VARIANTS[variant]->resample(texture, width, channels, columns, down_index, down, down_taps, across_index,
                                across, across_taps, from, to, wide, out);
}
