// Products of matrices whose bits depend neither on the vector's width nor on the number of rows.
//
// Every value is one chain of fused multiply-adds in ascending order of what is summed, whatever the
// vector's width: vectors run over outputs, never over what is summed. So a build for AVX2 and one for
// AVX-512 give the same bits, and a row has the same bits in every batch. Only sums over rows, the
// gradients of weights, are cut into blocks of BLOCK rows, for accuracy; the blocks are the same in
// both builds. Build with -ffp-contract=off: the compiler must not fuse what is not fused here.
//
// Layout: row-major; the columns of a padded array are a multiple of PAD, and the padding is zero.

#pragma once

#include <cstddef>
#include <cstring>
#include <new>
#include <vector>

#include "vectors.h"

namespace {

// Memory that begins at a line of the cache: a vector of 64 bytes elsewhere lies in two.
template <class T>
struct Lines {
    using value_type = T;
    static constexpr std::align_val_t LINE{64};
    T* allocate(size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), LINE)); }
    void deallocate(T* p, size_t) { ::operator delete(p, LINE); }
    template <class U>
    bool operator==(const Lines<U>&) const { return true; }
    template <class U>
    bool operator!=(const Lines<U>&) const { return false; }
};
using Floats = std::vector<float, Lines<float>>;

constexpr int BLOCK = 256;
constexpr int WIDE = 2 * LANES;  // columns of a tile

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

// A weight (depth x columns): in panels of WIDE columns, each without gaps, as tiles want it, or row
// after row, as single rows do.
struct Packed {
    Floats data;
    int depth, columns;
    ptrdiff_t panel, ldb;
};

Packed packed(int depth, int columns) {
    return {Floats(static_cast<size_t>(depth) * columns, 0.0f), depth, columns,
            static_cast<ptrdiff_t>(depth) * WIDE, WIDE};
}

Packed in_rows(int depth, int columns) {
    return {Floats(static_cast<size_t>(depth) * columns, 0.0f), depth, columns, WIDE, columns};
}

// Rows k, k + 1, ... of a column.
void put_column(Packed& to, int k, int column, const float* values, int count) {
    float* at = to.data.data() + (column / WIDE) * to.panel + k * to.ldb + column % WIDE;
    for (int i = 0; i < count; ++i) at[i * to.ldb] = values[i];
}

// The first columns of row k.
void put_row(Packed& to, int k, const float* values, int count) {
    for (int j = 0; j < count; j += WIDE)
        std::memcpy(to.data.data() + (j / WIDE) * to.panel + k * to.ldb, values + j,
                    sizeof(float) * (count - j < WIDE ? count - j : WIDE));
}

// C = A B for a packed B; A is (rows x depth), row-major.
void times(Start start, int rows, const float* a, ptrdiff_t lda, const Packed& b, const float* bias,
           float* c, ptrdiff_t ldc) {
    product<false>(start, rows, b.columns, b.depth, a, lda, 1, b.data.data(), b.panel, b.ldb, bias, c, ldc);
}

// C (m x n) += A' B summed over rows, in blocks; A is (rows x m), B (rows x n), n padded.
void add_over_rows(int rows, const float* a, ptrdiff_t lda, int m, const float* b, ptrdiff_t ldb, int n,
               float* c, ptrdiff_t ldc) {
    for (int from = 0; from < rows; from += BLOCK) {
        const int count = rows - from < BLOCK ? rows - from : BLOCK;
        product<true>(Start::zero, m, n, count, a + from * lda, 1, lda, b + from * ldb, WIDE, ldb,
                      nullptr, c, ldc);
    }
}

// out (n) += A's sums over rows, in blocks.
void add_column_sums(int rows, const float* a, ptrdiff_t lda, int n, float* out) {
    for (int j = 0; j < n; j += LANES) {
        Vec total = load(out + j);
        for (int from = 0; from < rows; from += BLOCK) {
            const int end = rows < from + BLOCK ? rows : from + BLOCK;
            Vec part = all(0.0f);
            for (int i = from; i < end; ++i) part = add(part, load(a + i * lda + j));
            total = add(total, part);
        }
        store(out + j, total);
    }
}

// Of one column of A, whose rows are lda apart.
float column_sum(int rows, const float* a, ptrdiff_t lda) {
    float total = 0.0f;
    for (int from = 0; from < rows; from += BLOCK) {
        float part = 0.0f;
        for (int i = from; i < rows && i < from + BLOCK; ++i) part += a[i * lda];
        total += part;
    }
    return total;
}

}  // namespace
