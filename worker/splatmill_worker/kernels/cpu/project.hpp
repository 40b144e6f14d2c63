#pragma once

#include "frame.hpp"

namespace splatmill {

// Projects all Gaussians (blocks [blocks_for(count)][kRows][kLanes]) into frame.camera, and finds the blocks of pixels that each
// one reaches: fills records, visible, spans, touches, and the unsorted ids and depth keys of the visible ones.
void project_frame(const float* blocks, int64_t count, int degree, Frame& frame, int threads);

}  // namespace splatmill
