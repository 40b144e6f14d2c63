// L1 + D-SSIM between a rendering and an 8-bit photo, with its gradient, for the fused step and the `loss` op.
#pragma once

#include <cstdint>

#include "layout/buffer.hpp"
#include "layout/image.hpp"

namespace splatmill {

// A photo and its part of SSIM as `photo_stats` computes them. All planes have `stride` values per row, the width rounded up to
// whole tiles, and zeros in the padding.
struct Photo {
  const uint8_t* pixels;  // [3, height, stride], zero where a pixel is not used
  const float* mean;      // [3, height, stride] windowed mean
  const float* variance;  // [3, height, stride] windowed variance
  const uint8_t* used;    // [height, stride], 1 where a pixel is used
  int width = 0, height = 0;
  int64_t stride = 0;
  double count = 0;  // used pixels
};

struct LossValue {
  double l1 = 0;    // mean |color - photo| over used pixels and channels
  double ssim = 1;  // mean SSIM over the same
};

// Rows that are being filtered, one set per thread, and the sums of every row; grows to the largest image and is reused.
struct LossScratch {
  Buffer<float> lines;
  Buffer<double> sums;
};

// Returns both means, and writes the gradient of (1 - w) l1 + w (1 - ssim), w = dssim_weight, to the three planes of `gradient`:
// zero in the padding and where a pixel is not used. The result does not depend on the number of threads.
LossValue loss(const Planes& color, const Photo& photo, float dssim_weight, const Planes& gradient, LossScratch& scratch,
               int threads);

}  // namespace splatmill
