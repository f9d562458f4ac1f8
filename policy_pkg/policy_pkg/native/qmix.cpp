// The mixer of QMIX, forward, and backward by hand, for each row s (state) and q (robots' values):
//
//     Q_tot = ELU(q |W1(s)| + b1(s)) |W2(s)| + V(s)
//
// W1, W2 and V are nets of two layers with a ReLU between, b1 of one. The first layers read the same
// state and are one product, F = [for W1, for W2, for V, b1].

#include "products.h"

namespace {

constexpr int SUM_LANES = 16;  // of a sum within a row, in both builds

// A sum over a row, PAD values at a time: sixteen lanes, then these by halves.
struct RowSum {
    Vec lanes[SUM_LANES / LANES];
    RowSum() {
        for (Vec& lane : lanes) lane = all(0.0f);
    }
    void more(int j, Vec a, Vec b) {  // a b of the columns from j on, a multiple of LANES
        Vec& lane = lanes[j % SUM_LANES / LANES];
        lane = fma(a, b, lane);
    }
    float total() const {
        float x[SUM_LANES];
        for (int v = 0; v < SUM_LANES / LANES; ++v) store(x + v * LANES, lanes[v]);
        for (int half = SUM_LANES / 2; half; half /= 2)
            for (int i = 0; i < half; ++i) x[i] += x[i + half];
        return x[0];
    }
};

inline Vec sign(Vec x) {
    return sub(where_positive(x, all(1.0f)), where_positive(sub(all(0.0f), x), all(1.0f)));
}

// Sizes as they are and padded; where the parts of F begin, padded.
struct Sizes {
    int robots, states, mixing, hyper, m, h;
    int for_w2, for_v, b1, first, weights;  // weights: columns of W1, a robot's after the other's
    Sizes(int robots_, int states_, int mixing_, int hyper_)
        : robots(robots_), states(states_), mixing(mixing_), hyper(hyper_), m(padded(mixing_)),
          h(padded(hyper_)), for_w2(h), for_v(2 * h), b1(2 * h + m), first(2 * h + 2 * m), weights(robots * m) {}
    // Of a column of F as the parameters have it, without padding.
    int column(int j) const {
        if (j < hyper) return j;
        if (j < 2 * hyper) return for_w2 + j - hyper;
        return j < 2 * hyper + mixing ? for_v + j - 2 * hyper : b1 + j - 2 * hyper - mixing;
    }
    int columns() const { return 2 * hyper + 2 * mixing; }
};

// What a forward pass leaves for the backward one, by row: F after the ReLU, W1 and W2 before the
// absolute value, and ELU's values.
struct Tape {
    float *first, *w1, *w2, *inner;
};

Tape tape_of(float* at, ptrdiff_t rows, const Sizes& size) {
    float *w1 = at + rows * size.first, *w2 = w1 + rows * size.weights;
    return {at, w1, w2, w2 + rows * size.m};
}

size_t tape_floats(size_t rows, const Sizes& size) { return rows * (size.first + size.weights + 2 * size.m); }

// Of row i: the gradients of q, of W1 and W2, and of the two last parts of F.
void mixing_gradients(const Sizes& size, float grad, const float* q, const float* v_w, const Tape& tape, ptrdiff_t i,
                      float* grad_q, float* d_first, float* d_w1, float* d_w2) {
    const float *first = tape.first + i * size.first, *w1 = tape.w1 + i * size.weights;
    d_first += i * size.first, d_w1 += i * size.weights, d_w2 += i * size.m;
    const Vec g = all(grad);
    for (int j = 0; j < size.m; j += LANES) {
        const Vec inner = load(tape.inner + i * size.m + j), w2 = load(tape.w2 + i * size.m + j);
        store(d_w2 + j, mul(mul(g, inner), sign(w2)));
        // d ELU(x) / dx = 1 where x > 0, else e^x = ELU(x) + 1
        store(d_first + size.b1 + j, mul(mul(g, absolute(w2)), add(smaller(all(0.0f), inner), all(1.0f))));
        store(d_first + size.for_v + j, where_positive(load(first + size.for_v + j), mul(g, load(v_w + j))));
    }
    for (int robot = 0; robot < size.robots; ++robot) {
        RowSum sum;
        for (int j = 0; j < size.m; j += LANES) {
            const Vec w = load(w1 + robot * size.m + j), slope = load(d_first + size.b1 + j);
            sum.more(j, slope, absolute(w));
            store(d_w1 + robot * size.m + j, mul(mul(slope, sign(w)), all(q[robot])));
        }
        grad_q[robot] = sum.total();
    }
}

}  // namespace

