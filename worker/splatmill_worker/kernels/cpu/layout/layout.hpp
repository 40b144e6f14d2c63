// Layout of a scene: blocks of sixteen Gaussians, one lane each, so that every kernel over Gaussians reads whole vectors.
#pragma once

#include <cstdint>

#include "layout/record.hpp"

namespace splatmill {

// Rows of a block [kRows][kLanes]; the columns of the plain [N, 59] form have the same order.
inline constexpr int kMean = 0;
inline constexpr int kLogScale = 3;
inline constexpr int kQuat = 6;
inline constexpr int kLogit = 10;
inline constexpr int kSh = 11;  // coefficient k, channel c at kSh + 3 k + c
inline constexpr int kRows = 59;
inline constexpr int kBlockFloats = kRows * kLanes;

inline int64_t blocks_for(int64_t count) { return (count + kLanes - 1) / kLanes; }
SPLATMILL_INLINE Float row(const float* block, int r) { return load(block + r * kLanes); }

// Lanes of block `b` that hold a Gaussian; the last block may be partly empty.
inline uint32_t lanes_of(int64_t b, int64_t count) {
  const int64_t left = count - b * kLanes;
  return left >= kLanes ? 0xFFFFu : (1u << left) - 1u;
}

inline constexpr float kAlphaMax = 0.999f;
inline constexpr float kBlur = 0.3f;              // pixels^2
inline constexpr float kCompensationMin = 2.5e-5f;

}  // namespace splatmill
