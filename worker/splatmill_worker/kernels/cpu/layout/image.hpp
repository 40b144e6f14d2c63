// Planar float images padded to whole tiles, as composite, loss and the step exchange them.
#pragma once

#include <cstdint>

#include "layout/record.hpp"

namespace splatmill {

inline constexpr int kPadding = 16;  // pixels, both ways: a multiple of the tile

// Plane c, row y, column x is at data[c * plane + y * stride + x], 64-byte aligned at every x that is a multiple of 16.
// Rows and columns are padded to multiples of kPadding. The padding of an image or a gradient may hold any finite value; code that writes an
// image keeps its padding finite.
struct Planes {
  float* data = nullptr;
  int width = 0, height = 0;   // pixels of the image proper
  int64_t stride = 0;          // floats from row to row: the padded width
  int64_t plane = 0;           // floats from plane to plane: stride times the padded height

  float* at(int c, int y, int x = 0) const { return data + c * plane + y * stride + x; }
};

static_assert(kPadding % kTile == 0);

inline int tiles_across(int pixels) { return (pixels + kTile - 1) / kTile; }
inline int padded(int pixels) { return (pixels + kPadding - 1) / kPadding * kPadding; }

}  // namespace splatmill
