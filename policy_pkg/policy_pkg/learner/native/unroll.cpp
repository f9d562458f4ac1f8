// The agent net, Linear - ReLU - GRU - Linear, over a packed batch: forward, and backward by hand.
//
// Every value is one chain of fused multiply-adds in ascending order of what is summed, whatever the
// vector's width: vectors run over outputs, never over what is summed. So a build for AVX2 and one for
// AVX-512 give the same bits, and a row has the same bits in every batch. Only sums over rows, the
// gradients of weights, are cut into blocks of BLOCK rows, for accuracy; the blocks are the same in
// both builds. Build with -ffp-contract=off: the compiler must not fuse what is not fused here.
//
// Layout: row-major; the columns of a padded array are a multiple of PAD, and the padding is zero.

#include <immintrin.h>

#include <cstddef>
#include <cstring>
#include <vector>

namespace {

constexpr int PAD = 32;
constexpr int BLOCK = 256;

#ifdef __AVX512F__
constexpr int LANES = 16, TILE = 8;
using Vec = __m512;
inline Vec load(const float* p) { return _mm512_loadu_ps(p); }
inline void store(float* p, Vec v) { _mm512_storeu_ps(p, v); }
inline Vec all(float x) { return _mm512_set1_ps(x); }
inline Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a, b, c); }
inline Vec add(Vec a, Vec b) { return _mm512_add_ps(a, b); }
inline Vec sub(Vec a, Vec b) { return _mm512_sub_ps(a, b); }
inline Vec mul(Vec a, Vec b) { return _mm512_mul_ps(a, b); }
inline Vec quotient(Vec a, Vec b) { return _mm512_div_ps(a, b); }
inline Vec larger(Vec a, Vec b) { return _mm512_max_ps(a, b); }
inline Vec smaller(Vec a, Vec b) { return _mm512_min_ps(a, b); }
inline Vec rounded(Vec a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
inline Vec two_to(Vec n) {
    const __m512i i = _mm512_add_epi32(_mm512_cvtps_epi32(n), _mm512_set1_epi32(127));
    return _mm512_castsi512_ps(_mm512_slli_epi32(i, 23));
}
inline Vec where_positive(Vec x, Vec value) {
    return _mm512_maskz_mov_ps(_mm512_cmp_ps_mask(x, _mm512_setzero_ps(), _CMP_GT_OQ), value);
}
#else
constexpr int LANES = 8, TILE = 6;
using Vec = __m256;
inline Vec load(const float* p) { return _mm256_loadu_ps(p); }
inline void store(float* p, Vec v) { _mm256_storeu_ps(p, v); }
inline Vec all(float x) { return _mm256_set1_ps(x); }
inline Vec fma(Vec a, Vec b, Vec c) { return _mm256_fmadd_ps(a, b, c); }
inline Vec add(Vec a, Vec b) { return _mm256_add_ps(a, b); }
inline Vec sub(Vec a, Vec b) { return _mm256_sub_ps(a, b); }
inline Vec mul(Vec a, Vec b) { return _mm256_mul_ps(a, b); }
inline Vec quotient(Vec a, Vec b) { return _mm256_div_ps(a, b); }
inline Vec larger(Vec a, Vec b) { return _mm256_max_ps(a, b); }
inline Vec smaller(Vec a, Vec b) { return _mm256_min_ps(a, b); }
inline Vec rounded(Vec a) { return _mm256_round_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
inline Vec two_to(Vec n) {
    const __m256i i = _mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127));
    return _mm256_castsi256_ps(_mm256_slli_epi32(i, 23));
}
inline Vec where_positive(Vec x, Vec value) {
    return _mm256_and_ps(_mm256_cmp_ps(x, _mm256_setzero_ps(), _CMP_GT_OQ), value);
}
#endif

constexpr int WIDE = 2 * LANES;  // columns of a tile

// The maximum of two vectors is its second operand where one is not a number: data comes second, so
// that a NaN is never lost.

// e^x for x <= 0, by 2^n e^r with |r| <= ln(2) / 2 and the series of e^r to the seventh power.
inline Vec exp_negative(Vec x) {
    x = larger(all(-87.0f), x);
    const Vec n = rounded(mul(x, all(1.44269504f)));
    // ln 2 in two parts, the first with trailing zeros, so that n times it is exact
    const Vec r = fma(n, all(-1.42860677e-6f), fma(n, all(-0.693145752f), x));
    Vec p = all(1.0f / 5040);
    p = fma(p, r, all(1.0f / 720));
    p = fma(p, r, all(1.0f / 120));
    p = fma(p, r, all(1.0f / 24));
    p = fma(p, r, all(1.0f / 6));
    p = fma(p, r, all(0.5f));
    p = fma(p, r, all(1.0f));
    p = fma(p, r, all(1.0f));
    return mul(p, two_to(n));
}

