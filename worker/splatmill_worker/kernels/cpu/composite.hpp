#pragma once

#include "frame.hpp"

namespace splatmill {

// The planes after the three of colour.
inline constexpr int kAlphaPlane = 3, kDepthPlane = 4;

// Blends frame.entries front to back into `image`: three planes of colour, or five with alpha and depth. For the backward pass it
// writes final_T and walked, and reduces the blocks of every entry to those that it changed.
void composite_forward(Frame& frame, const Planes& image, bool with_alpha_and_depth, const float background[3], int threads);

// The input of a backward pass: the image as the forward pass wrote it, with the background, and its gradient; three planes each,
// or five with alpha and depth.
struct ImageGradient {
  Planes image, gradient;
  bool with_alpha_and_depth = false;
};

// Columns of frame.pair_sums: sums over the pixels of a (tile, Gaussian) pair. q = alpha dL/dalpha, w the blending weight.
enum PairSum {
  kSumQ = 0, kSumQU, kSumQV, kSumQUU, kSumQUV, kSumQVV,
  kSumRed, kSumGreen, kSumBlue,  // w dL/dcolour
  kSumDepth,                     // w dL/ddepth; last, because a pass without depth stops before it
  kSums
};

// Writes the pair_sums of every pair that the forward pass blended, and clears `blocks` of every other touch.
void composite_backward(Frame& frame, const ImageGradient& gradient, int threads);

}  // namespace splatmill
