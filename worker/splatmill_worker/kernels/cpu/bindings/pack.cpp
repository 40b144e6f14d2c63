// Conversion between the plain form of a scene, one row per Gaussian, and blocks of sixteen.
#include <algorithm>
#include <stdexcept>
#include <string>

#include "bindings/arguments.hpp"
#include "layout/buffer.hpp"
#include "simd/shuffles.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

// One parameter group [count, width] and the row of the blocks where it starts.
struct Group {
  float* data;
  int64_t width;
  int first;
};

// Gaussian i of the blocks is row order[i] of the groups, or row i without an order.
template <bool kToBlocks>
void move_groups(const std::vector<Group>& groups, float* blocks, int64_t count, const int64_t* order, int threads) {
  const int64_t n = blocks_for(count);
#pragma omp parallel for schedule(static) num_threads(threads)
  for (int64_t b = 0; b < n; ++b) {
    float* block = blocks + b * kBlockFloats;
    const int used = static_cast<int>(std::min<int64_t>(kLanes, count - b * kLanes));
    for (const Group& g : groups) {
      float* rows[kLanes];
      for (int l = 0; l < used; ++l) rows[l] = g.data + (order ? order[b * kLanes + l] : b * kLanes + l) * g.width;
      int64_t k = 0;
      if (used == kLanes)
        for (; k + kLanes <= g.width; k += kLanes) {
          Float square[kLanes];
          float* to = block + (g.first + k) * kLanes;
          for (int l = 0; l < kLanes; ++l) square[l] = kToBlocks ? load_unaligned(rows[l] + k) : load(to + l * kLanes);
          transpose(square);
          for (int l = 0; l < kLanes; ++l)
            if (kToBlocks)
              store(to + l * kLanes, square[l]);
            else
              store_unaligned(rows[l] + k, square[l]);
        }
      for (int l = 0; l < used; ++l)
        for (int64_t j = k; j < g.width; ++j) {
          float &plain = rows[l][j], &blocked = block[(g.first + j) * kLanes + l];
          if (kToBlocks)
            blocked = plain;
          else
            plain = blocked;
        }
    }
  }
}

using Plain = Tensor<float, nb::ndim<2>>;
using Order = Tensor<const int64_t, nb::ndim<1>>;

// Throws std::invalid_argument for an order that would make a pass access memory out of bounds.
void check_order(const std::optional<Order>& order, int64_t count) {
  if (!order) return;
  const int64_t* rows = order->data();
  const auto given = static_cast<int64_t>(order->shape(0));
  if (given != count || std::any_of(rows, rows + given, [&](int64_t row) { return row < 0 || row >= count; }))
    throw std::invalid_argument("order must have one row for each of the " + std::to_string(count) + " Gaussians.");
}

std::vector<Group> groups_of(const std::vector<Plain>& tensors, const std::vector<int>& first) {
  std::vector<Group> groups;
  for (size_t i = 0; i < tensors.size(); ++i)
    groups.push_back({tensors[i].data(), static_cast<int64_t>(tensors[i].shape(1)), first.at(i)});
  return groups;
}

}  // namespace

void bind_pack(nb::module_& m) {
  m.def(
      "pack",
      [](const std::vector<Plain>& groups, const std::vector<int>& first, Blocks blocks, int64_t count, std::optional<Order> order, int threads) {
        check_order(order, count);
        move_groups<true>(groups_of(groups, first), blocks.data(), count, order ? order->data() : nullptr, threads);
      },
      "groups"_a, "first"_a, "blocks"_a.noconvert(), "count"_a, "order"_a.noconvert().none(), "threads"_a,
      "Writes groups [count, width] into the blocks from row `first` on; lanes beyond count are left as they are. "
      "Gaussian i of the blocks is row order[i], int64 [count], where an order is given.");
  m.def(
      "unpack",
      [](const std::vector<Plain>& groups, const std::vector<int>& first, Blocks blocks, int64_t count, std::optional<Order> order, int threads) {
        check_order(order, count);
        move_groups<false>(groups_of(groups, first), blocks.data(), count, order ? order->data() : nullptr, threads);
      },
      "groups"_a, "first"_a, "blocks"_a.noconvert(), "count"_a, "order"_a.noconvert().none(), "threads"_a, "The reverse of `pack`.");
  m.def(
      "advise_huge_pages", [](Blocks blocks) { advise_huge_pages(blocks.data(), blocks.size() * sizeof(float)); },
      "blocks"_a.noconvert(), "Advises the system to back blocks by huge pages, best before they are first touched.");
}

}  // namespace splatmill
