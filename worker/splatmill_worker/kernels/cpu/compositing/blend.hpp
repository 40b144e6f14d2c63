// One Gaussian over one 4x4-pixel block: the arithmetic whose bits must agree between the forward and the backward pass.
#pragma once

#include "layout/frame.hpp"
#include "simd/math.hpp"
#include "tiles/reach.hpp"

namespace splatmill {

// Places of pixels within a block, by lane, and of blocks within a tile, in pixels.
struct TileLanes {
  Float pixel_x, pixel_y;  // lane's pixel within a block
  Float block_x, block_y;  // lane b: left and top of block b
};
SPLATMILL_INLINE TileLanes tile_lanes() {
  const Float l = iota(), row = floor(l * 0.25f), column = fma(row, splat(-4.0f), l);
  const Float block_row = floor(l * (1.0f / kBlocksAcross)), block_column = fma(block_row, splat(-1.0f * kBlocksAcross), l);
  return {column, row, block_column * 4.0f, block_row * 4.0f};
}

// u and v of a Gaussian over a tile: at block b, the lanes' part plus the offset of the block.
struct TileForm {
  Float u, v;
  alignas(64) float block_u[kLanes], block_v[kLanes];

  // The tile's first pixel centre is at (x0, y0).
  SPLATMILL_INLINE TileForm(const Record& r, const TileLanes& lanes, float x0, float y0) {
    const Float ux = splat(r.ux), uy = splat(r.uy), vy = splat(r.vy);
    // At the first pixel u is a difference of numbers that are as large as the centre is far off. It is rounded once for the tile:
    // that moves the Gaussian as a whole, as rounding its centre does. Rounded for each pixel, it would be noise in their sums.
    const Float dy = splat(y0 - r.y), u0 = fma(ux, splat(x0 - r.x), uy * dy);
    u = fma(ux, lanes.pixel_x, fma(uy, lanes.pixel_y, u0));
    v = fma(vy, lanes.pixel_y, vy * dy);
    store(block_u, fma(ux, lanes.block_x, uy * lanes.block_y));
    store(block_v, vy * lanes.block_y);
  }
  SPLATMILL_INLINE Float u_at(int block) const { return u + block_u[block]; }
  SPLATMILL_INLINE Float v_at(int block) const { return v + block_v[block]; }
};

// log2 of alpha before the clamp.
SPLATMILL_INLINE Float log2_alpha(Float level, Float u, Float v) { return fnma(v, v, fnma(u, u, level)); }

// The blocks of a tile that contain pixels of the image, as bits.
inline uint32_t blocks_inside(int tile_x, int tile_y, const Camera& cam) {
  uint32_t inside = 0;
  for (int b = 0; b < kTileBlocks; ++b)
    if (tile_x * kTile + b % kBlocksAcross * kBlockSide < cam.width && tile_y * kTile + b / kBlocksAcross * kBlockSide < cam.height)
      inside |= 1u << b;
  return inside;
}

// Loading and storing a block's sixteen pixels of a plane.
SPLATMILL_INLINE float* block_origin(const Planes& image, int plane, int tile_x, int tile_y, int block) {
  return image.at(plane, tile_y * kTile + block / kBlocksAcross * kBlockSide, tile_x * kTile + block % kBlocksAcross * kBlockSide);
}
SPLATMILL_INLINE Float load_block(const float* origin, int64_t stride) {
  alignas(64) float lanes[kLanes];
  for (int y = 0; y < kBlockSide; ++y) std::memcpy(lanes + 4 * y, origin + y * stride, 16);
  return load(lanes);
}
SPLATMILL_INLINE void store_block(float* origin, int64_t stride, Float x) {
  alignas(64) float lanes[kLanes];
  store(lanes, x);
  for (int y = 0; y < kBlockSide; ++y) std::memcpy(origin + y * stride, lanes + 4 * y, 16);
}

inline constexpr int kEntriesAhead = 16;  // how far ahead in the list records are prefetched

}  // namespace splatmill
