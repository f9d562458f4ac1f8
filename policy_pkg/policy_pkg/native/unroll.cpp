// The agent net, Linear - ReLU - GRU - Linear, over a packed batch: forward, and backward by hand.

#include "sparse.h"

namespace {

// Gates in three blocks of H padded columns each, in the order r, z, n of the parameters.
struct Net {
    int inputs, hidden, actions, h, a;  // h, a: hidden and actions, padded
    Packed fc1, w_ih, w_hh_rz, w_hh_n, fc2;
    Floats bias1, bias, bias_hn, bias2;

    Net(int inputs_, int hidden_, int actions_, const float* const* p)
        : inputs(inputs_), hidden(hidden_), actions(actions_), h(padded(hidden_)), a(padded(actions_)),
          fc1(in_rows(inputs_, h)), w_ih(in_rows(hidden_, 3 * h)), w_hh_rz(packed(hidden_, 2 * h)),
          w_hh_n(packed(hidden_, h)), fc2(packed(hidden_, a)), bias1(h, 0.0f), bias(3 * h, 0.0f),
          bias_hn(h, 0.0f), bias2(a, 0.0f) {
        const float *fc1_w = p[0], *fc1_b = p[1], *ih = p[2], *hh = p[3], *b_ih = p[4], *b_hh = p[5],
                    *fc2_w = p[6], *fc2_b = p[7];
        for (int j = 0; j < hidden; ++j) {
            bias1[j] = fc1_b[j], bias_hn[j] = b_hh[2 * hidden + j];
            put_column(fc1, 0, j, fc1_w + static_cast<ptrdiff_t>(j) * inputs, inputs);
            for (int gate = 0; gate < 3; ++gate) {
                const int from = gate * hidden + j, to = gate * h + j;
                bias[to] = gate < 2 ? b_ih[from] + b_hh[from] : b_ih[from];
                put_column(w_ih, 0, to, ih + static_cast<ptrdiff_t>(from) * hidden, hidden);
                put_column(gate < 2 ? w_hh_rz : w_hh_n, 0, gate < 2 ? to : j,
                           hh + static_cast<ptrdiff_t>(from) * hidden, hidden);
            }
        }
        for (int j = 0; j < actions; ++j) {
            bias2[j] = fc2_b[j];
            put_column(fc2, 0, j, fc2_w + static_cast<ptrdiff_t>(j) * hidden, hidden);
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

// Of a chunk of rows, with the sums of r, z and the candidate's input:
//     r, z = sigmoid(sums), n = tanh(sum + r (W_hn h + b_hn)), h' = n + z (h - n)
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

bool all_zero(const float* x, int count) {
    for (int j = 0; j < count; ++j)
        if (x[j] != 0.0f) return false;
    return true;
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
// rnn.weight_ih, rnn.weight_hh, rnn.bias_ih, rnn.bias_hh, fc2.weight, fc2.bias. Without a tape there
// is no backward pass, and what it would need is written over with every chunk.
void unroll_forward(int times_, const int* sizes, int rows, int inputs, int hidden, int actions,
                    const float* x, const float* const* parameters, float* q, float* tape_) {
    const Net net(inputs, hidden, actions, parameters);
    const int h = net.h, most = sizes[0];
    Floats scratch, states[2];
    if (!tape_) {
        scratch.resize(static_cast<size_t>(CHUNK) * 6 * h);
        for (auto& state : states) state.resize(static_cast<size_t>(most) * h);
    }
    const Tape tape(tape_ ? tape_ : scratch.data(), tape_ ? rows : CHUNK, h);
    const Floats zero(static_cast<size_t>(CHUNK) * h, 0.0f);
    Floats sums(static_cast<size_t>(CHUNK) * 3 * h), out(static_cast<size_t>(CHUNK) * net.a);
    Nonzero in_x(inputs), in_embedded(hidden);
    ptrdiff_t at = 0, earlier = 0;
    for (int t = 0; t < times_; earlier = at, at += sizes[t], ++t) {
        const float* all_before = tape_ ? tape.hidden + earlier * h : states[(t + 1) % 2].data();
        float* all_after = tape_ ? tape.hidden + at * h : states[t % 2].data();
        for (int i = 0; i < sizes[t]; i += CHUNK) {
            const int m = sizes[t] - i < CHUNK ? sizes[t] - i : CHUNK;
            const ptrdiff_t row = at + i, kept = tape_ ? row : 0;
            const float* before = t ? all_before + static_cast<ptrdiff_t>(i) * h : zero.data();
            float *embedded = tape.embedded + kept * h, *n_hidden = tape.n_hidden + kept * h,
                  *after = all_after + static_cast<ptrdiff_t>(i) * h;
            times_sparse(m, x + row * inputs, inputs, net.fc1, net.bias1.data(), embedded, h, in_x);
            for (int j = 0; j < m * h; j += LANES) store(embedded + j, larger(all(0.0f), load(embedded + j)));
            times_sparse(m, embedded, h, net.w_ih, net.bias.data(), sums.data(), 3 * h, in_embedded);
            if (t) times(Start::c, m, before, h, net.w_hh_rz, nullptr, sums.data(), 3 * h);
            times(Start::bias, m, before, h, net.w_hh_n, net.bias_hn.data(), n_hidden, h);
            gates(m, h, sums.data(), before, tape.rz + kept * 2 * h, tape.n + kept * h, n_hidden, after);
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
    for (int j = 0; j < actions; ++j) put_row(back_q, j, fc2_w + static_cast<ptrdiff_t>(j) * hidden, hidden);
    for (int gate = 0; gate < 3; ++gate)
        for (int j = 0; j < hidden; ++j) {
            // rows are the columns of the gates' gradients: n, r, z, and the candidate's recurrent part
            const ptrdiff_t from = static_cast<ptrdiff_t>(gate * hidden + j) * hidden;
            put_row(back_input, gate == 2 ? j : (gate + 1) * h + j, ih + from, hidden);
            put_row(back_hidden, gate * h + j, hh + from, hidden);
        }
    // One time's rows at a time, while they are in the cache. Kept between calls: fresh pages cost more
    // than the arithmetic on them.
    static thread_local Floats kept;
    // Rows whose distance is a power of two would share a few lines of the cache: one vector more.
    const size_t most = sizes[0], gates = 4 * h + LANES, wide = padded(inputs) + LANES,
                 needed = most * (gates + 3 * h + wide);  // gates 4, embedded 1, hidden 2, inputs
    if (kept.size() < needed) kept.resize(needed);
    float *grad_gates = kept.data(), *grad_embedded = grad_gates + most * gates,
          *grad_hidden[] = {grad_embedded + most * h, grad_embedded + most * 2 * h},
          *x_padded = grad_embedded + most * 3 * h;
    for (size_t i = 0; i < most; ++i) std::memset(x_padded + i * wide, 0, sizeof(float) * wide);
    SparseColumns embedded_in;
    // Sums over rows: vectors run over the padded side.
    Floats w_in(static_cast<size_t>(h) * 3 * h), w_re(w_in), w1(static_cast<size_t>(h) * wide),
        w2(static_cast<size_t>(actions) * h), b(4 * h), b1(h);
    const Floats zero(most * h, 0.0f);
    ptrdiff_t at = rows - sizes[times_ - 1];
    times(Start::zero, sizes[times_ - 1], grad_q + at * actions, actions, back_q, nullptr,
          grad_hidden[(times_ - 1) % 2], h);
    for (int t = times_ - 1; t >= 0; --t) {
        // A sequence that ends here, and whose last values the loss does not use, has no gradient yet.
        int count = sizes[t];
        for (const int going_on = t + 1 < times_ ? sizes[t + 1] : 0;
             count > going_on && all_zero(grad_q + (at + count - 1) * actions, actions);)
            --count;
        const ptrdiff_t earlier = t ? at - sizes[t - 1] : 0;
        const float* before = t ? tape.hidden + earlier * h : zero.data();
        float *from = grad_hidden[t % 2], *into = grad_hidden[(t + 1) % 2];
        if (t) times(Start::zero, sizes[t - 1], grad_q + earlier * actions, actions, back_q, nullptr, into, h);
        for (ptrdiff_t i = 0; i < count; ++i) {
            const float *rz = tape.rz + (at + i) * 2 * h, *n = tape.n + (at + i) * h,
                        *nh = tape.n_hidden + (at + i) * h;
            float* g = grad_gates + i * gates;
            for (int j = 0; j < h; j += LANES) {
                const Vec grad = load(from + i * h + j), one = all(1.0f);
                const Vec r = load(rz + j), z = load(rz + h + j), c = load(n + j), p = load(before + i * h + j);
                const Vec d_n = mul(mul(grad, sub(one, z)), sub(one, mul(c, c)));
                const Vec d_nh = mul(d_n, r), g_z = mul(grad, z);
                store(g + j, d_n);
                store(g + h + j, mul(mul(d_nh, load(nh + j)), sub(one, r)));
                store(g + 2 * h + j, mul(mul(g_z, sub(p, c)), sub(one, z)));
                store(g + 3 * h + j, d_nh);
                if (t) store(into + i * h + j, add(load(into + i * h + j), g_z));
            }
        }
        if (t) {
            times(Start::c, count, grad_gates + h, gates, back_hidden, nullptr, into, h);
            add_over_rows(count, grad_gates + h, gates, 3 * h, before, h, h, w_re.data(), h);
        }
        times(Start::zero, count, grad_gates, gates, back_input, nullptr, grad_embedded, h);
        const float* embedded = tape.embedded + at * h;
        for (ptrdiff_t j = 0; j < static_cast<ptrdiff_t>(count) * h; j += LANES)
            store(grad_embedded + j, where_positive(load(embedded + j), load(grad_embedded + j)));
        for (ptrdiff_t i = 0; i < count; ++i)
            std::memcpy(x_padded + i * wide, x + (at + i) * inputs, sizeof(float) * inputs);
        embedded_in.find(count, embedded, h, h);
        embedded_in.add_over_rows(embedded, h, hidden, grad_gates, gates, 3 * h, w_in.data(), 3 * h);
        embedded_in.add_over_rows(grad_embedded, h, hidden, x_padded, wide, padded(inputs), w1.data(), wide);
        add_over_rows(count, grad_q + at * actions, actions, actions, tape.hidden + at * h, h, h, w2.data(), h);
        add_column_sums(count, grad_gates, gates, 4 * h, b.data());
        add_column_sums(count, grad_embedded, h, h, b1.data());
        at = earlier;
    }
    for (int j = 0; j < hidden; ++j) {
        gradients[1][j] = b1[j];
        std::memcpy(gradients[0] + static_cast<ptrdiff_t>(j) * inputs, w1.data() + j * wide, sizeof(float) * inputs);
        for (int gate = 0; gate < 3; ++gate) {
            const int to = gate * hidden + j, input_at = gate == 2 ? j : (gate + 1) * h + j;
            gradients[4][to] = b[input_at];
            gradients[5][to] = b[(gate + 1) * h + j];
            for (int k = 0; k < hidden; ++k) gradients[2][to * hidden + k] = w_in[k * 3 * h + input_at];
            std::memcpy(gradients[3] + to * hidden, w_re.data() + (gate * h + j) * h, sizeof(float) * hidden);
        }
    }
    for (int j = 0; j < actions; ++j) {
        std::memcpy(gradients[6] + j * hidden, w2.data() + j * h, sizeof(float) * hidden);
        gradients[7][j] = column_sum(rows, grad_q + j, actions);
    }
}
}
