// Mean distance to the three nearest other points, exactly, through a k-d tree with boxes.
#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "bindings/bindings.hpp"
#include "simd/threads.hpp"

namespace splatmill {
namespace {

constexpr int kNeighbors = 3;

struct Box {
  float low[3], high[3];

  // Squared distance from a point to the nearest point of the box.
  float distance(const float* p) const {
    float d2 = 0;
    for (int a = 0; a < 3; ++a) {
      const float d = std::max(std::max(low[a] - p[a], p[a] - high[a]), 0.0f);
      d2 += d * d;
    }
    return d2;
  }
};

// A balanced tree over `order`, a permutation of the points. Node 1 is the root, node k has children 2k and 2k + 1; all leaves
// are at one depth and hold at most sixteen points, so that one vector scans a leaf.
class Tree {
 public:
  Tree(const float* points, int64_t n, int threads) : points_(points), n_(n) {
    while ((n + (int64_t{1} << depth_) - 1) >> depth_ > kLanes) ++depth_;
    order_.resize(n);
    std::iota(order_.begin(), order_.end(), 0);
    boxes_.resize(int64_t{2} << depth_);
#pragma omp parallel num_threads(threads)
#pragma omp single
    build(1, 0);
    const int64_t leaves = int64_t{1} << depth_;
    leaf_.assign(static_cast<std::size_t>(leaves) * 3 * kLanes + kLanes, HUGE_VALF);
    for (int64_t leaf = 0; leaf < leaves; ++leaf)
      for (int64_t i = begin(leaf, depth_); i < begin(leaf + 1, depth_); ++i)
        for (int a = 0; a < 3; ++a) leaf_points(leaf)[a * kLanes + i - begin(leaf, depth_)] = at(i)[a];
  }

  int64_t leaves() const { return int64_t{1} << depth_; }
  int depth() const { return depth_; }
  int64_t begin(int64_t place, int depth) const { return n_ * place >> depth; }  // first point of a node of one level
  int64_t id(int64_t i) const { return order_[i]; }

  // The mean distance from the i-th point of the order to its nearest others. Its own leaf is searched first, which bounds the
  // search of the others.
  float mean_distance(int64_t i, int64_t leaf) const {
    Nearest nearest;
    scan(leaf, i, nearest);
    walk(1, 0, i, leaf, nearest);
    float total = 0;
    int found = 0;
    for (const float d2 : nearest.squared)
      if (d2 < HUGE_VALF) total += std::sqrt(d2), ++found;
    return total / static_cast<float>(found);
  }

 private:
  struct Nearest {
    float squared[kNeighbors] = {HUGE_VALF, HUGE_VALF, HUGE_VALF};  // ascending
    void add(float d2) {
      for (float& s : squared)
        if (d2 < s) std::swap(d2, s);
    }
    float worst() const { return squared[kNeighbors - 1]; }
  };

  const float* at(int64_t i) const { return points_ + 3 * static_cast<int64_t>(order_[i]); }
  const float* leaf_points(int64_t leaf) const { return aligned() + leaf * 3 * kLanes; }
  float* leaf_points(int64_t leaf) { return const_cast<float*>(aligned()) + leaf * 3 * kLanes; }
  const float* aligned() const {
    return reinterpret_cast<const float*>((reinterpret_cast<uintptr_t>(leaf_.data()) + 63) & ~uintptr_t{63});
  }

  void build(int64_t node, int depth) {
    const int64_t place = node - (int64_t{1} << depth), first = begin(place, depth), last = begin(place + 1, depth);
    Box& box = boxes_[node];
    for (int a = 0; a < 3; ++a) box.low[a] = HUGE_VALF, box.high[a] = -HUGE_VALF;
    for (int64_t i = first; i < last; ++i)
      for (int a = 0; a < 3; ++a) {
        box.low[a] = std::min(box.low[a], at(i)[a]);
        box.high[a] = std::max(box.high[a], at(i)[a]);
      }
    if (depth == depth_) return;
    int axis = 0;
    for (int a = 1; a < 3; ++a)
      if (box.high[a] - box.low[a] > box.high[axis] - box.low[axis]) axis = a;
    const int64_t middle = begin(2 * place + 1, depth + 1);
    std::nth_element(order_.begin() + first, order_.begin() + middle, order_.begin() + last, [&](int32_t i, int32_t j) {
      const float x = points_[3 * static_cast<int64_t>(i) + axis], y = points_[3 * static_cast<int64_t>(j) + axis];
      return x < y || (x == y && i < j);  // a total order: the tree is the same on every run, duplicates or not
    });
#pragma omp task if (last - first > 20000)
    build(2 * node, depth + 1);
#pragma omp task if (last - first > 20000)
    build(2 * node + 1, depth + 1);
#pragma omp taskwait
  }

  void scan(int64_t leaf, int64_t self, Nearest& nearest) const {
    const float* p = at(self);
    const float* q = leaf_points(leaf);
    const Float x = load(q) - p[0], y = load(q + kLanes) - p[1], z = load(q + 2 * kLanes) - p[2];
    const Float d2 = x * x + y * y + z * z;
    uint32_t closer = bits(d2 < nearest.worst());
    const int64_t place = self - begin(leaf, depth_);
    if (0 <= place && place < kLanes && self < begin(leaf + 1, depth_)) closer &= ~(1u << place);
    if (!closer) return;
    alignas(64) float squared[kLanes];
    store(squared, d2);
    for (; closer; closer &= closer - 1) nearest.add(squared[__builtin_ctz(closer)]);
  }

  void walk(int64_t node, int depth, int64_t self, int64_t done, Nearest& nearest) const {
    if (depth == depth_) {
      const int64_t leaf = node - (int64_t{1} << depth_);
      if (leaf != done) scan(leaf, self, nearest);
      return;
    }
    const float* p = at(self);
    float left = boxes_[2 * node].distance(p), right = boxes_[2 * node + 1].distance(p);
    int64_t near = 2 * node, far = near + 1;
    if (right < left) std::swap(near, far), std::swap(left, right);
    if (left < nearest.worst()) walk(near, depth + 1, self, done, nearest);
    if (right < nearest.worst()) walk(far, depth + 1, self, done, nearest);
  }

  const float* points_;
  int64_t n_;
  int depth_ = 0;
  std::vector<int32_t> order_;
  std::vector<Box> boxes_;
  std::vector<float> leaf_;
};

}  // namespace

void knn(const float* points, int64_t n, float* distances, int threads) {
  const Tree tree(points, n, threads);
#pragma omp parallel for schedule(dynamic, 64) num_threads(threads)
  for (int64_t leaf = 0; leaf < tree.leaves(); ++leaf)
    for (int64_t i = tree.begin(leaf, tree.depth()); i < tree.begin(leaf + 1, tree.depth()); ++i)
      distances[tree.id(i)] = tree.mean_distance(i, leaf);
}

void bind_knn(nb::module_& m) {
  m.def(
      "knn",
      [](Tensor<const float, nb::shape<-1, 3>> points, Tensor<float, nb::ndim<1>> distances, int threads) {
        nb::gil_scoped_release release;
        knn(points.data(), static_cast<int64_t>(points.shape(0)), distances.data(),
            threads > 0 ? threads : default_threads());
      },
      nb::arg("points").noconvert(), nb::arg("distances").noconvert(), nb::arg("threads") = 0,
      "Mean distance from every point to its three nearest others, written to distances.");
}

}  // namespace splatmill
