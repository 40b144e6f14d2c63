// composite as a separate op: it takes projected tensors and any lists, and returns gradients to the tensors.
#include "compositing/composite.hpp"

#include <cmath>
#include <stdexcept>
#include <string>

#include "bindings/rows.hpp"
#include "compositing/waves.hpp"
#include "simd/threads.hpp"
#include "tiles/reach.hpp"

namespace splatmill {
namespace {

// Throws std::invalid_argument for lists, which come from the caller, that would make a pass read out of bounds.
void check_lists(const int64_t* offsets, int64_t tiles, const int32_t* ids, int64_t pairs, int64_t count) {
  if (offsets[0] != 0 || offsets[tiles] != pairs)
    throw std::invalid_argument("bins.offsets must run from 0 to the " + std::to_string(pairs) + " ids given.");
  for (int64_t t = 0; t < tiles; ++t)
    if (offsets[t] > offsets[t + 1]) throw std::invalid_argument("bins.offsets must not fall (tile " + std::to_string(t) + ").");
  for (int64_t k = 0; k < pairs; ++k)
    if (ids[k] < 0 || ids[k] >= count)
      throw std::invalid_argument("bins.ids[" + std::to_string(k) + "] is " + std::to_string(ids[k]) + ", but there are " +
                                  std::to_string(count) + " Gaussians.");
}

}  // namespace

void take_lists(Frame& frame, const ProjectedRows& rows, int64_t count, const int64_t* offsets, const int32_t* ids,
                int64_t pairs, int threads) {
  const int tiles = frame.tiles(), columns = frame.camera.columns();
  check_lists(offsets, tiles, ids, pairs, count);
  frame.count = count;
  frame.pairs = pairs;
  frame.records.reserve(count);
  std::copy_n(offsets, tiles + 1, frame.offsets.reserve(tiles + 1));
  frame.entries.reserve(pairs);
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(static)
    for (int64_t i = 0; i < count; ++i)
      if (!culled(rows, i)) frame.records[i] = record_of(rows, i);
#pragma omp for schedule(dynamic, 8)
    for (int tile = 0; tile < tiles; ++tile)
      for (int64_t k = offsets[tile]; k < offsets[tile + 1]; ++k) {
        const auto id = static_cast<uint32_t>(ids[k]);
        uint32_t blocks = 0;
        if (!culled(rows, id)) {
          const Reach reach(frame.records[id]);
          blocks = reach.blocks(reach.row(tile / columns), tile % columns);
        }
        frame.entries[k] = {id, static_cast<uint32_t>(k), blocks};
      }
  }
}

namespace {

// Numbers the slots of the pairs so that those of a Gaussian are consecutive, in tile order.
void assign_slots(Frame& frame) {
  Span* spans = frame.spans.reserve(frame.count);
  for (int64_t i = 0; i < frame.count; ++i) spans[i] = {0, 0};
  for (int64_t k = 0; k < frame.pairs; ++k) ++spans[frame.entries[k].id].count;
  uint32_t next = 0;
  for (int64_t i = 0; i < frame.count; ++i) {
    spans[i].first = next;
    next += spans[i].count;
    spans[i].count = 0;
  }
  frame.touches.reserve(frame.pairs);
  for (int64_t k = 0; k < frame.pairs; ++k) {
    Entry& entry = frame.entries[k];
    Span& span = spans[entry.id];
    entry.slot = span.first + span.count++;
    frame.touches[entry.slot] = {entry.id, 0, 1};
  }
}

// Writes the gradients to the inputs of the op from a Gaussian's sums over (u, v): dy = v / vy and dx = (u - uy dy) / ux.
void write_gradient(const Record& r, const double* s, const ProjectedRows& out, int64_t i) {
  const double ux = r.ux, uy = r.uy, vy = r.vy, k1 = 2.0 * 0.6931471805599453, shear = uy / vy;
  out.means2d[2 * i] = static_cast<float>(k1 * ux * s[kSumQU]);
  out.means2d[2 * i + 1] = static_cast<float>(k1 * (uy * s[kSumQU] + vy * s[kSumQV]));
  const double xx = (s[kSumQUU] - 2 * shear * s[kSumQUV] + shear * shear * s[kSumQVV]) / (ux * ux);
  const double xy = (s[kSumQUV] - shear * s[kSumQVV]) / (ux * vy), yy = s[kSumQVV] / (vy * vy);
  out.conics[3 * i] = static_cast<float>(-0.5 * xx);
  out.conics[3 * i + 1] = static_cast<float>(-xy);
  out.conics[3 * i + 2] = static_cast<float>(-0.5 * yy);
  out.opacities[i] = static_cast<float>(s[kSumQ] / r.opacity);
  for (int c = 0; c < 3; ++c) out.colors[3 * i + c] = static_cast<float>(s[kSumRed + c]);
  out.depths[i] = static_cast<float>(s[kSumDepth]);
}

void gradients_of_rows(const Frame& frame, const ProjectedRows& out, int threads) {
#pragma omp parallel for schedule(static) num_threads(threads)
  for (int64_t i = 0; i < frame.count; ++i) {
    const Span span = frame.spans[i];
    double s[kSums] = {};
    bool any = false;
    for (uint32_t k = span.first; k < span.first + span.count; ++k) {
      if (!frame.touches[k].blocks) continue;
      any = true;
      const float* pair = &frame.pair_sums[static_cast<int64_t>(k) * kPairSums];
      for (int j = 0; j < kSums; ++j) s[j] += pair[j];
    }
    if (any) write_gradient(frame.records[i], s, out, i);
  }
}

struct BlockCounts {
  int64_t reached = 0, changed = 0;
};

// Counts the 4x4-pixel blocks that the pairs of the last render reached before their tiles ended, and those that they changed: the
// work of the two passes. To be called between the passes, because the backward pass clears the blocks of pairs that it skips.
BlockCounts count_blocks(const Frame& frame) {
  BlockCounts found;
  for (int tile = 0; tile < frame.tiles(); ++tile)
    for (int64_t k = frame.offsets[tile]; k < frame.offsets[tile] + frame.walked[tile]; ++k) {
      found.reached += __builtin_popcount(frame.touches[frame.entries[k].slot].blocks);
      found.changed += __builtin_popcount(frame.entries[k].blocks);
    }
  return found;
}

}  // namespace

