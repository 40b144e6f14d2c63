#pragma once

#include "frame.hpp"

namespace splatmill {

// Planes beyond colour that a pass fills or reads.
inline constexpr int kAlphaPlane = 3, kDepthPlane = 4;

// Blends frame.entries front to back into `image` (3 planes of colour, with alpha and depth 5). Leaves final_T and walked, and
// in every entry the blocks that it changed, for the backward pass.
void composite_forward(Frame& frame, const Planes& image, bool with_alpha_and_depth, const float background[3], int threads);

// What a backward pass is given: the forward image (as it was written, background and all) and its gradient, 3 planes, or 5 with
// alpha and depth. `absolute` asks for the sums behind the absolute densification score too; the plain one needs none of its own.
struct ImageGradient {
  Planes image, gradient;
  bool with_alpha_and_depth = false;
  bool absolute = false;
};

// Rows of frame.pair_sums: what each (tile, Gaussian) pair adds up over its pixels. q = alpha dL/dalpha, w the blending weight.
enum PairSum {
  kSumQ = 0, kSumQU, kSumQV, kSumQUU, kSumQUV, kSumQVV,
  kSumRed, kSumGreen, kSumBlue,  // w dL/dcolour
  kSumDepth,                     // w dL/ddepth
  kSumAbsX, kSumAbsY,            // |dL/dx|, |dL/dy| of the mean, pixel by pixel, up to 2 ln 2
  kSums
};

// Fills pair_sums of every pair that the forward pass blended, and clears `blocks` of every other touch.
void composite_backward(Frame& frame, const ImageGradient& gradient, int threads);

}  // namespace splatmill
