// One step of the agent net, Linear - ReLU - GRU - Linear, for robots that act: policy.py's operations in
// their order, with the bits that numpy has where it multiplies by OpenBLAS' kernels for Haswell. Those add
// up two chains of fused multiply-adds, of even and of odd terms; what is left of eight terms goes to the
// first. In the columns that are left of eight there is one chain. So it is up to BLAS_BLOCK terms and columns;
// more are cut into blocks. Both tanh are numpy's own, called between the parts.

#include <cstdint>

#include "products.h"

namespace {

constexpr int EIGHT = 8, BLAS_BLOCK = 320;

// C (ROWS x columns) = A B for a packed B.
template <int ROWS>
void two_chains(const float* a, ptrdiff_t lda, const Packed& b, float* c, ptrdiff_t ldc) {
    const int pairs = b.depth / EIGHT * EIGHT;
    const Vec zero[ROWS][2] = {};
    for (int j = 0; j < b.columns; j += WIDE) {
        const float* panel = b.data.data() + (j / WIDE) * b.panel;
        Vec even[ROWS][2], odd[ROWS][2], first[ROWS][2];
        tile<ROWS>(pairs / 2, a, lda, 2, panel, 2 * b.ldb, zero, even);
        tile<ROWS>(pairs / 2, a + 1, lda, 2, panel + b.ldb, 2 * b.ldb, zero, odd);
        tile<ROWS>(b.depth - pairs, a + pairs, lda, 1, panel + pairs * b.ldb, b.ldb, even, first);
        for (int i = 0; i < ROWS; ++i)
            for (int v = 0; v < 2; ++v) store(c + i * ldc + j + v * LANES, add(first[i][v], odd[i][v]));
    }
}

void times_in_two(int rows, const float* a, ptrdiff_t lda, const Packed& b, float* c, ptrdiff_t ldc) {
    constexpr int SOME = LANES / 4;  // sums of so many rows fit into the registers
    for (; rows >= SOME; rows -= SOME, a += SOME * lda, c += SOME * ldc) two_chains<SOME>(a, lda, b, c, ldc);
    for (; rows > 0; --rows, a += lda, c += ldc) two_chains<1>(a, lda, b, c, ldc);
}

// Columns are padded; gates in three blocks of h of them, in the order r, z, n. Of the values the first
// eights of columns are apart from the rest.
struct Net {
    int obs, actions, robots, hidden, h, a, eights;
    Packed fc1, w_ih, w_hh, fc2, fc2_rest;
    Floats action_rows, robot_rows, b_ih, b_hh, b_out;

    Net(int obs_, int actions_, int robots_, int hidden_, const float* const* p)
        : obs(obs_), actions(actions_), robots(robots_), hidden(hidden_), h(padded(hidden_)), a(padded(actions_) + PAD),
          eights(actions_ / EIGHT * EIGHT), fc1(packed(obs_, h)), w_ih(packed(hidden_, 3 * h)),
          w_hh(packed(hidden_, 3 * h)), fc2(packed(hidden_, padded(eights))), fc2_rest(packed(hidden_, PAD)),
          action_rows(static_cast<size_t>(actions_) * h, 0.0f), robot_rows(static_cast<size_t>(robots_) * h, 0.0f),
          b_ih(3 * h, 0.0f), b_hh(3 * h, 0.0f), b_out(a, 0.0f) {
        const float *fc1_w = p[0], *fc1_b = p[1], *ih = p[2], *hh = p[3], *fc2_w = p[6];
        for (int j = 0; j < hidden; ++j) {
            const float* row = fc1_w + static_cast<ptrdiff_t>(j) * (obs + actions + robots);
            put_column(fc1, 0, j, row, obs);
            for (int i = 0; i < actions; ++i) action_rows[i * h + j] = row[obs + i];
            for (int i = 0; i < robots; ++i) robot_rows[i * h + j] = row[obs + actions + i] + fc1_b[j];
            for (int gate = 0; gate < 3; ++gate) {
                const int from = gate * hidden + j, to = gate * h + j;
                put_column(w_ih, 0, to, ih + static_cast<ptrdiff_t>(from) * hidden, hidden);
                put_column(w_hh, 0, to, hh + static_cast<ptrdiff_t>(from) * hidden, hidden);
                b_ih[to] = p[4][from], b_hh[to] = p[5][from];
            }
        }
        for (int j = 0; j < actions; ++j) {
            const float* row = fc2_w + static_cast<ptrdiff_t>(j) * hidden;
            put_column(j < eights ? fc2 : fc2_rest, 0, j < eights ? j : j - eights, row, hidden);
            b_out[j] = p[7][j];
        }
    }
};

// Memory of the caller, of so many rows: obs and the actions before (-1: none yet), the robot, and padded
// the hidden state (h), the first layer (h), both sides' gates (3h), r and z (2h), the candidate (h), q (a).
struct Step {
    const float* obs;
    const int32_t *last, *robot;
    float *hidden, *embedded, *gates, *recurrent, *reset_update, *candidate, *q;
};

void add_bias(int rows, int columns, const float* bias, float* c) {
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; j += LANES)
            store(c + i * columns + j, add(load(c + i * columns + j), load(bias + j)));
}

}  // namespace

