// Collecting the touches of all visible Gaussians, in parallel, into buffers that grow when a view needs more than any before.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "reach.hpp"
#include "threads.hpp"

namespace splatmill {

// A slot is 32 bits wide, and each one will need a row of pair sums besides.
inline constexpr int64_t kMostTouches = int64_t{1} << 31;

// One thread's stretch of the frame's touches, and of its visible ids and depth keys.
class TouchWriter {
 public:
  TouchWriter(Frame& frame, int64_t thread, int64_t first_id)
      : frame_(frame), columns_(frame.camera.columns()), rows_(frame.camera.rows()), begin_(frame.stretch * thread),
        next_(begin_), limit_(begin_ + frame.stretch), ids_(frame.ids.get() + first_id), keys_(frame.keys.get() + first_id) {}

  // Adds the record of Gaussian `id`; false when it reaches no block of the image.
  SPLATMILL_INLINE bool add(uint32_t id) {
    const Record& r = frame_.records[id];
    const int64_t before = next_;
    for_each_tile(r, columns_, rows_, [&](uint32_t tile, uint32_t blocks) {
      if (next_ < limit_) frame_.touches[next_] = {tile, blocks};
      ++next_;
    });
    if (next_ == before) return false;
    frame_.spans[id] = {static_cast<uint32_t>(before), static_cast<uint32_t>(next_ - before)};
    ids_[visible_] = id;
    std::memcpy(&keys_[visible_], &r.depth, sizeof(float));  // positive floats sort as their bits
    ++visible_;
    return true;
  }
  int64_t touches() const { return next_ - begin_; }  // those that found no room count too
  int64_t visible() const { return visible_; }

 private:
  Frame& frame_;
  int columns_, rows_;
  int64_t begin_, next_, limit_;
  uint32_t *ids_, *keys_;
  int64_t visible_ = 0;
};

// Runs visit(begin, end, writer) over all blocks of sixteen Gaussians, cut among the threads, and closes the gaps between the
// threads' ids. Once more with more room when a stretch overflowed. Throws std::length_error when no buffer could hold the pairs.
template <class Visit>
void collect_touches(Frame& frame, int64_t count, int threads, Visit visit) {
  const int64_t n = blocks_for(count);
  frame.count = count;
  frame.records.reserve(n * kLanes);
  frame.visible.reserve(n);
  frame.spans.reserve(n * kLanes);
  for (auto* buffer : {&frame.ids, &frame.keys, &frame.ids_swap, &frame.keys_swap}) buffer->reserve(n * kLanes);
  frame.stretch = std::max<int64_t>({frame.stretch, 2 * count / threads, 4096});

  struct Found {
    int64_t touches = 0, visible = 0;
  };
  std::vector<Found> found(threads);
  for (;;) {
    frame.touches.reserve(frame.stretch * threads);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int t = 0; t < threads; ++t) {
      const FlushDenormals flush;
      const int64_t begin = n * t / threads, end = n * (t + 1) / threads;
      TouchWriter writer(frame, t, begin * kLanes);
      visit(begin, end, writer);
      found[t] = {writer.touches(), writer.visible()};
    }
    int64_t most = 0;
    for (const Found& f : found) most = std::max(most, f.touches);
    if (most <= frame.stretch) break;
    if (most > kMostTouches / threads)
      throw std::length_error("The Gaussians cover about " + std::to_string(most * threads) +
                              " tiles in this view, more than lists are made for; most of them are far too large for the scene.");
    frame.stretch = std::min(most + most / 4, kMostTouches / threads);
  }

  frame.visible_count = frame.pairs = 0;
  for (int t = 0; t < threads; ++t) {
    const int64_t from = n * t / threads * kLanes, to = frame.visible_count;
    if (from != to) {
      std::memmove(&frame.ids[to], &frame.ids[from], found[t].visible * sizeof(uint32_t));
      std::memmove(&frame.keys[to], &frame.keys[from], found[t].visible * sizeof(uint32_t));
    }
    frame.visible_count += found[t].visible;
    frame.pairs += found[t].touches;
  }
}

}  // namespace splatmill
