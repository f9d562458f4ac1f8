// Vectors of floats, as wide as the build's: 16 with AVX-512, 8 with AVX2; what is computed is the same.

#pragma once

#include <immintrin.h>

#include <cstddef>
#include <cstdint>

namespace {

constexpr int PAD = 32;

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
inline uint32_t nonzero(Vec x) { return _mm512_cmp_ps_mask(x, _mm512_setzero_ps(), _CMP_NEQ_UQ); }
using Bits = __m512i;
inline Bits no_bits() { return _mm512_setzero_si512(); }
inline Bits with_bit(Bits bits, uint32_t bit, Vec x) {
    return _mm512_mask_or_epi32(bits, nonzero(x), bits, _mm512_set1_epi32(static_cast<int>(bit)));
}
inline void store(uint32_t* p, Bits bits) { _mm512_storeu_si512(p, bits); }
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
inline Vec differs_from_zero(Vec x) { return _mm256_cmp_ps(x, _mm256_setzero_ps(), _CMP_NEQ_UQ); }
inline uint32_t nonzero(Vec x) { return static_cast<uint32_t>(_mm256_movemask_ps(differs_from_zero(x))); }
using Bits = __m256i;
inline Bits no_bits() { return _mm256_setzero_si256(); }
inline Bits with_bit(Bits bits, uint32_t bit, Vec x) {
    const __m256i which = _mm256_castps_si256(differs_from_zero(x));
    return _mm256_or_si256(bits, _mm256_and_si256(which, _mm256_set1_epi32(static_cast<int>(bit))));
}
inline void store(uint32_t* p, Bits bits) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), bits); }
#endif

// The maximum of two vectors is its second operand where one is not a number: data comes second, so
// that a NaN is never lost.

// e^x - 1 = 2^n (e^r - 1) + (2^n - 1) for x <= 0, with |r| <= ln(2) / 2.
struct Power {
    Vec less_one, scale;  // e^r - 1 by its series to the seventh power, 2^n
};

inline Power power_negative(Vec x) {
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
    return {mul(p, r), two_to(n)};
}

inline Vec exp_negative(Vec x) {
    const Power e = power_negative(x);
    return mul(add(e.less_one, all(1.0f)), e.scale);
}

inline Vec elu(Vec x) {
    const Power e = power_negative(smaller(all(0.0f), x));
    return add(where_positive(x, x), fma(e.scale, e.less_one, sub(e.scale, all(1.0f))));
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

}  // namespace