inline Vec absolute(Vec x) { return larger(sub(all(0.0f), x), x); }

inline Vec sigmoid(Vec x) {
    const Vec e = exp_negative(sub(all(0.0f), absolute(x)));
    const Vec small = quotient(e, add(all(1.0f), e));  // of -|x|
    const Vec one_less = sub(all(1.0f), small);
    return add(where_positive(x, sub(one_less, small)), small);  // x > 0: 1 - small
}

inline Vec tanh_of(Vec x) {
    const Vec e = exp_negative(mul(all(-2.0f), absolute(x)));
    const Vec t = quotient(sub(all(1.0f), e), add(all(1.0f), e));  // of |x|
    return sub(where_positive(x, add(t, t)), t);
}

// C (ROWS x WIDE) = start + A B over k ascending; A's element (i, k) lies at a[i * row + k * step].
template <int ROWS>
inline void tile(int depth, const float* a, ptrdiff_t row, ptrdiff_t step, const float* b,
                 ptrdiff_t ldb, const Vec (&start)[ROWS][2], Vec (&c)[ROWS][2]) {
    for (int i = 0; i < ROWS; ++i) c[i][0] = start[i][0], c[i][1] = start[i][1];
    for (int k = 0; k < depth; ++k) {
        const Vec b0 = load(b + k * ldb), b1 = load(b + k * ldb + LANES);
        for (int i = 0; i < ROWS; ++i) {
            const Vec x = all(a[i * row + k * step]);
            c[i][0] = fma(x, b0, c[i][0]);
            c[i][1] = fma(x, b1, c[i][1]);
        }
    }
}

enum class Start { zero, bias, c };

// What goes into C: nothing, a bias per column, or what is there; or the product is added to C last.
template <int ROWS, bool ADD>
inline void product_rows(Start start, int columns, int depth, const float* a, ptrdiff_t row,
                         ptrdiff_t step, const float* b, ptrdiff_t panel, ptrdiff_t ldb,
                         const float* bias, float* c, ptrdiff_t ldc) {
    for (int j = 0; j < columns; j += WIDE) {
        Vec begin[ROWS][2], out[ROWS][2];
        for (int i = 0; i < ROWS; ++i)
            for (int v = 0; v < 2; ++v) {
                const int at = j + v * LANES;
                begin[i][v] = start == Start::zero   ? all(0.0f)
                              : start == Start::bias ? load(bias + at)
                                                     : load(c + i * ldc + at);
            }
        tile<ROWS>(depth, a, row, step, b + (j / WIDE) * panel, ldb, begin, out);
        for (int i = 0; i < ROWS; ++i)
            for (int v = 0; v < 2; ++v) {
                float* at = c + i * ldc + j + v * LANES;
                store(at, ADD ? add(load(at), out[i][v]) : out[i][v]);
            }
    }
}

template <bool ADD, int ROWS = TILE>
inline void product(Start start, int rows, int columns, int depth, const float* a, ptrdiff_t row,
                    ptrdiff_t step, const float* b, ptrdiff_t panel, ptrdiff_t ldb,
                    const float* bias, float* c, ptrdiff_t ldc) {
    while (rows >= ROWS) {
        product_rows<ROWS, ADD>(start, columns, depth, a, row, step, b, panel, ldb, bias, c, ldc);
        a += ROWS * row, c += ROWS * ldc, rows -= ROWS;
    }
    if constexpr (ROWS > 1)
        if (rows > 0)
            product<ADD, ROWS / 2>(start, rows, columns, depth, a, row, step, b, panel, ldb, bias, c, ldc);
}

int padded(int n) { return (n + PAD - 1) / PAD * PAD; }

// A weight as tiles want it: panels of WIDE columns, each (depth x WIDE) without gaps.
struct Packed {
    std::vector<float> data;
    int depth, columns;
    ptrdiff_t panel() const { return static_cast<ptrdiff_t>(depth) * WIDE; }
};

Packed packed(int depth, int columns) {
    return {std::vector<float>(static_cast<size_t>(depth) * columns, 0.0f), depth, columns};
}

void put(Packed& to, int k, int column, float value) {
    to.data[(column / WIDE) * to.panel() + static_cast<ptrdiff_t>(k) * WIDE + column % WIDE] = value;
}

