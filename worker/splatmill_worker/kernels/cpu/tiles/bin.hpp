#pragma once

#include "layout/frame.hpp"

namespace splatmill {

// Sorts what project_frame found into frame.entries and frame.offsets: by tile, front to back, equal depths by index.
void bin_frame(Frame& frame, int threads);

}  // namespace splatmill
