// The formats in which memory holds harmonics, Adam's moments and projected records, and the constants that trade exactness for
// time. `bench precision` compiles builds of its own with other ones, by the definitions SPLATMILL_* (worker/bench/_studies/precision).
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd/simd.hpp"

namespace splatmill {

#ifdef SPLATMILL_TILE
inline constexpr int kTile = SPLATMILL_TILE;
#else
inline constexpr int kTile = 16;  // pixels, both ways
#endif

#ifdef SPLATMILL_LOG2_ALPHA_MIN
inline constexpr float kAlphaMin = SPLATMILL_ALPHA_MIN, kLog2AlphaMin = SPLATMILL_LOG2_ALPHA_MIN;
#else
inline constexpr float kAlphaMin = 1.0f / 255.0f, kLog2AlphaMin = -7.994353436858858f;
#endif

#ifdef SPLATMILL_TRANSMITTANCE_MIN
inline constexpr float kTransmittanceMin = SPLATMILL_TRANSMITTANCE_MIN;
#else
inline constexpr float kTransmittanceMin = 1e-4f;
#endif

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

// A format moves sixteen values between registers and kBytes * 16 bytes. Stochastic ones round by the bits of `Noise`.
struct Float32 {
  static constexpr int kBytes = 4;
  SPLATMILL_INLINE static Float load(const char* p) { return splatmill::load(reinterpret_cast<const float*>(p)); }
  template <class Noise>
  SPLATMILL_INLINE static void store(char* p, Float x, Noise& /*noise*/) {
    splatmill::store(reinterpret_cast<float*>(p), x);
  }
};

#ifdef SPLATMILL_STORAGE
}  // namespace splatmill
#include SPLATMILL_STORAGE
namespace splatmill {
#else
using Harmonics = Float32;
using FirstMoment = Float32;
using SecondMoment = Float32;
using StoredRecord = Record;
SPLATMILL_INLINE const Record& widened(const Record& r) { return r; }
struct Noise {
  SPLATMILL_INLINE Noise(int64_t /*step*/, int64_t /*block*/) {}
};
#endif

}  // namespace splatmill
