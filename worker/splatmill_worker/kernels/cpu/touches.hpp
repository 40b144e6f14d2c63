// Collects the touches of all visible Gaussians in parallel, into buffers that grow when a view has more than any before.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "reach.hpp"
#include "threads.hpp"

namespace splatmill {

// Slots are numbered in 32 bits.
inline constexpr int64_t kMostTouches = int64_t{1} << 31;

// Writes one thread's stretch of the frame's touches, visible Gaussians and depth keys.
class TouchWriter {
 public:
  TouchWriter(Frame& frame, int64_t thread, int64_t first_id)
      : frame_(frame), columns_(frame.camera.columns()), rows_(frame.camera.rows()), begin_(frame.stretch * thread),
        next_(begin_), limit_(begin_ + frame.stretch), order_(frame.order.get() + first_id), keys_(frame.keys.get() + first_id) {}

  // Adds the touches of Gaussian `id`, whose record is `r`. False when it reaches no block of the image, or when the stretch has no room for all
  // tiles of its box, which then count as wanted.
  SPLATMILL_INLINE bool add(uint32_t id, const Record& r) {
    const TileRange range = tile_range(r, columns_, rows_);
    const int64_t before = next_, most = range.tiles();
    if (next_ + most > limit_) {
      wanted_ += most;
      return false;
    }
    const Reach reach(r);
    Touch* touch = &frame_.touches[next_];
    for (int ty = range.y0; ty < range.y1; ++ty) {
      const Reach::Row row = reach.row(ty);
      for (int tx = range.x0; tx < range.x1; ++tx) {
        const uint32_t blocks = reach.blocks(row, tx);
        *touch = {id, static_cast<uint32_t>(ty * columns_ + tx), blocks};
        touch += blocks != 0;  // no branch: which tiles of the box the ellipse misses is not predictable
      }
    }
    next_ = touch - frame_.touches.get();
    if (next_ == before) return false;
    frame_.spans[id] = {static_cast<uint32_t>(before), static_cast<uint32_t>(next_ - before)};
    order_[visible_] = frame_.spans[id];
    std::memcpy(&keys_[visible_], &r.depth, sizeof(float));  // positive floats sort as their bits
    ++visible_;
    return true;
  }
  int64_t touches() const { return next_ - begin_; }
  int64_t wanted() const { return wanted_; }  // tiles of the boxes that found no room
  int64_t visible() const { return visible_; }

 private:
  Frame& frame_;
  int columns_, rows_;
  int64_t begin_, next_, limit_;
  Span* order_;
  uint32_t* keys_;
  int64_t visible_ = 0, wanted_ = 0;
};

// Runs visit(begin, end, writer) over all blocks of sixteen Gaussians, divided among the threads, and closes the gaps between the
// threads' Gaussians. Repeats with more room when a stretch overflowed. Throws std::length_error for more touches than slots.
template <class Visit>
void collect_touches(Frame& frame, int64_t count, int threads, Visit visit) {
  const int64_t n = blocks_for(count);
  frame.count = count;
  frame.records.reserve(n * kLanes);
  frame.visible.reserve(n);
  frame.spans.reserve(n * kLanes);
  for (auto* buffer : {&frame.order, &frame.order_swap}) buffer->reserve(n * kLanes);
  for (auto* buffer : {&frame.keys, &frame.keys_swap}) buffer->reserve(n * kLanes);
  frame.stretch = std::max<int64_t>({frame.stretch, 2 * count / threads, 4096});

  struct Found {
    int64_t touches = 0, visible = 0, wanted = 0;
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
      found[t] = {writer.touches(), writer.visible(), writer.wanted()};
    }
    int64_t most = 0;
    bool complete = true;
    for (const Found& f : found) {
      complete = complete && f.wanted == 0;
      most = std::max(most, f.touches + f.wanted);
    }
    if (complete) break;
    if (most > kMostTouches / threads)
      throw std::length_error("The Gaussians cover about " + std::to_string(most * threads) + " tiles in this view; lists hold " +
                              std::to_string(kMostTouches) + ". Most of the Gaussians are far too large for the scene.");
    frame.stretch = std::min(most + most / 4, kMostTouches / threads);
  }

  frame.visible_count = frame.pairs = 0;
  for (int t = 0; t < threads; ++t) {
    const int64_t from = n * t / threads * kLanes, to = frame.visible_count;
    if (from != to) {
      std::memmove(&frame.order[to], &frame.order[from], found[t].visible * sizeof(Span));
      std::memmove(&frame.keys[to], &frame.keys[from], found[t].visible * sizeof(uint32_t));
    }
    frame.visible_count += found[t].visible;
    frame.pairs += found[t].touches;
  }
}

}  // namespace splatmill
