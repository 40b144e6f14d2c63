// L1 + D-SSIM between a rendering and an 8-bit photo, with its gradient: what the fused step calls, and the `loss` op.
#pragma once

#include <cstdint>

#include "buffer.hpp"
#include "image.hpp"

namespace splatmill {

// A photo as the loss reads it: its own planes and SSIM statistics, computed once (`photo_stats`) and read at every visit.
// All planes have `stride` values per row, the width rounded up to whole tiles, and zeros in the padding.
struct Photo {
  const uint8_t* pixels;  // [3, height, stride], zero where a pixel is not used
  const float* mean;      // [3, height, stride] windowed mean
  const float* variance;  // [3, height, stride] windowed variance
  const uint8_t* used;    // [height, stride], 1 where a pixel counts; zero in the padding
  int width = 0, height = 0;
  int64_t stride = 0;
  double count = 0;  // pixels that count
};

struct LossValue {
  double l1 = 0;    // mean |color - photo| over used pixels and channels
  double ssim = 1;  // mean SSIM over the same
  double total(double dssim_weight) const { return (1 - dssim_weight) * l1 + dssim_weight * (1 - ssim); }
};

// Rows in flight, one set per thread, and the sums of each row; grows to the largest image seen and is then reused.
struct LossScratch {
  Buffer<float> lines;
  Buffer<double> sums;
};

// Writes d(total) / d(color) to `gradient` (three planes of the same geometry as color), zero in its padding columns and rows and
// where a pixel is not used. The result does not depend on the number of threads.
LossValue loss(const Planes& color, const Photo& photo, float dssim_weight, const Planes& gradient, LossScratch& scratch,
               int threads);

}  // namespace splatmill
