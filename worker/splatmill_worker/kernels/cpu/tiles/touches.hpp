// Collects the touches of all visible Gaussians in parallel, into buffers that grow when a view has more than any before.
#pragma once

#include <algorithm>
#include <exception>
#include <numeric>
#include <string>
#include <vector>

#include "simd/threads.hpp"
#include "tiles/reach.hpp"

namespace splatmill {

// Touches of a view at most, as many as the GPU's lists hold; slots are numbered in 32 bits, the spare ones too.
inline constexpr int64_t kMostTouches = (int64_t{1} << 31) - 1, kMostSlots = (int64_t{1} << 32) - 1;

// A view has more touches than lists can hold. Python sees it as records.TooManyPairs.
class TooManyPairs : public std::exception {
 public:
  explicit TooManyPairs(int64_t touches)
      : text_("The Gaussians cover about " + std::to_string(touches) + " tiles in this view; its lists hold " +
              std::to_string(kMostTouches) +
              ". Use fewer Gaussians or smaller images; a few tiles for each are usual, so most may be far too large.") {}
  const char* what() const noexcept override { return text_.c_str(); }

 private:
  std::string text_;
};

// Writes one thread's stretch [begin, end) of the frame's touches, visible Gaussians and depth keys.
class TouchWriter {
 public:
  TouchWriter(Frame& frame, int64_t begin, int64_t end, int64_t first_id)
      : frame_(frame), columns_(frame.camera.columns()), rows_(frame.camera.rows()), begin_(begin), next_(begin), limit_(end),
        order_(frame.order.get() + first_id), keys_(frame.keys.get() + first_id) {}

  // Adds the touches of Gaussian `id`, whose record is `r`. False when it reaches no block of the image, or when the stretch has
  // no room for all tiles of its box, which then count as left out.
  SPLATMILL_INLINE bool add(uint32_t id, const Record& r) {
    const TileRange range = tile_range(r, columns_, rows_);
    const int64_t before = next_, most = range.tiles();
    if (next_ + most > limit_) {
      left_out_ += most;
      return false;
    }
    peak_ = std::max(peak_, next_ + most);
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
  bool complete() const { return left_out_ == 0; }
  // The room that a repetition needs. It is enough where this time was complete, and otherwise more than there was.
  int64_t wanted() const { return std::max(peak_ - begin_, touches() + left_out_); }
  int64_t visible() const { return visible_; }

 private:
  Frame& frame_;
  int columns_, rows_;
  int64_t begin_, next_, limit_, peak_ = 0;
  Span* order_;
  uint32_t* keys_;
  int64_t visible_ = 0, left_out_ = 0;  // left_out_: tiles of the boxes that found no room
};

// Gives every thread's stretch room for what it wanted in the last view, and a quarter more. Threads keep the room that other
// views made them need, as long as all rooms together hold at most twice what the largest view asks for: which Gaussians are
// large and in view differs between threads, and room for the busiest one in all of them would be too much by their number.
inline void grow_rooms(Frame& frame, const std::vector<int64_t>& wanted, int64_t least) {
  const auto threads = static_cast<int64_t>(wanted.size());
  int64_t total = 0;
  for (int64_t t = 0; t < threads; ++t) total += frame.rooms[t] = std::max(frame.rooms[t], wanted[t] + wanted[t] / 4);
  if (total <= frame.most_wanted * 5 / 2 + least * threads) return;
  for (int64_t t = 0; t < threads; ++t) frame.rooms[t] = std::max(least, wanted[t] + wanted[t] / 4);
}

// Runs visit(begin, end, writer) over `n` blocks of sixteen of the `count` Gaussians, divided among the threads, and closes the
// gaps between the threads' Gaussians. Repeats with more room when a stretch overflowed. Throws TooManyPairs.
template <class Visit>
void collect_touches(Frame& frame, int64_t count, int64_t n, int threads, Visit visit) {
  frame.count = count;
  frame.records.reserve(blocks_for(count) * kLanes);
  frame.spans.reserve(blocks_for(count) * kLanes);
  for (auto* buffer : {&frame.order, &frame.order_swap}) buffer->reserve(n * kLanes);
  for (auto* buffer : {&frame.keys, &frame.keys_swap}) buffer->reserve(n * kLanes);
  const int64_t least = std::max<int64_t>(2 * std::min(count, n * kLanes) / threads, 4096);
  frame.rooms.resize(threads);
  for (int64_t& room : frame.rooms) room = std::max(room, least);

  struct Found {
    int64_t touches = 0, visible = 0;
    bool complete = true;
  };
  std::vector<Found> found(threads);
  std::vector<int64_t> starts(threads + 1), wanted(threads);
  for (;;) {
    std::partial_sum(frame.rooms.begin(), frame.rooms.end(), starts.begin() + 1);
    if (starts[threads] > kMostSlots) throw TooManyPairs(starts[threads]);
    frame.touches.reserve(starts[threads]);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int t = 0; t < threads; ++t) {
      const FlushDenormals flush;
      const int64_t begin = n * t / threads, end = n * (t + 1) / threads;
      TouchWriter writer(frame, starts[t], starts[t + 1], begin * kLanes);
      visit(begin, end, writer);
      found[t] = {writer.touches(), writer.visible(), writer.complete()};
      wanted[t] = writer.wanted();
    }
    if (std::all_of(found.begin(), found.end(), [](const Found& f) { return f.complete; })) break;
    const int64_t total = std::accumulate(wanted.begin(), wanted.end(), int64_t{0});
    if (total > kMostTouches) throw TooManyPairs(total);
    frame.most_wanted = std::max(frame.most_wanted, total);
    grow_rooms(frame, wanted, least);
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
