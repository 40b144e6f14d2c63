// Transposes and sums across lanes, for any native width, from two-vector shuffles alone.
#pragma once

#include "simd/simd.hpp"

namespace splatmill {
namespace detail {

template <std::size_t... I>
SPLATMILL_INLINE NativeFloat interleave_low(NativeFloat a, NativeFloat b, std::index_sequence<I...>) {
  return __builtin_shufflevector(a, b, static_cast<int>(I % 2 ? kNative + I / 2 : I / 2)...);
}
template <std::size_t... I>
SPLATMILL_INLINE NativeFloat interleave_high(NativeFloat a, NativeFloat b, std::index_sequence<I...>) {
  return __builtin_shufflevector(a, b, static_cast<int>(kNative / 2 + (I % 2 ? kNative + I / 2 : I / 2))...);
}
// Lanes without bit D from a, the others from b.
template <int D, std::size_t... I>
SPLATMILL_INLINE NativeFloat choose(NativeFloat a, NativeFloat b, std::index_sequence<I...>) {
  return __builtin_shufflevector(a, b, static_cast<int>(I & D ? kNative + I : I)...);
}
// Lane i without bit D: a[i + D]; with it: b[i - D].
template <int D, std::size_t... I>
SPLATMILL_INLINE NativeFloat cross(NativeFloat a, NativeFloat b, std::index_sequence<I...>) {
  return __builtin_shufflevector(a, b, static_cast<int>(I & D ? kNative + I - D : I + D)...);
}
using NativeLanes = std::make_index_sequence<kNative>;

// One level of the tree: x[2i] and x[2i+1] share a vector afterwards, told apart by bit D of the lane.
template <int D, int N>
SPLATMILL_INLINE void merge_sums(NativeFloat* x) {
  if constexpr (D < kNative) {
#pragma GCC unroll 16
    for (int i = 0; i < (N + 1) / 2; ++i) {
      const NativeFloat a = x[2 * i];
      if (2 * i + 1 < N) {
        const NativeFloat b = x[2 * i + 1];
        x[i] = choose<D>(a, b, NativeLanes{}) + cross<D>(a, b, NativeLanes{});
      } else {
        x[i] = a + cross<D>(a, a, NativeLanes{});
      }
    }
    merge_sums<2 * D, (N + 1) / 2>(x);
  }
}

}  // namespace detail

// out[k] = the sum of x[k]'s lanes, for k < N <= 16; out has room for 16 and what lies beyond N means nothing.
template <int N>
SPLATMILL_INLINE void store_lane_sums(float* out, const Float* x) {
  NativeFloat folded[N];
#pragma GCC unroll 16
  for (int k = 0; k < N; ++k) {
    if constexpr (kParts == 1) folded[k] = x[k].part[0];
    if constexpr (kParts == 2) folded[k] = x[k].part[0] + x[k].part[kParts - 1];
    if constexpr (kParts == 4) folded[k] = (x[k].part[0] + x[k].part[kParts / 2]) + (x[k].part[1 % kParts] + x[k].part[3 % kParts]);
  }
  detail::merge_sums<1, N>(folded);
#pragma GCC unroll 4
  for (int k = 0; k < (N + kNative - 1) / kNative; ++k) *reinterpret_cast<NativeFloat*>(out + k * kNative) = folded[k];
}

// x[i][j] becomes x[j][i].
SPLATMILL_INLINE void transpose(Float* x) {
  // Native squares: log2(width) rounds of the perfect shuffle; the squares themselves change places by indexing.
  constexpr int W = kNative;
  NativeFloat t[kParts][kParts][W];  // [row of squares][column of squares][row within]
#pragma GCC unroll 16
  for (int r = 0; r < kLanes; ++r)
#pragma GCC unroll 4
    for (int c = 0; c < kParts; ++c) t[r / W][c][r % W] = x[r].part[c];
#pragma GCC unroll 4
  for (int i = 0; i < kParts; ++i)
#pragma GCC unroll 4
    for (int j = 0; j < kParts; ++j) {
      NativeFloat(&s)[W] = t[i][j];
#pragma GCC unroll 4
      for (int round = 1; round < W; round *= 2) {
        NativeFloat n[W];
#pragma GCC unroll 8
        for (int k = 0; k < W / 2; ++k) {
          n[2 * k] = detail::interleave_low(s[k], s[k + W / 2], detail::NativeLanes{});
          n[2 * k + 1] = detail::interleave_high(s[k], s[k + W / 2], detail::NativeLanes{});
        }
#pragma GCC unroll 16
        for (int k = 0; k < W; ++k) s[k] = n[k];
      }
    }
#pragma GCC unroll 16
  for (int r = 0; r < kLanes; ++r)
#pragma GCC unroll 4
    for (int c = 0; c < kParts; ++c) x[r].part[c] = t[c][r / W][r % W];
}

}  // namespace splatmill