extern "C" {

// Floats of a tape.
size_t qmix_tape(int rows, int robots, int states, int mixing, int hyper) {
    return tape_floats(rows, Sizes(robots, states, mixing, hyper));
}

// total (rows) of q (rows x robots) and state (rows x states). parameters: state.weight, state.bias,
// w1.weight, w1.bias, w2.weight, w2.bias, v.weight, v.bias. Without a tape there is no backward pass.
void qmix_forward(int rows, int robots, int states, int mixing, int hyper, const float* q,
                  const float* state, const float* const* parameters, float* total, float* tape_) {
    const Sizes size(robots, states, mixing, hyper);
    const float *state_w = parameters[0], *w1_w = parameters[2], *w2_w = parameters[4];
    Packed to_first = packed(states, size.first), to_w1 = packed(hyper, size.weights), to_w2 = packed(hyper, size.m);
    Floats first_b(size.first, 0.0f), w1_b(size.weights, 0.0f), w2_b(size.m, 0.0f), v_w(size.m, 0.0f);
    for (int j = 0; j < size.columns(); ++j) {
        put_column(to_first, 0, size.column(j), state_w + static_cast<ptrdiff_t>(j) * states, states);
        first_b[size.column(j)] = parameters[1][j];
    }
    for (int k = 0; k < mixing; ++k) {
        for (int robot = 0; robot < robots; ++robot) {
            const ptrdiff_t from = robot * mixing + k;
            put_column(to_w1, 0, robot * size.m + k, w1_w + from * hyper, hyper);
            w1_b[robot * size.m + k] = parameters[3][from];
        }
        put_column(to_w2, 0, k, w2_w + static_cast<ptrdiff_t>(k) * hyper, hyper);
        w2_b[k] = parameters[5][k], v_w[k] = parameters[6][k];
    }
    Floats scratch(tape_ ? 0 : tape_floats(TILE, size));
    const Tape tape = tape_of(tape_ ? tape_ : scratch.data(), tape_ ? rows : TILE, size);
    for (ptrdiff_t row = 0; row < rows; row += TILE) {
        const int count = rows - row < TILE ? rows - row : TILE;
        const ptrdiff_t kept = tape_ ? row : 0;
        float *first = tape.first + kept * size.first, *w1 = tape.w1 + kept * size.weights,
              *w2 = tape.w2 + kept * size.m, *inner = tape.inner + kept * size.m;
        times(Start::bias, count, state + row * states, states, to_first, first_b.data(), first, size.first);
        for (int i = 0; i < count; ++i)
            for (float *at = first + i * size.first, *end = at + size.b1; at < end; at += LANES)
                store(at, larger(all(0.0f), load(at)));
        times(Start::bias, count, first, size.first, to_w1, w1_b.data(), w1, size.weights);
        times(Start::bias, count, first + size.for_w2, size.first, to_w2, w2_b.data(), w2, size.m);
        for (int i = 0; i < count; ++i) {
            const float *f = first + i * size.first, *weight = w1 + i * size.weights, *value = q + (row + i) * robots;
            RowSum sum;
            for (int j = 0; j < size.m; j += LANES) {
                Vec x = load(f + size.b1 + j);
                for (int robot = 0; robot < robots; ++robot)
                    x = fma(all(value[robot]), absolute(load(weight + robot * size.m + j)), x);
                x = elu(x);
                store(inner + i * size.m + j, x);
                sum.more(j, x, absolute(load(w2 + i * size.m + j)));
                sum.more(j, load(f + size.for_v + j), load(v_w.data() + j));
            }
            total[row + i] = sum.total() + parameters[7][0];
        }
    }
}

// Gradients of q (rows x robots) and of the parameters, in their order and shapes, from that of the
// totals (rows) and the tape.
void qmix_backward(int rows, int robots, int states, int mixing, int hyper, const float* q,
                   const float* state, const float* const* parameters, float* tape_,
                   const float* grad, float* grad_q, float* const* gradients) {
    const Sizes size(robots, states, mixing, hyper);
    const Tape tape = tape_of(tape_, rows, size);
    const float *w1_w = parameters[2], *w2_w = parameters[4];
    Packed back_w1 = packed(size.weights, size.h), back_w2 = packed(size.m, size.h);
    Floats v_w(size.m, 0.0f);
    for (int k = 0; k < mixing; ++k) {
        for (int robot = 0; robot < robots; ++robot)
            put_row(back_w1, robot * size.m + k, w1_w + static_cast<ptrdiff_t>(robot * mixing + k) * hyper, hyper);
        put_row(back_w2, k, w2_w + static_cast<ptrdiff_t>(k) * hyper, hyper);
        v_w[k] = parameters[6][k];
    }
    Floats first(static_cast<size_t>(states) * size.first), w1(static_cast<size_t>(size.weights) * size.h),
        w2(static_cast<size_t>(size.m) * size.h), v(size.m), first_b(size.first), w1_b(size.weights), w2_b(size.m);
    // Some rows at a time, while they are in the cache.
    Floats kept(static_cast<size_t>(BLOCK) * (size.first + size.weights + size.m));
    float *d_first = kept.data(), *d_w1 = d_first + BLOCK * size.first, *d_w2 = d_w1 + BLOCK * size.weights;
    for (ptrdiff_t from = 0; from < rows; from += BLOCK) {
        const int count = rows - from < BLOCK ? rows - from : BLOCK;
        const Tape at{tape.first + from * size.first, tape.w1 + from * size.weights, tape.w2 + from * size.m,
                      tape.inner + from * size.m};
        for (ptrdiff_t i = 0; i < count; ++i)
            mixing_gradients(size, grad[from + i], q + (from + i) * robots, v_w.data(), at, i,
                             grad_q + (from + i) * robots, d_first, d_w1, d_w2);
        times(Start::zero, count, d_w1, size.weights, back_w1, nullptr, d_first, size.first);
        times(Start::zero, count, d_w2, size.m, back_w2, nullptr, d_first + size.for_w2, size.first);
        for (ptrdiff_t i = 0; i < count; ++i)
            for (int j = 0; j < size.for_v; j += LANES) {
                float* d = d_first + i * size.first + j;
                store(d, where_positive(load(at.first + i * size.first + j), load(d)));
            }
        add_over_rows(count, state + from * states, states, states, d_first, size.first, size.first, first.data(), size.first);
        add_over_rows(count, d_w1, size.weights, size.weights, at.first, size.first, size.h, w1.data(), size.h);
        add_over_rows(count, d_w2, size.m, size.m, at.first + size.for_w2, size.first, size.h, w2.data(), size.h);
        add_over_rows(count, grad + from, 1, 1, at.first + size.for_v, size.first, size.m, v.data(), size.m);
        add_column_sums(count, d_first, size.first, size.first, first_b.data());
        add_column_sums(count, d_w1, size.weights, size.weights, w1_b.data());
        add_column_sums(count, d_w2, size.m, size.m, w2_b.data());
    }
    for (int j = 0; j < size.columns(); ++j) {
        gradients[1][j] = first_b[size.column(j)];
        for (int k = 0; k < states; ++k)
            gradients[0][static_cast<ptrdiff_t>(j) * states + k] = first[static_cast<size_t>(k) * size.first + size.column(j)];
    }
    for (int k = 0; k < mixing; ++k) {
        for (int robot = 0; robot < robots; ++robot) {
            const ptrdiff_t to = robot * mixing + k, from = robot * size.m + k;
            gradients[3][to] = w1_b[from];
            std::memcpy(gradients[2] + to * hyper, w1.data() + from * size.h, sizeof(float) * hyper);
        }
        gradients[5][k] = w2_b[k], gradients[6][k] = v[k];
        std::memcpy(gradients[4] + static_cast<ptrdiff_t>(k) * hyper, w2.data() + static_cast<ptrdiff_t>(k) * size.h, sizeof(float) * hyper);
    }
    gradients[7][0] = column_sum(rows, grad, 1);
}
}
