// Planar float images padded to whole tiles, as composite, loss and the step exchange them.
#pragma once

#include <cstdint>

namespace splatmill {

inline constexpr int kTile = 16;  // pixels, both ways

// Plane c, row y, column x is at data[c * plane + y * stride + x], 64-byte aligned at every x that is a multiple of 16.
// Rows and columns are padded to whole tiles. The padding of an image or a gradient may hold any finite value; code that writes an
// image keeps its padding finite.
struct Planes {
  float* data = nullptr;
  int width = 0, height = 0;   // pixels of the image proper
  int64_t stride = 0;          // floats from row to row: width padded to whole tiles
  int64_t plane = 0;           // floats from plane to plane: stride times the padded height

  float* at(int c, int y, int x = 0) const { return data + c * plane + y * stride + x; }
};

inline int tiles_across(int pixels) { return (pixels + kTile - 1) / kTile; }

}  // namespace splatmill