extern "C" {

// parameters: fc1.weight, fc1.bias, rnn.weight_ih, rnn.weight_hh, rnn.bias_ih, rnn.bias_hh, fc2.weight,
// fc2.bias, of which it takes a copy. Null: of these sizes numpy has to do it.
void* acting_new(int obs, int actions, int robots, int hidden, const float* const* parameters) {
    if (obs > BLAS_BLOCK || 3 * hidden > BLAS_BLOCK || hidden % EIGHT || actions > BLAS_BLOCK) return nullptr;
    return new Net(obs, actions, robots, hidden, parameters);
}

// Other weights of the same sizes.
void acting_set(void* net_, const float* const* parameters) {
    Net& net = *static_cast<Net*>(net_);
    net = Net(net.obs, net.actions, net.robots, net.hidden, parameters);
}

void acting_free(void* net) { delete static_cast<Net*>(net); }

// The padded widths of Step's hidden and q.
void acting_widths(const void* net, int* h, int* a) {
    *h = static_cast<const Net*>(net)->h, *a = static_cast<const Net*>(net)->a;
}

// Up to the tanh of r and z. Returns the first row whose last action or robot does not exist, or -1.
int acting_gates(const void* net_, int rows, const Step* step) {
    const Net& net = *static_cast<const Net*>(net_);
    const int h = net.h;
    for (int i = 0; i < rows; ++i)
        if (step->last[i] < -1 || step->last[i] >= net.actions || step->robot[i] < 0 || step->robot[i] >= net.robots)
            return i;
    times_in_two(rows, step->obs, net.obs, net.fc1, step->embedded, h);
    for (int i = 0; i < rows; ++i) {
        float* x = step->embedded + i * h;
        const float* robot = net.robot_rows.data() + static_cast<ptrdiff_t>(step->robot[i]) * h;
        const float* last = step->last[i] < 0 ? nullptr : net.action_rows.data() + static_cast<ptrdiff_t>(step->last[i]) * h;
        for (int j = 0; j < h; j += LANES) {
            const Vec seen = add(load(x + j), last ? load(last + j) : all(0.0f));
            store(x + j, larger(all(0.0f), add(seen, load(robot + j))));
        }
    }
    times_in_two(rows, step->embedded, h, net.w_ih, step->gates, 3 * h);
    add_bias(rows, 3 * h, net.b_ih.data(), step->gates);
    times_in_two(rows, step->hidden, h, net.w_hh, step->recurrent, 3 * h);
    add_bias(rows, 3 * h, net.b_hh.data(), step->recurrent);
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < 2 * h; j += LANES) {
            const Vec sum = add(load(step->gates + i * 3 * h + j), load(step->recurrent + i * 3 * h + j));
            store(step->reset_update + i * 2 * h + j, mul(sum, all(0.5f)));
        }
    return -1;
}

// From there to the candidate's tanh: r, z = (1 + tanh) / 2.
void acting_candidate(const void* net_, int rows, const Step* step) {
    const int h = static_cast<const Net*>(net_)->h;
    for (int i = 0; i < rows; ++i) {
        float* rz = step->reset_update + i * 2 * h;
        for (int j = 0; j < 2 * h; j += LANES) store(rz + j, mul(add(load(rz + j), all(1.0f)), all(0.5f)));
        for (int j = 0; j < h; j += LANES) {
            const Vec recurrent = mul(load(step->recurrent + i * 3 * h + 2 * h + j), load(rz + j));
            store(step->candidate + i * h + j, add(load(step->gates + i * 3 * h + 2 * h + j), recurrent));
        }
    }
}

// The next hidden state, n + z (h - n), and the values.
void acting_values(const void* net_, int rows, const Step* step) {
    const Net& net = *static_cast<const Net*>(net_);
    const int h = net.h;
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < h; j += LANES) {
            float* at = step->hidden + i * h + j;
            const Vec n = load(step->candidate + i * h + j), z = load(step->reset_update + i * 2 * h + h + j);
            store(at, add(mul(sub(load(at), n), z), n));
        }
    times_in_two(rows, step->hidden, h, net.fc2, step->q, net.a);
    times(Start::zero, rows, step->hidden, h, net.fc2_rest, nullptr, step->q + net.eights, net.a);
    add_bias(rows, net.a, net.b_out.data(), step->q);
}
}