// C = A B for a packed B; A is (rows x depth), row-major.
void times(Start start, int rows, const float* a, ptrdiff_t lda, const Packed& b, const float* bias,
           float* c, ptrdiff_t ldc) {
    product<false>(start, rows, b.columns, b.depth, a, lda, 1, b.data.data(), b.panel(), WIDE, bias, c, ldc);
}

// C (m x n) = A' B summed over rows, in blocks; A is (rows x m), B (rows x n), n padded.
void over_rows(int rows, const float* a, ptrdiff_t lda, int m, const float* b, ptrdiff_t ldb, int n,
               float* c, ptrdiff_t ldc) {
    for (int i = 0; i < m; ++i) std::memset(c + i * ldc, 0, sizeof(float) * n);
    for (int from = 0; from < rows; from += BLOCK) {
        const int count = rows - from < BLOCK ? rows - from : BLOCK;
        product<true>(Start::zero, m, n, count, a + from * lda, 1, lda, b + from * ldb, WIDE, ldb,
                      nullptr, c, ldc);
    }
}

void column_sums(int rows, const float* a, ptrdiff_t lda, int n, float* out) {
    for (int j = 0; j < n; j += LANES) {
        Vec total = all(0.0f);
        for (int from = 0; from < rows; from += BLOCK) {
            const int end = rows < from + BLOCK ? rows : from + BLOCK;
            Vec part = all(0.0f);
            for (int i = from; i < end; ++i) part = add(part, load(a + i * lda + j));
            total = add(total, part);
        }
        store(out + j, total);
    }
}

// Gates in three blocks of H padded columns each, in the order r, z, n of the parameters.
struct Net {
    int inputs, hidden, actions, h, a;  // h, a: hidden and actions, padded
    Packed fc1, w_ih, w_hh_rz, w_hh_n, fc2;
    std::vector<float> bias1, bias, bias_hn, bias2;

    Net(int inputs_, int hidden_, int actions_, const float* const* p)
        : inputs(inputs_), hidden(hidden_), actions(actions_), h(padded(hidden_)), a(padded(actions_)),
          fc1(packed(inputs_, h)), w_ih(packed(hidden_, 3 * h)), w_hh_rz(packed(hidden_, 2 * h)),
          w_hh_n(packed(hidden_, h)), fc2(packed(hidden_, a)), bias1(h, 0.0f), bias(3 * h, 0.0f),
          bias_hn(h, 0.0f), bias2(a, 0.0f) {
        const float *fc1_w = p[0], *fc1_b = p[1], *ih = p[2], *hh = p[3], *b_ih = p[4], *b_hh = p[5],
                    *fc2_w = p[6], *fc2_b = p[7];
        for (int j = 0; j < hidden; ++j) {
            bias1[j] = fc1_b[j], bias_hn[j] = b_hh[2 * hidden + j];
            for (int k = 0; k < inputs; ++k) put(fc1, k, j, fc1_w[j * inputs + k]);
            for (int gate = 0; gate < 3; ++gate) {
                const int from = gate * hidden + j, to = gate * h + j;
                bias[to] = gate < 2 ? b_ih[from] + b_hh[from] : b_ih[from];
                for (int k = 0; k < hidden; ++k) {
                    put(w_ih, k, to, ih[from * hidden + k]);
                    if (gate < 2) put(w_hh_rz, k, to, hh[from * hidden + k]);
                    else put(w_hh_n, k, j, hh[from * hidden + k]);
                }
            }
        }
        for (int j = 0; j < actions; ++j) {
            bias2[j] = fc2_b[j];
            for (int k = 0; k < hidden; ++k) put(fc2, k, j, fc2_w[j * hidden + k]);
        }
    }
};

// What a forward pass leaves for the backward one, all (rows x h); rz is (rows x 2h).
struct Tape {
    float *embedded, *rz, *n, *n_hidden, *hidden;
    Tape(float* at, ptrdiff_t rows, int h)
        : embedded(at), rz(at + rows * h), n(at + 3 * rows * h), n_hidden(at + 4 * rows * h),
          hidden(at + 5 * rows * h) {}
};

// Of a tile of rows: h' = n + z (h - n), see packed_gru.py.
void gates(int rows, int h, const float* sums, const float* before, float* rz, float* n,
           const float* n_hidden, float* hidden) {
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < h; j += LANES) {
            const float* s = sums + i * 3 * h + j;
            const Vec r = sigmoid(load(s)), z = sigmoid(load(s + h));
            const Vec c = tanh_of(fma(r, load(n_hidden + i * h + j), load(s + 2 * h)));
            store(rz + i * 2 * h + j, r);
            store(rz + i * 2 * h + h + j, z);
            store(n + i * h + j, c);
            store(hidden + i * h + j, fma(z, sub(load(before + i * h + j), c), c));
        }
}

