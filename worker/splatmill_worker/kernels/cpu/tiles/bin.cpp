// bin: the pairs of a frame by tile, front to back. The visible Gaussians are sorted by depth, on the bits in which their depths
// differ; one stable counting pass then sorts the pairs by tile.
#include "tiles/bin.hpp"

#include <algorithm>
#include <utility>

#include "bindings/rows.hpp"
#include "tiles/touches.hpp"

namespace splatmill {
namespace {

constexpr int kMostDigitBits = 11;  // a pass writes to 2^11 places at once; more would not stay in the first-level cache
constexpr int kAhead = 16;          // how many Gaussians ahead touches are prefetched

struct Digits {
  uint32_t lowest = 0;
  int passes = 0, bits = 0;
};

Digits digits_of(const uint32_t* keys, int64_t n) {
  if (n == 0) return {};
  const auto [low, high] = std::minmax_element(keys, keys + n);
  const uint32_t range = *high - *low;
  const int bits = range ? 32 - __builtin_clz(range) : 0;
  const int passes = (bits + kMostDigitBits - 1) / kMostDigitBits;
  return {*low, passes, passes ? (bits + passes - 1) / passes : 0};
}

// Turns counts[thread][bin] into the place where that thread's first element of that bin goes.
void starts_from_counts(uint32_t* counts, int64_t bins, int team, int64_t stride) {
  uint32_t total = 0;
  for (int64_t bin = 0; bin < bins; ++bin)
    for (int t = 0; t < team; ++t) total += std::exchange(counts[t * stride + bin], total);
}

}  // namespace

void bin_frame(Frame& frame, int threads) {
  const int64_t n = frame.visible_count;
  const int tiles = frame.tiles();
  const int64_t stride = std::max<int64_t>(tiles, int64_t{1} << kMostDigitBits);
  uint32_t* histogram = frame.histogram.reserve(stride * threads);
  int64_t* offsets = frame.offsets.reserve(tiles + 1);
  Entry* entries = frame.entries.reserve(frame.pairs);
  const Digits digits = digits_of(frame.keys.get(), n);

#pragma omp parallel num_threads(threads)
  {
    const int t = omp_get_thread_num(), team = omp_get_num_threads();
    const int64_t begin = n * t / team, end = n * (t + 1) / team;
    uint32_t* counts = histogram + t * stride;
    Span *order = frame.order.get(), *order_to = frame.order_swap.get();
    uint32_t *keys = frame.keys.get(), *keys_to = frame.keys_swap.get();
    for (int pass = 0; pass < digits.passes; ++pass) {
      const int shift = pass * digits.bits;
      const uint32_t mask = (1u << digits.bits) - 1;
      const auto digit = [&](int64_t i) { return (keys[i] - digits.lowest) >> shift & mask; };
      std::fill_n(counts, mask + 1, 0u);
      for (int64_t i = begin; i < end; ++i) ++counts[digit(i)];
#pragma omp barrier
#pragma omp single
      starts_from_counts(histogram, mask + 1, team, stride);
      for (int64_t i = begin; i < end; ++i) {
        const uint32_t to = counts[digit(i)]++;
        order_to[to] = order[i];
        keys_to[to] = keys[i];
      }
#pragma omp barrier
      std::swap(order, order_to);
      std::swap(keys, keys_to);
    }

    const auto fetch_ahead = [&](int64_t i) {
      if (i + kAhead >= end) return;
      const Touch* touch = &frame.touches[order[i + kAhead].first];
      __builtin_prefetch(touch);
      __builtin_prefetch(touch + 5);  // the next line: most Gaussians have three pairs or so, few have ten
    };
    std::fill_n(counts, tiles, 0u);
    for (int64_t i = begin; i < end; ++i) {
      fetch_ahead(i);
      const Span span = order[i];
      for (uint32_t k = 0; k < span.count; ++k) ++counts[frame.touches[span.first + k].tile];
    }
#pragma omp barrier
#pragma omp single
    {
      starts_from_counts(histogram, tiles, team, stride);
      for (int tile = 0; tile < tiles; ++tile) offsets[tile] = histogram[tile];
      offsets[tiles] = frame.pairs;
    }
    for (int64_t i = begin; i < end; ++i) {
      fetch_ahead(i);
      const Span span = order[i];
      for (uint32_t k = 0; k < span.count; ++k) {
        const uint32_t slot = span.first + k;
        const Touch touch = frame.touches[slot];
        Entry& entry = entries[counts[touch.tile]++];
        __builtin_prefetch(&entry + 5, 1);  // this tile's next line
        entry = {touch.id, slot, touch.blocks};
      }
    }
  }
}

void bind_bin(nb::module_& m) {
  m.def(
      "bin",
      [](Frame& frame, Rows<2> means2d, Rows<3> conics, Row opacities, Row depths, Rows<2> extents, int width, int height,
         int threads) {
        const ProjectedRows rows{means2d.data(), conics.data(), opacities.data(), nullptr, depths.data(), extents.data()};
        const auto count = static_cast<int64_t>(depths.shape(0));
        nb::gil_scoped_release release;
        frame.camera = Camera{};
        frame.camera.width = width, frame.camera.height = height;
        collect_touches(frame, count, blocks_for(count), threads, [&](int64_t begin, int64_t end, TouchWriter& writer) {
          for (int64_t i = begin * kLanes; i < std::min(count, end * kLanes); ++i) {
            if (culled(rows, i)) continue;
            const Record record = record_of(rows, i);
            frame.records[i] = record;
            writer.add(static_cast<uint32_t>(i), record);
          }
        });
        bin_frame(frame, threads);
        return frame.pairs;
      },
      "frame"_a, "means2d"_a.noconvert(), "conics"_a.noconvert(), "opacities"_a.noconvert(), "depths"_a.noconvert(),
      "extents"_a.noconvert(), "width"_a, "height"_a, "threads"_a,
      "Makes the lists of projected Gaussians and keeps them in the frame; returns the number of pairs, which `lists` needs.");
  m.def(
      "lists",
      [](const Frame& frame, Tensor<int64_t, nb::ndim<1>> offsets, Tensor<int32_t, nb::ndim<1>> ids) {
        std::copy_n(frame.offsets.get(), offsets.shape(0), offsets.data());
        for (int64_t k = 0; k < frame.pairs; ++k) ids.data()[k] = static_cast<int32_t>(frame.entries[k].id);
      },
      "frame"_a, "offsets"_a.noconvert(), "ids"_a.noconvert(), "Copies the frame's lists out: offsets [tiles + 1], ids [pairs].");
}

}  // namespace splatmill
