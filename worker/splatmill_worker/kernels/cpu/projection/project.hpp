#pragma once

#include "layout/frame.hpp"
#include "training/clusters.hpp"

namespace splatmill {

// Projects all Gaussians (blocks [blocks_for(count)][kRows][kLanes]) into frame.camera and finds the blocks of pixels that each
// reaches. With `clusters`, only those of the chosen ones; the others are not visible. Writes records, visible, spans and touches,
// and the spans (`order`) and depth keys of the visible ones, unsorted.
void project_frame(const float* blocks, int64_t count, int degree, Frame& frame, int threads, const Clusters* clusters);

}  // namespace splatmill
