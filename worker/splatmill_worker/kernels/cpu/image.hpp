// Planar float images, padded so that every tile is whole: what composite, loss and the step hand each other.
#pragma once

#include <cstdint>

namespace splatmill {

inline constexpr int kTile = 16;  // pixels, both ways

// Plane c, row y, column x is at data[c * plane + y * stride + x], 64-byte aligned at every x that is a multiple of 16.
// Rows and columns are padded to whole tiles. What the padding holds: images and gradients handed to the loss or to the backward
// pass may hold anything there that is finite; whoever writes an image that others read keeps it finite.
struct Planes {
  float* data = nullptr;
  int width = 0, height = 0;   // pixels of the image proper
  int64_t stride = 0;          // floats from row to row: width padded to whole tiles
  int64_t plane = 0;           // floats from plane to plane: stride times the padded height

  float* at(int c, int y, int x = 0) const { return data + c * plane + y * stride + x; }
};

inline int tiles_across(int pixels) { return (pixels + kTile - 1) / kTile; }

}  // namespace splatmill
