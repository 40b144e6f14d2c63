// The intermediate results between the parameters and the image of one view, in buffers that are kept from step to step.
#pragma once

#include <vector>

#include "layout/buffer.hpp"
#include "layout/camera.hpp"
#include "layout/layout.hpp"

namespace splatmill {

// One (Gaussian, tile) pair, among those of its Gaussian.
struct Touch {
  uint32_t id;  // Gaussian
  uint32_t tile;
  uint32_t blocks;  // bits: which of the tile's sixteen 4x4-pixel blocks the ellipse reaches
};

// The same pair, in the list of its tile.
struct Entry {
  uint32_t id;      // Gaussian
  uint32_t slot;    // its Touch, and its row of pair sums
  uint32_t blocks;  // reached; after the forward pass, those that it changed
};

// The touches of a Gaussian: consecutive in the buffer, in tile order. Sums over them are taken in this order on any number of
// threads.
struct Span {
  uint32_t first, count;
};

// What is added to the colour of a Gaussian at an offset d from its centre: amplitude times cos(2 pi (fx dx + fy dy + phase)).
struct Wave {
  float fx, fy;  // cycles per pixel
  float phase;   // turns
  float amplitude[3];
};
inline constexpr int kWaveFloats = 6;

inline constexpr int kPairSums = 16;  // floats per pair

// Wall seconds of the last passes, for benchmarks.
struct PassSeconds {
  double project = 0, bin = 0, forward = 0, backward = 0, update = 0;
};

struct Frame {
  Camera camera;
  PassSeconds seconds;
  int64_t count = 0;          // Gaussians
  int64_t visible_count = 0;  // that reach a block
  int64_t pairs = 0;

  Buffer<Record> records;        // [count], written where visible
  Buffer<uint16_t> visible;      // [blocks] one bit per Gaussian
  Buffer<Span> spans;            // [count], written where visible
  Buffer<Touch> touches;         // one stretch per thread, one after the other
  std::vector<int64_t> rooms;    // touches that fit into each thread's stretch
  int64_t most_wanted = 0;       // touches of the view that needed the most room so far
  Buffer<Span> order, order_swap;     // the visible Gaussians' touches, by depth once sorted
  Buffer<uint32_t> keys, keys_swap;   // their depths' bits
  Buffer<uint32_t> histogram;    // [threads][max(tiles, digits)]
  Buffer<int64_t> offsets;       // [tiles + 1]
  Buffer<Entry> entries;         // [pairs] by tile, front to back
  Buffer<float> final_T;         // [tiles][16 blocks][16 pixels]
  Buffer<int32_t> walked;        // [tiles] entries of the list that the forward pass looked at
  Buffer<float> pair_sums;       // [slots][kPairSums]
  bool with_waves = false;       // whether the next two are of this view
  Buffer<Wave> waves;
  Buffer<int32_t> wave_rows;     // [count] the wave of each Gaussian, below 0 for none
  Buffer<double> pose_sums;      // [chunks of the update][kPoseSums], used when the camera's gradient is asked for

  const Wave* wave_of(uint32_t id) const { return wave_rows[id] < 0 ? nullptr : &waves[wave_rows[id]]; }
  int tiles() const { return camera.columns() * camera.rows(); }
};

}  // namespace splatmill
