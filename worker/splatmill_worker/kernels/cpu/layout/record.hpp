// The record of a projected Gaussian, and the constants that trade exactness for time.
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd/simd.hpp"

namespace splatmill {

inline constexpr int kTile = 16;  // pixels, both ways
inline constexpr float kAlphaMin = 1.0f / 255.0f, kLog2AlphaMin = -7.994353436858858f;
inline constexpr float kTransmittanceMin = 1e-4f;

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

}  // namespace splatmill