void bind_composite(nb::module_& m) {
  m.def(
      "composite",
      [](Frame& frame, Rows<2> means2d, Rows<3> conics, Row opacities, Rows<3> colors, Row depths, Rows<2> extents,
         Tensor<int64_t, nb::ndim<1>> offsets, Tensor<int32_t, nb::ndim<1>> ids, int width, int height,
         const std::tuple<float, float, float>& background, Image image, int threads, std::optional<Rows<kWaveFloats>> waves,
         std::optional<WaveRows> wave_rows) {
        const ProjectedRows rows{means2d.data(), conics.data(), opacities.data(), colors.data(), depths.data(), extents.data()};
        const float rgb[3] = {std::get<0>(background), std::get<1>(background), std::get<2>(background)};
        nb::gil_scoped_release release;
        frame.camera = Camera{};
        frame.camera.width = width, frame.camera.height = height;
        take_lists(frame, rows, static_cast<int64_t>(depths.shape(0)), offsets.data(), ids.data(),
                   static_cast<int64_t>(ids.shape(0)), threads);
        frame.with_waves = waves && wave_rows;
        if (frame.with_waves)
          take_waves(frame, waves->data(), static_cast<int64_t>(waves->shape(0)), wave_rows->data(), frame.count);
        composite_forward(frame, planes_of(image, frame.camera), true, rgb, threads);
      },
      "frame"_a, "means2d"_a.noconvert(), "conics"_a.noconvert(), "opacities"_a.noconvert(), "colors"_a.noconvert(),
      "depths"_a.noconvert(), "extents"_a.noconvert(), "offsets"_a.noconvert(), "ids"_a.noconvert(), "width"_a, "height"_a,
      "background"_a, "image"_a.noconvert(), "threads"_a, "waves"_a.noconvert().none() = nb::none(),
      "wave_rows"_a.noconvert().none() = nb::none(),
      "Blends the lists into five planes (colour, alpha, depth) and leaves in the frame what the backward pass needs.");
  m.def(
      "composite_backward",
      [](Frame& frame, Image image, Image gradient, Rows<2> d_means2d, Rows<3> d_conics, Row d_opacities, Rows<3> d_colors,
         Row d_depths, int threads, std::optional<Rows<kWaveFloats>> d_waves) {
        const ProjectedRows out{d_means2d.data(), d_conics.data(), d_opacities.data(), d_colors.data(), d_depths.data(), nullptr};
        const ImageGradient g{planes_of(image, frame.camera), planes_of(gradient, frame.camera), true};
        nb::gil_scoped_release release;
        assign_slots(frame);
        composite_backward(frame, g, threads);
        gradients_of_rows(frame, out, threads);
        if (d_waves) gradients_of_waves(frame, nullptr, d_waves->data(), threads);
      },
      "frame"_a, "image"_a.noconvert(), "gradient"_a.noconvert(), "d_means2d"_a.noconvert(), "d_conics"_a.noconvert(),
      "d_opacities"_a.noconvert(), "d_colors"_a.noconvert(), "d_depths"_a.noconvert(), "threads"_a,
      "d_waves"_a.noconvert().none() = nb::none(),
      "Writes the gradients of the Gaussians that were blended; other rows keep what they hold, so pass zeros.");
  m.def(
      "count_blocks",
      [](const Frame& frame) {
        const BlockCounts found = count_blocks(frame);
        return std::make_tuple(found.reached, found.changed);
      },
      "frame"_a, "The numbers of 4x4-pixel blocks that the last `render` worked on and that it changed; for benchmarks.");
}

}  // namespace splatmill
