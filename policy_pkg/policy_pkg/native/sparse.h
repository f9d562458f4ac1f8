// Products with a matrix of many zeros, whose terms are left out: c + 0 b is c, so the bits are those of
// products.h. What a ReLU lets through is such a matrix (a fifth to a half of it), and what robots
// observe is another (a quarter to a half).

#pragma once

#include <type_traits>

#include "products.h"

namespace {

constexpr int WORD = 64;
constexpr int CHUNK = 128;    // rows that weights in the first cache serve before others come
constexpr float MANY = 0.8f;  // of the values not zero: from here on leaving out the others does not pay

// part(width, j) for each run of columns from j on of n padded ones, its width a constant.
template <typename Part>
void by_columns(int n, const Part& part) {
    int j = 0;
    for (; n - j >= 3 * PAD; j += 3 * PAD) part(std::integral_constant<int, 3 * PAD>(), j);
    if (n - j == 2 * PAD) part(std::integral_constant<int, 2 * PAD>(), j);
    if (n - j == PAD) part(std::integral_constant<int, PAD>(), j);
}

// sum += a[k * step] times the columns of B's row k, for the bits k of a word.
template <int COLUMNS>
inline void add_rows(uint64_t word, const float* a, ptrdiff_t step, const float* b, ptrdiff_t ldb,
                     Vec (&sum)[COLUMNS / LANES]) {
    for (; word; word &= word - 1) {
        const int k = __builtin_ctzll(word);
        const Vec x = all(a[k * step]);
        for (int v = 0; v < COLUMNS / LANES; ++v) sum[v] = fma(x, load(b + k * ldb + v * LANES), sum[v]);
    }
}

// Which values of at most CHUNK rows are not zero.
class Nonzero {
public:
    explicit Nonzero(int depth_)
        : depth(depth_), words((depth_ + WORD - 1) / WORD), bits(static_cast<size_t>(CHUNK) * words) {}

    // How many.
    int find(int rows, const float* a, ptrdiff_t lda) {
        int found = 0;
        for (int i = 0; i < rows; ++i)
            for (int w = 0; w < words; ++w) {
                const float* x = a + i * lda + w * WORD;
                const int end = depth - w * WORD < WORD ? depth - w * WORD : WORD;
                uint64_t word = 0;
                int j = 0;
                for (; j + LANES <= end; j += LANES) word |= static_cast<uint64_t>(nonzero(load(x + j))) << j;
                for (; j < end; ++j) word |= static_cast<uint64_t>(x[j] != 0.0f) << j;
                bits[i * words + w] = word;
                found += __builtin_popcountll(word);
            }
        return found;
    }

    // C = bias + A B, COLUMNS wide.
    template <int COLUMNS>
    void times(int rows, const float* a, ptrdiff_t lda, const float* b, ptrdiff_t ldb, const float* bias,
               float* c, ptrdiff_t ldc) const {
        for (int i = 0; i < rows; ++i) {
            Vec sum[COLUMNS / LANES];
            for (int v = 0; v < COLUMNS / LANES; ++v) sum[v] = load(bias + v * LANES);
            for (int w = 0; w < words; ++w)
                add_rows<COLUMNS>(bits[i * words + w], a + i * lda + w * WORD, 1, b + w * WORD * ldb, ldb, sum);
            for (int v = 0; v < COLUMNS / LANES; ++v) store(c + i * ldc + v * LANES, sum[v]);
        }
    }

private:
    int depth, words;
    std::vector<uint64_t> bits;
};

// C = bias + A B for a B in rows and at most CHUNK rows of A.
void times_sparse(int rows, const float* a, ptrdiff_t lda, const Packed& b, const float* bias, float* c,
                  ptrdiff_t ldc, Nonzero& in_a) {
    if (in_a.find(rows, a, lda) > MANY * rows * b.depth) {
        times(Start::bias, rows, a, lda, b, bias, c, ldc);
        return;
    }
    const float* from = b.data.data();
    by_columns(b.columns, [&](auto width, int j) {
        in_a.times<width>(rows, a, lda, from + j, b.ldb, bias + j, c + j, ldc);
    });
}

// Sums over rows, without those where a matrix is zero.
class SparseColumns {
public:
    // Finds where A (rows x columns, padded) is not zero.
    void find(int rows_, const float* a, ptrdiff_t lda, int columns_) {
        rows = rows_, columns = columns_;
        bits.assign(static_cast<size_t>(2 * ((rows + WORD - 1) / WORD)) * columns, 0);
        for (int from = 0; from < rows; from += WORD / 2)
            for (int j = 0; j < columns; j += LANES) {
                Bits found = no_bits();
                for (int i = from; i < rows && i < from + WORD / 2; ++i)
                    found = with_bit(found, 1u << (i - from), load(a + i * lda + j));
                store(bits.data() + static_cast<ptrdiff_t>(from / (WORD / 2)) * columns + j, found);
            }
    }

    // C (m x n) += A' B summed over rows, in blocks, for an A that is zero where the one found is;
    // A is (rows x m), B (rows x n), n padded.
    void add_over_rows(const float* a, ptrdiff_t lda, int m, const float* b, ptrdiff_t ldb, int n, float* c,
                       ptrdiff_t ldc) {
        by_columns(n, [&](auto width, int j) { add_wide<width>(a, lda, m, b + j, ldb, c + j, ldc); });
    }

private:
    template <int COLUMNS>
    void add_wide(const float* a, ptrdiff_t lda, int m, const float* b, ptrdiff_t ldb, float* c, ptrdiff_t ldc) {
        constexpr int VECTORS = COLUMNS / LANES;
        kept.resize(static_cast<size_t>(m) * COLUMNS);  // a block's sums so far
        for (int from = 0; from < rows; from += WORD) {
            const bool first = from % BLOCK == 0, last = from + WORD >= rows || (from + WORD) % BLOCK == 0;
            const uint32_t* word = bits.data() + static_cast<ptrdiff_t>(from / WORD) * 2 * columns;
            for (int k = 0; k < m; ++k) {
                float *so_far = kept.data() + static_cast<ptrdiff_t>(k) * COLUMNS, *to = c + k * ldc;
                Vec sum[VECTORS];
                for (int v = 0; v < VECTORS; ++v) sum[v] = first ? all(0.0f) : load(so_far + v * LANES);
                add_rows<COLUMNS>(word[k] | static_cast<uint64_t>(word[columns + k]) << 32, a + from * lda + k, lda,
                                  b + from * ldb, ldb, sum);
                for (int v = 0; v < VECTORS; ++v)
                    if (last) store(to + v * LANES, add(load(to + v * LANES), sum[v]));
                    else store(so_far + v * LANES, sum[v]);
            }
        }
    }

    int rows = 0, columns = 0;
    std::vector<uint32_t> bits;  // by 32 rows and column
    Floats kept;
};

}  // namespace
