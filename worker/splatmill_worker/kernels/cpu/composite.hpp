#pragma once

#include "frame.hpp"

namespace splatmill {

// Planes beyond colour that a pass fills or reads.
inline constexpr int kAlphaPlane = 3, kDepthPlane = 4;

// Blends frame.entries front to back into `image` (3 planes of colour, with alpha and depth 5). Leaves final_T and walked, and
// in every entry the blocks that it changed, for the backward pass.
void composite_forward(Frame& frame, const Planes& image, bool with_alpha_and_depth, const float background[3], int threads);

// What a backward pass is given: the forward image (as it was written, background and all) and its gradient, 3 planes, or 5 with
// alpha and depth. `scores` asks for the sums behind the densification scores too; of a photo (the loss's planes) they weigh
// each pixel's error.
struct ImageGradient {
  Planes image, gradient;
  bool with_alpha_and_depth = false;
  bool scores = false;
  const uint8_t* photo = nullptr;  // [3, height, stride], null: no error is summed
  const uint8_t* used = nullptr;   // [height, stride], 1 where a pixel counts
};

// Rows of frame.pair_sums: what each (tile, Gaussian) pair adds up over its pixels. q = alpha dL/dalpha, w the blending weight.
enum PairSum {
  kSumQ = 0, kSumQU, kSumQV, kSumQUU, kSumQUV, kSumQVV,
  kSumRed, kSumGreen, kSumBlue,  // w dL/dcolour
  kSumDepth,                     // w dL/ddepth
  kSumAbsX, kSumAbsY,            // |dL/dx|, |dL/dy| of the mean, pixel by pixel, up to 2 ln 2
  kSumError,                     // w sum |colour - photo| over the channels
  kSums
};

// Fills pair_sums of every pair that the forward pass blended, and clears `blocks` of every other touch.
void composite_backward(Frame& frame, const ImageGradient& gradient, int threads);

}  // namespace splatmill
