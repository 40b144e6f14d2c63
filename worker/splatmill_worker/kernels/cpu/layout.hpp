// Layout of a scene: blocks of sixteen Gaussians, one lane each, so that every kernel over Gaussians reads whole vectors.
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd.hpp"

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

// What compositing needs of a projected Gaussian: one cache line.
// log2 alpha at a pixel d = p - (x, y) is level - (ux dx + uy dy)^2 - (vy dy)^2: the triangular factor of the conic, scaled by
// log2(e) / 2, and log2 of the opacity folded in. The factor keeps the digits that a needle's conic has lost.
struct alignas(64) Record {
  float x, y;              // pixels
  float ux, uy, vy;        // 1 / pixels
  float level;             // log2 opacity
  float color[3];
  float depth;             // camera z
  float cut;               // level - log2(1/255): where u^2 + v^2 is within it, alpha is at least 1/255
  float slope_x, slope_y;  // -dx/dy and -dy/dx along which u^2 + v^2 is smallest for given dy and given dx
  float extent_x, extent_y;
  float opacity;
};
static_assert(sizeof(Record) == 64);

// The places of a Record's floats.
enum RecordPlace {
  kRecordX, kRecordY, kRecordUx, kRecordUy, kRecordVy, kRecordLevel, kRecordRed, kRecordGreen, kRecordBlue, kRecordDepth,
  kRecordCut, kRecordSlopeX, kRecordSlopeY, kRecordExtentX, kRecordExtentY, kRecordOpacity, kRecordFloats
};
static_assert(kRecordFloats == kLanes && offsetof(Record, opacity) == kRecordOpacity * sizeof(float));

inline constexpr float kAlphaMin = 1.0f / 255.0f;
inline constexpr float kLog2AlphaMin = -7.994353436858858f;
inline constexpr float kAlphaMax = 0.999f;
inline constexpr float kTransmittanceMin = 1e-4f;
inline constexpr float kBlur = 0.3f;              // pixels^2
inline constexpr float kCompensationMin = 2.5e-5f;

}  // namespace splatmill
