#pragma once

#include "layout/frame.hpp"

namespace splatmill {

// The planes after the three of colour.
inline constexpr int kAlphaPlane = 3, kDepthPlane = 4;

// Blends frame.entries front to back into `image`: three planes of colour, or five with alpha and depth. With frame.with_waves,
// colours have their waves. For the backward pass it
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
  kSums,
  // Of Gaussians with a wave:
  kSumFrequencyX = kSums, kSumFrequencyY, kSumPhase,  // over 2 pi
  kSumWaveRed, kSumWaveGreen, kSumWaveBlue,
  kWaveSums
};
static_assert(kWaveSums == kPairSums && kWaveSums - kSums == kWaveFloats);

// Writes the pair_sums of every pair that the forward pass blended, and clears `blocks` of every other touch.
void composite_backward(Frame& frame, const ImageGradient& gradient, int threads);

struct ProjectedRows;

// Fills the records and entries of a frame, whose camera has its size, from `count` projected rows and the lists of a caller, of
// `pairs` ids. Throws std::invalid_argument for lists that would make a pass read out of bounds.
void take_lists(Frame& frame, const ProjectedRows& rows, int64_t count, const int64_t* offsets, const int32_t* ids,
                int64_t pairs, int threads);

}  // namespace splatmill
