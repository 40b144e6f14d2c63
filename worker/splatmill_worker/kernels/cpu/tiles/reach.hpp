// The test behind every list: which tiles, and which 4x4-pixel blocks of each, the 1/255 ellipse of a Gaussian reaches.
#pragma once

#include <algorithm>

#include "layout/frame.hpp"

namespace splatmill {

// A tile's pixels as vectors: block b is 4x4 pixels at 4 (b % kBlocksAcross, b / kBlocksAcross), lane l of it the pixel
// (l % 4, l / 4).
inline constexpr int kBlockSide = 4;
inline constexpr int kBlocksAcross = kTile / kBlockSide;
inline constexpr int kTileBlocks = kBlocksAcross * kBlocksAcross;
static_assert(kTileBlocks <= kLanes);

// Lane b: the left and the upper pixel centre of block b within a tile.
struct BlockOffsets {
  Float x, y;
};
SPLATMILL_INLINE BlockOffsets block_offsets() {
  const Float b = iota(), row = floor(b * (1.0f / kBlocksAcross));
  return {fma(row, splat(-1.0f * kTile), b * 4.0f) + 0.5f, fma(row, 4.0f, splat(0.5f))};
}

// The test for one Gaussian, tile by tile.
//
// The smallest u^2 + v^2 over a block's rectangle of pixel centres lies on the edge nearest the mean in x or in y; both are tried,
// for sixteen blocks at once. The margin in `cut_` covers the rounding of u and v, which grows with the extent of the ellipse, so
// that no pixel is missed. Each pixel is tested again when it is blended.
class Reach {
 public:
  SPLATMILL_INLINE explicit Reach(const Record& r)
      : x_(r.x), y_(r.y), corner_(block_offsets()), ux_(splat(r.ux)), uy_(splat(r.uy)), vy_(splat(r.vy)),
        slope_x_(splat(r.slope_x)), slope_y_(splat(r.slope_y)),
        cut_(splat(r.cut + 2e-5f + 1e-6f * (r.ux * r.extent_x + __builtin_fabsf(r.uy) * r.extent_y))) {}

  // What the tiles of a row have in common.
  struct Row {
    Float top, bottom, u, v2, best_x;
  };
  SPLATMILL_INLINE Row row(int tile_y) const {
    const Float top = corner_.y + (static_cast<float>(tile_y * kTile) - y_), bottom = top + kSpan;
    const Float nearest = min(max(splat(0.0f), top), bottom), v = vy_ * nearest;
    return {top, bottom, uy_ * nearest, v * v, slope_x_ * nearest};
  }
  SPLATMILL_INLINE uint32_t blocks(const Row& row, int tile_x) const {
    const Float left = corner_.x + (static_cast<float>(tile_x * kTile) - x_), right = left + kSpan;
    const Float nearest = min(max(splat(0.0f), left), right);
    const Float dy = min(max(slope_y_ * nearest, row.top), row.bottom);
    const Float u1 = fma(uy_, dy, ux_ * nearest), v1 = vy_ * dy;
    const Float dx = min(max(row.best_x, left), right);
    const Float u2 = fma(ux_, dx, row.u);
    return bits(min(fma(u1, u1, v1 * v1), fma(u2, u2, row.v2)) <= cut_) & ((1u << kTileBlocks) - 1u);
  }

 private:
  static constexpr float kSpan = kBlockSide - 1;
  float x_, y_;
  BlockOffsets corner_;
  Float ux_, uy_, vy_, slope_x_, slope_y_, cut_;
};

// The tiles [x0, x1) x [y0, y1) whose pixel centres meet the box of the ellipse; bounded by the grid, whatever the extents are.
struct TileRange {
  int x0, x1, y0, y1;
  int64_t tiles() const { return static_cast<int64_t>(std::max(x1 - x0, 0)) * std::max(y1 - y0, 0); }
};
SPLATMILL_INLINE TileRange tile_range(const Record& r, int columns, int rows) {
  const auto bounded = [](float tile, int n) {
    return static_cast<int>(std::min(std::max(tile, 0.0f), static_cast<float>(n)));
  };
  constexpr float kPerTile = 1.0f / kTile;
  return {bounded((r.x - r.extent_x - 0.5f) * kPerTile, columns), bounded((r.x + r.extent_x - 0.5f) * kPerTile + 1.0f, columns),
          bounded((r.y - r.extent_y - 0.5f) * kPerTile, rows), bounded((r.y + r.extent_y - 0.5f) * kPerTile + 1.0f, rows)};
}

}  // namespace splatmill
