// Sixteen float lanes on any processor: the vector layer of all kernels.
//
// A `Float` is sixteen floats held as 1, 2 or 4 native vectors (AVX-512, AVX2, anything else), written with the compiler's
// vector extensions. Intrinsics appear only where the compiler's own lowering is poor: masks, fused multiply-add, reciprocals.
// Contraction is off in the build, so `a * b + c` rounds twice and `fma(a, b, c)` once (twice where the processor has no FMA).
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__x86_64__) || defined(_M_X64)
#include <immintrin.h>
#define SPLATMILL_X86 1
#endif

#define SPLATMILL_INLINE inline __attribute__((always_inline))

namespace splatmill {

inline constexpr int kLanes = 16;
#if defined(__AVX512F__)
inline constexpr int kNative = 16;
#elif defined(__AVX2__)
inline constexpr int kNative = 8;
#else
inline constexpr int kNative = 4;
#endif
inline constexpr int kParts = kLanes / kNative;

typedef float NativeFloat __attribute__((vector_size(kNative * 4)));
typedef int32_t NativeInt __attribute__((vector_size(kNative * 4)));

struct Float {
  NativeFloat part[kParts];
};

struct Int {
  NativeInt part[kParts];
};

// One truth value per lane. AVX-512 has mask registers; elsewhere a lane is all ones or all zeros.
#if defined(__AVX512F__)
struct Mask {
  __mmask16 bits;
};
#else
struct Mask {
  NativeInt part[kParts];
};
#endif

namespace detail {
template <class Result, class Op, std::size_t... I>
SPLATMILL_INLINE Result each_part(Op op, std::index_sequence<I...>) {
  return Result{{op(std::integral_constant<std::size_t, I>{})...}};
}
template <class Result, class Op>
SPLATMILL_INLINE Result each(Op op) {
  return each_part<Result>(op, std::make_index_sequence<kParts>{});
}
}  // namespace detail

// ---- making, loading, storing (load and store need 64-byte alignment) ---------------------------------------------------

SPLATMILL_INLINE Float splat(float x) {
#if defined(__AVX512F__)
  return {{_mm512_set1_ps(x)}};
#elif defined(__AVX2__)
  return detail::each<Float>([&](auto) { return _mm256_set1_ps(x); });
#else
  return detail::each<Float>([&](auto) { return NativeFloat{x, x, x, x}; });
#endif
}
SPLATMILL_INLINE Int splat(int32_t x) {
  return detail::each<Int>([&](auto) { return NativeInt{} + x; });
}
SPLATMILL_INLINE Float load(const float* p) {
  return detail::each<Float>([&](auto i) { return *reinterpret_cast<const NativeFloat*>(p + i * kNative); });
}
SPLATMILL_INLINE void store(float* p, Float x) {
  for (int i = 0; i < kParts; ++i) *reinterpret_cast<NativeFloat*>(p + i * kNative) = x.part[i];
}
// Part by part: a memcpy of the whole goes through the stack in pieces that the processor cannot forward to the next load.
typedef float UnalignedFloat __attribute__((vector_size(kNative * 4), aligned(4), may_alias));
SPLATMILL_INLINE Float load_unaligned(const float* p) {
  return detail::each<Float>([&](auto i) { return NativeFloat(*reinterpret_cast<const UnalignedFloat*>(p + i * kNative)); });
}
SPLATMILL_INLINE void store_unaligned(float* p, Float x) {
  for (int i = 0; i < kParts; ++i) *reinterpret_cast<UnalignedFloat*>(p + i * kNative) = x.part[i];
}

// The first `count` lanes, zero in the others; reads and writes nothing beyond them (image edges, ends of arrays).
SPLATMILL_INLINE Float load_first(const float* p, int count) {
#if defined(__AVX512F__)
  const __mmask16 lanes = count >= kLanes ? 0xFFFF : static_cast<__mmask16>((1u << (count > 0 ? count : 0)) - 1u);
  return {{reinterpret_cast<NativeFloat>(_mm512_maskz_loadu_ps(lanes, p))}};
#else
  if (count >= kLanes) return load_unaligned(p);
  alignas(64) float buffer[kLanes] = {};
  for (int i = 0; i < count; ++i) buffer[i] = p[i];
  return load(buffer);
#endif
}
SPLATMILL_INLINE void store_first(float* p, Float x, int count) {
#if defined(__AVX512F__)
  const __mmask16 lanes = count >= kLanes ? 0xFFFF : static_cast<__mmask16>((1u << (count > 0 ? count : 0)) - 1u);
  _mm512_mask_storeu_ps(p, lanes, x.part[0]);
#else
  if (count >= kLanes) return store_unaligned(p, x);
  alignas(64) float buffer[kLanes];
  store(buffer, x);
  for (int i = 0; i < count; ++i) p[i] = buffer[i];
#endif
}

// ---- arithmetic -----------------------------------------------------------------------------------------------------------

#define SPLATMILL_LANEWISE(op)                                                         \
  SPLATMILL_INLINE Float operator op(Float a, Float b) {                               \
    return detail::each<Float>([&](auto i) { return a.part[i] op b.part[i]; });        \
  }                                                                                    \
  SPLATMILL_INLINE Float operator op(Float a, float b) { return a op splat(b); }       \
  SPLATMILL_INLINE Float operator op(float a, Float b) { return splat(a) op b; }       \
  SPLATMILL_INLINE Float& operator op##=(Float& a, Float b) { return a = a op b; }
SPLATMILL_LANEWISE(+)
SPLATMILL_LANEWISE(-)
SPLATMILL_LANEWISE(*)
SPLATMILL_LANEWISE(/)
#undef SPLATMILL_LANEWISE

#define SPLATMILL_LANEWISE_INT(op)                                              \
  SPLATMILL_INLINE Int operator op(Int a, Int b) {                              \
    return detail::each<Int>([&](auto i) { return a.part[i] op b.part[i]; });   \
  }                                                                             \
  SPLATMILL_INLINE Int operator op(Int a, int32_t b) { return a op splat(b); }
SPLATMILL_LANEWISE_INT(+)
SPLATMILL_LANEWISE_INT(-)
SPLATMILL_LANEWISE_INT(*)
SPLATMILL_LANEWISE_INT(&)
SPLATMILL_LANEWISE_INT(|)
SPLATMILL_LANEWISE_INT(^)
SPLATMILL_LANEWISE_INT(<<)
SPLATMILL_LANEWISE_INT(>>)
#undef SPLATMILL_LANEWISE_INT

SPLATMILL_INLINE Float operator-(Float a) {
  return detail::each<Float>([&](auto i) { return -a.part[i]; });
}

// a * b + c
SPLATMILL_INLINE Float fma(Float a, Float b, Float c) {
#if defined(__AVX512F__)
  return {{_mm512_fmadd_ps(a.part[0], b.part[0], c.part[0])}};
#elif defined(__FMA__)
  return detail::each<Float>([&](auto i) { return _mm256_fmadd_ps(a.part[i], b.part[i], c.part[i]); });
#else
  return a * b + c;
#endif
}
SPLATMILL_INLINE Float fma(float a, Float b, Float c) { return fma(splat(a), b, c); }
SPLATMILL_INLINE Float fma(Float a, float b, Float c) { return fma(a, splat(b), c); }
SPLATMILL_INLINE Float fma(Float a, Float b, float c) { return fma(a, b, splat(c)); }

// c - a * b
SPLATMILL_INLINE Float fnma(Float a, Float b, Float c) {
#if defined(__AVX512F__)
  return {{_mm512_fnmadd_ps(a.part[0], b.part[0], c.part[0])}};
#elif defined(__FMA__)
  return detail::each<Float>([&](auto i) { return _mm256_fnmadd_ps(a.part[i], b.part[i], c.part[i]); });
#else
  return c - a * b;
#endif
}

SPLATMILL_INLINE Int as_int(Float x) {
  return detail::each<Int>([&](auto i) { return reinterpret_cast<NativeInt>(x.part[i]); });
}
SPLATMILL_INLINE Float as_float(Int x) {
  return detail::each<Float>([&](auto i) { return reinterpret_cast<NativeFloat>(x.part[i]); });
}
SPLATMILL_INLINE Float abs(Float x) { return as_float(as_int(x) & 0x7FFFFFFF); }

// Truncates towards zero; the value must lie within int32.
SPLATMILL_INLINE Int to_int(Float x) {
  return detail::each<Int>([&](auto i) { return __builtin_convertvector(x.part[i], NativeInt); });
}
SPLATMILL_INLINE Float to_float(Int x) {
  return detail::each<Float>([&](auto i) { return __builtin_convertvector(x.part[i], NativeFloat); });
}

// min and max return b when either is NaN (the x86 rule, kept on every processor): put the trusted bound second.
SPLATMILL_INLINE Float min(Float a, Float b) {
#if defined(__AVX512F__)
  return {{_mm512_min_ps(a.part[0], b.part[0])}};
#elif defined(__AVX2__)
  return detail::each<Float>([&](auto i) { return _mm256_min_ps(a.part[i], b.part[i]); });
#elif defined(SPLATMILL_X86)
  return detail::each<Float>([&](auto i) { return _mm_min_ps(a.part[i], b.part[i]); });
#else
  return detail::each<Float>([&](auto i) { return a.part[i] < b.part[i] ? a.part[i] : b.part[i]; });
#endif
}
SPLATMILL_INLINE Float max(Float a, Float b) {
#if defined(__AVX512F__)
  return {{_mm512_max_ps(a.part[0], b.part[0])}};
#elif defined(__AVX2__)
  return detail::each<Float>([&](auto i) { return _mm256_max_ps(a.part[i], b.part[i]); });
#elif defined(SPLATMILL_X86)
  return detail::each<Float>([&](auto i) { return _mm_max_ps(a.part[i], b.part[i]); });
#else
  return detail::each<Float>([&](auto i) { return a.part[i] > b.part[i] ? a.part[i] : b.part[i]; });
#endif
}
SPLATMILL_INLINE Float min(Float a, float b) { return min(a, splat(b)); }
SPLATMILL_INLINE Float max(Float a, float b) { return max(a, splat(b)); }

SPLATMILL_INLINE Float sqrt(Float x) {
#if defined(__AVX512F__)
  return {{_mm512_sqrt_ps(x.part[0])}};
#elif defined(__AVX2__)
  return detail::each<Float>([&](auto i) { return _mm256_sqrt_ps(x.part[i]); });
#elif defined(SPLATMILL_X86)
  return detail::each<Float>([&](auto i) { return _mm_sqrt_ps(x.part[i]); });
#else
  Float y;
  for (int i = 0; i < kLanes; ++i) y.part[i / kNative][i % kNative] = __builtin_sqrtf(x.part[i / kNative][i % kNative]);
  return y;
#endif
}

// 1 / x within 2.8 ulp for normal x well inside the range: an estimate and one Newton step, 4 to 5 times a division's throughput.
// The bound is by the documented error of AVX2's estimate (worker/bench/_studies/functions/estimates.py); AVX-512's is smaller.
// Not for x = 0 or infinity (gives NaN): use `/` there.
SPLATMILL_INLINE Float reciprocal(Float x) {
#if defined(__AVX512F__)
  const Float r{{_mm512_rcp14_ps(x.part[0])}};
  return fma(fnma(x, r, splat(1.0f)), r, r);
#elif defined(__AVX2__)
  const Float r = detail::each<Float>([&](auto i) { return _mm256_rcp_ps(x.part[i]); });
  return fma(fnma(x, r, splat(1.0f)), r, r);
#else
  return 1.0f / x;
#endif
}

// 1 / sqrt(x) within 4.4 ulp for positive normal x, by the same rule: an estimate and one Newton step. Not for 0 or infinity.
SPLATMILL_INLINE Float reciprocal_sqrt(Float x) {
#if defined(__AVX512F__)
  const Float r{{_mm512_rsqrt14_ps(x.part[0])}};
  return fma(fnma(x * r, r, splat(1.0f)), r * 0.5f, r);
#elif defined(__AVX2__)
  const Float r = detail::each<Float>([&](auto i) { return _mm256_rsqrt_ps(x.part[i]); });
  return fma(fnma(x * r, r, splat(1.0f)), r * 0.5f, r);
#else
  return 1.0f / sqrt(x);
#endif
}

// ---- masks ----------------------------------------------------------------------------------------------------------------

// Every comparison with NaN is false.
#if defined(__AVX512F__)
SPLATMILL_INLINE Mask operator<(Float a, Float b) { return {_mm512_cmp_ps_mask(a.part[0], b.part[0], _CMP_LT_OQ)}; }
SPLATMILL_INLINE Mask operator<=(Float a, Float b) { return {_mm512_cmp_ps_mask(a.part[0], b.part[0], _CMP_LE_OQ)}; }
SPLATMILL_INLINE Mask operator==(Float a, Float b) { return {_mm512_cmp_ps_mask(a.part[0], b.part[0], _CMP_EQ_OQ)}; }
SPLATMILL_INLINE Mask operator==(Int a, Int b) {
  return {_mm512_cmpeq_epi32_mask(reinterpret_cast<__m512i>(a.part[0]), reinterpret_cast<__m512i>(b.part[0]))};
}
SPLATMILL_INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits & b.bits)}; }
SPLATMILL_INLINE Mask operator|(Mask a, Mask b) { return {static_cast<__mmask16>(a.bits | b.bits)}; }
SPLATMILL_INLINE Mask operator~(Mask a) { return {static_cast<__mmask16>(~a.bits)}; }
SPLATMILL_INLINE uint32_t bits(Mask m) { return m.bits; }
SPLATMILL_INLINE Mask mask_of(uint32_t bits) { return {static_cast<__mmask16>(bits)}; }
SPLATMILL_INLINE Float select(Mask m, Float a, Float b) {
  return {{_mm512_mask_blend_ps(m.bits, b.part[0], a.part[0])}};
}
SPLATMILL_INLINE Float keep(Mask m, Float a) { return {{_mm512_maskz_mov_ps(m.bits, a.part[0])}}; }
SPLATMILL_INLINE void store(float* p, Mask m, Float x) { _mm512_mask_store_ps(p, m.bits, x.part[0]); }
#else
namespace detail {
SPLATMILL_INLINE uint32_t native_bits(NativeInt m) {
#if defined(__AVX2__)
  return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(m)));