void clear_padding(int rows, int h, int hidden, float* x) {
    if (hidden < h)
        for (int i = 0; i < rows; ++i) std::memset(x + i * h + hidden, 0, sizeof(float) * (h - hidden));
}

}  // namespace

extern "C" {

// Floats of a tape.
size_t unroll_tape(int rows, int hidden) { return static_cast<size_t>(rows) * 6 * padded(hidden); }

// q (rows x actions) of the packed rows; sizes[t] rows at time t. parameters: fc1.weight, fc1.bias,
// rnn.weight_ih, rnn.weight_hh, rnn.bias_ih, rnn.bias_hh, fc2.weight, fc2.bias.
void unroll_forward(int times_, const int* sizes, int rows, int inputs, int hidden, int actions,
                    const float* x, const float* const* parameters, float* q, float* tape_) {
    const Net net(inputs, hidden, actions, parameters);
    const int h = net.h;
    const Tape tape(tape_, rows, h);
    const std::vector<float> zero(static_cast<size_t>(TILE) * h, 0.0f);
    std::vector<float> sums(static_cast<size_t>(TILE) * 3 * h), out(static_cast<size_t>(TILE) * net.a);
    ptrdiff_t at = 0, earlier = 0;
    for (int t = 0; t < times_; earlier = at, at += sizes[t], ++t) {
        for (int i = 0; i < sizes[t]; i += TILE) {
            const int m = sizes[t] - i < TILE ? sizes[t] - i : TILE;
            const ptrdiff_t row = at + i;
            float* embedded = tape.embedded + row * h;
            times(Start::bias, m, x + row * inputs, inputs, net.fc1, net.bias1.data(), embedded, h);
            for (int j = 0; j < m * h; j += LANES) store(embedded + j, larger(all(0.0f), load(embedded + j)));
            const float* before = t ? tape.hidden + (earlier + i) * h : zero.data();
            float* n_hidden = tape.n_hidden + row * h;
            times(Start::bias, m, embedded, h, net.w_ih, net.bias.data(), sums.data(), 3 * h);
            times(Start::c, m, before, h, net.w_hh_rz, nullptr, sums.data(), 3 * h);
            times(Start::bias, m, before, h, net.w_hh_n, net.bias_hn.data(), n_hidden, h);
            float* after = tape.hidden + row * h;
            gates(m, h, sums.data(), before, tape.rz + row * 2 * h, tape.n + row * h, n_hidden, after);
            clear_padding(m, h, hidden, after);
            times(Start::bias, m, after, h, net.fc2, net.bias2.data(), out.data(), net.a);
            for (int k = 0; k < m; ++k)
                std::memcpy(q + (row + k) * actions, out.data() + k * net.a, sizeof(float) * actions);
        }
    }
}

// Gradients of the parameters, in their order and shapes, from grad_q (rows x actions) and the tape.
void unroll_backward(int times_, const int* sizes, int rows, int inputs, int hidden, int actions,
                     const float* x, const float* const* parameters, float* tape_,
                     const float* grad_q, float* const* gradients) {
    const int h = padded(hidden);
    const Tape tape(tape_, rows, h);
    const float *ih = parameters[2], *hh = parameters[3], *fc2_w = parameters[6];
    Packed back_q = packed(actions, h), back_input = packed(3 * h, h), back_hidden = packed(3 * h, h);
    for (int k = 0; k < hidden; ++k) {
        for (int j = 0; j < actions; ++j) put(back_q, j, k, fc2_w[j * hidden + k]);
        for (int gate = 0; gate < 3; ++gate)
            for (int j = 0; j < hidden; ++j) {
                // columns of the gates' gradients: n, r, z, and the candidate's recurrent part
                const int input_at = gate == 2 ? j : (gate + 1) * h + j;
                put(back_input, input_at, k, ih[(gate * hidden + j) * hidden + k]);
                put(back_hidden, gate * h + j, k, hh[(gate * hidden + j) * hidden + k]);
            }
    }
    const size_t count = rows;
    // Kept between calls: fresh pages cost more than the arithmetic on them.
    static thread_local std::vector<float> kept;
    const size_t needed = count * 7 * h + static_cast<size_t>(sizes[0]) * h;
    if (kept.size() < needed) kept.resize(needed);
    float *grad_hidden = kept.data(), *grad_gates = grad_hidden + count * h,
          *grad_embedded = grad_gates + count * 4 * h, *previous = grad_embedded + count * h,
          *unused = previous + count * h;
    std::memset(previous, 0, sizeof(float) * sizes[0] * h);
    times(Start::zero, rows, grad_q, actions, back_q, nullptr, grad_hidden, h);
    ptrdiff_t at = rows;
    for (int t = times_ - 1; t >= 0; --t) {
        at -= sizes[t];
        const ptrdiff_t earlier = t ? at - sizes[t - 1] : 0;
        float* into = t ? grad_hidden + earlier * h : unused;
        for (int i = 0; i < sizes[t]; ++i) {
            const ptrdiff_t row = at + i;
            const float *rz = tape.rz + row * 2 * h, *n = tape.n + row * h, *nh = tape.n_hidden + row * h;
            float *g = grad_gates + row * 4 * h, *b = previous + row * h;
            if (t) std::memcpy(b, tape.hidden + (earlier + i) * h, sizeof(float) * h);
            for (int j = 0; j < h; j += LANES) {
                const Vec grad = load(grad_hidden + row * h + j), one = all(1.0f);
                const Vec r = load(rz + j), z = load(rz + h + j), c = load(n + j), p = load(b + j);
                const Vec d_n = mul(mul(grad, sub(one, z)), sub(one, mul(c, c)));
                const Vec d_nh = mul(d_n, r), g_z = mul(grad, z);
                store(g + j, d_n);
                store(g + h + j, mul(mul(d_nh, load(nh + j)), sub(one, r)));
                store(g + 2 * h + j, mul(mul(g_z, sub(p, c)), sub(one, z)));
                store(g + 3 * h + j, d_nh);
                store(into + i * h + j, add(load(into + i * h + j), g_z));
            }
        }
        float* sums = grad_gates + at * 4 * h;
        times(Start::c, sizes[t], sums + h, 4 * h, back_hidden, nullptr, into, h);
        float* ge = grad_embedded + at * h;
        times(Start::zero, sizes[t], sums, 4 * h, back_input, nullptr, ge, h);
        for (ptrdiff_t j = 0; j < static_cast<ptrdiff_t>(sizes[t]) * h; j += LANES)
            store(ge + j, where_positive(load(tape.embedded + at * h + j), load(ge + j)));
    }
    // Sums over rows: vectors run over the padded side.
    std::vector<float> w_in(static_cast<size_t>(3 * h) * h), w_re(w_in), w1(static_cast<size_t>(inputs) * h),
        w2(static_cast<size_t>(actions) * h), b(4 * h), b1(h);
    over_rows(rows, grad_gates, 4 * h, 3 * h, tape.embedded, h, h, w_in.data(), h);
    over_rows(rows, grad_gates + h, 4 * h, 3 * h, previous, h, h, w_re.data(), h);
    over_rows(rows, x, inputs, inputs, grad_embedded, h, h, w1.data(), h);
    over_rows(rows, grad_q, actions, actions, tape.hidden, h, h, w2.data(), h);
    column_sums(rows, grad_gates, 4 * h, 4 * h, b.data());
    column_sums(rows, grad_embedded, h, h, b1.data());
    for (int j = 0; j < hidden; ++j) {
        gradients[1][j] = b1[j];
        for (int k = 0; k < inputs; ++k) gradients[0][j * inputs + k] = w1[k * h + j];
        for (int gate = 0; gate < 3; ++gate) {
            const int to = gate * hidden + j, input_at = gate == 2 ? j : (gate + 1) * h + j;
            gradients[4][to] = b[input_at];
            gradients[5][to] = b[(gate + 1) * h + j];
            std::memcpy(gradients[2] + to * hidden, w_in.data() + input_at * h, sizeof(float) * hidden);
            std::memcpy(gradients[3] + to * hidden, w_re.data() + (gate * h + j) * h, sizeof(float) * hidden);
        }
    }
    for (int j = 0; j < actions; ++j) {
        std::memcpy(gradients[6] + j * hidden, w2.data() + j * h, sizeof(float) * hidden);
        float total = 0.0f;
        for (int from = 0; from < rows; from += BLOCK) {
            float sum = 0.0f;
            for (int i = from; i < rows && i < from + BLOCK; ++i) sum += grad_q[i * actions + j];
            total += sum;
        }
        gradients[7][j] = total;
    }
}
}