#elif defined(SPLATMILL_X86)
  return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(m)));
#else
  uint32_t b = 0;
  for (int i = 0; i < kNative; ++i) b |= static_cast<uint32_t>(m[i] & 1) << i;
  return b;
#endif
}
}  // namespace detail
SPLATMILL_INLINE Mask operator<(Float a, Float b) {
  return detail::each<Mask>([&](auto i) { return a.part[i] < b.part[i]; });
}
SPLATMILL_INLINE Mask operator<=(Float a, Float b) {
  return detail::each<Mask>([&](auto i) { return a.part[i] <= b.part[i]; });
}
SPLATMILL_INLINE Mask operator==(Float a, Float b) {
  return detail::each<Mask>([&](auto i) { return a.part[i] == b.part[i]; });
}
SPLATMILL_INLINE Mask operator==(Int a, Int b) {
  return detail::each<Mask>([&](auto i) { return a.part[i] == b.part[i]; });
}
SPLATMILL_INLINE Mask operator&(Mask a, Mask b) {
  return detail::each<Mask>([&](auto i) { return a.part[i] & b.part[i]; });
}
SPLATMILL_INLINE Mask operator|(Mask a, Mask b) {
  return detail::each<Mask>([&](auto i) { return a.part[i] | b.part[i]; });
}
SPLATMILL_INLINE Mask operator~(Mask a) {
  return detail::each<Mask>([&](auto i) { return ~a.part[i]; });
}
SPLATMILL_INLINE uint32_t bits(Mask m) {
  uint32_t b = 0;
  for (int i = 0; i < kParts; ++i) b |= detail::native_bits(m.part[i]) << (i * kNative);
  return b;
}
SPLATMILL_INLINE Mask mask_of(uint32_t bits) {
  return detail::each<Mask>([&](auto i) {
    NativeInt lane;
    for (int j = 0; j < kNative; ++j) lane[j] = 1 << (static_cast<int>(i) * kNative + j);
    return (lane & static_cast<int32_t>(bits)) == lane;
  });
}
SPLATMILL_INLINE Float keep(Mask m, Float a) {
  return detail::each<Float>(
      [&](auto i) { return reinterpret_cast<NativeFloat>(m.part[i] & reinterpret_cast<NativeInt>(a.part[i])); });
}
SPLATMILL_INLINE Float select(Mask m, Float a, Float b) {
#if defined(__AVX2__)
  return detail::each<Float>([&](auto i) {
    return _mm256_blendv_ps(b.part[i], a.part[i], reinterpret_cast<__m256>(m.part[i]));
  });
#else
  return detail::each<Float>([&](auto i) {
    const NativeInt x = reinterpret_cast<NativeInt>(a.part[i]), y = reinterpret_cast<NativeInt>(b.part[i]);
    return reinterpret_cast<NativeFloat>((m.part[i] & x) | (~m.part[i] & y));
  });
#endif
}
SPLATMILL_INLINE void store(float* p, Mask m, Float x) { store(p, select(m, x, load(p))); }
#endif
// m ? -|a| : a
SPLATMILL_INLINE Float mark(Mask m, Float a) {
#if defined(__AVX512F__)
  return {{_mm512_mask_or_ps(a.part[0], m.bits, a.part[0], _mm512_set1_ps(-0.0f))}};
#else
  return detail::each<Float>([&](auto i) {
    return reinterpret_cast<NativeFloat>(reinterpret_cast<NativeInt>(a.part[i]) | (m.part[i] & INT32_MIN));
  });
#endif
}
// m ? a * b : 0, one instruction where masks are registers.
SPLATMILL_INLINE Float keep_product(Mask m, Float a, Float b) {
#if defined(__AVX512F__)
  return {{_mm512_maskz_mul_ps(m.bits, a.part[0], b.part[0])}};
#else
  return keep(m, a * b);
#endif
}
SPLATMILL_INLINE Mask operator>(Float a, Float b) { return b < a; }
SPLATMILL_INLINE Mask operator>=(Float a, Float b) { return b <= a; }
SPLATMILL_INLINE Mask operator<(Float a, float b) { return a < splat(b); }
SPLATMILL_INLINE Mask operator<=(Float a, float b) { return a <= splat(b); }
SPLATMILL_INLINE Mask operator>(Float a, float b) { return a > splat(b); }
SPLATMILL_INLINE Mask operator>=(Float a, float b) { return a >= splat(b); }
SPLATMILL_INLINE Mask operator==(Float a, float b) { return a == splat(b); }
SPLATMILL_INLINE Mask& operator&=(Mask& a, Mask b) { return a = a & b; }
SPLATMILL_INLINE bool any(Mask m) { return bits(m) != 0; }
SPLATMILL_INLINE bool all(Mask m) { return bits(m) == 0xFFFF; }
SPLATMILL_INLINE Mask is_finite(Float x) { return abs(x) < __builtin_inff(); }

// ---- across lanes -----------------------------------------------------------------------------------------------------------

SPLATMILL_INLINE Float iota() {
  Float x;
  for (int i = 0; i < kLanes; ++i) x.part[i / kNative][i % kNative] = static_cast<float>(i);
  return x;
}

// The sum of the lanes, always in the same order (pairs at distance 8, 4, 2, 1) so that every instruction set agrees.
SPLATMILL_INLINE float sum(Float x) {
  alignas(64) float t[kLanes];
  store(t, x);
  for (int d = 8; d > 0; d /= 2)
    for (int i = 0; i < d; ++i) t[i] += t[i + d];
  return t[0];
}

SPLATMILL_INLINE Float floor(Float x) {
#if defined(__AVX512F__)
  return {{_mm512_roundscale_ps(x.part[0], _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}};
#elif defined(__AVX2__)
  return detail::each<Float>([&](auto i) { return _mm256_floor_ps(x.part[i]); });
#else
  // Beyond 2^23 every float is an integer already (and NaN passes through).
  const Float t = to_float(to_int(keep(abs(x) < 8388608.0f, x)));
  const Float down = t - keep(x < t, splat(1.0f));
  return select(abs(x) < 8388608.0f, down, x);
#endif
}

}  // namespace splatmill
