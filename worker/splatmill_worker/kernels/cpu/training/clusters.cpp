#include "training/clusters.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "bindings/arguments.hpp"
#include "simd/threads.hpp"
#include "training/adam.hpp"

namespace splatmill {
namespace {

// Missed updates whose drift is computed: as in reference/adam.py.
constexpr int64_t kMemory = 256;

// Half the axes of the 1/255 ellipse of an opaque Gaussian, in standard deviations: sqrt(2 ln 255). Opacities are not asked for,
// since they may be written to between steps.
constexpr double kReach = 3.3291;

// What float32 may lose in a projection, over the sum of the magnitudes of its terms. Positions in the camera are sums of four
// products (4 u = 2.4e-7), and the extent is within 1e-6 with the exponential and the roots; the rest is room.
constexpr double kRounding = 1e-5;

SPLATMILL_INLINE float largest(Float x) {
  alignas(64) float lanes[kLanes];
  store(lanes, x);
  return *std::max_element(lanes, lanes + kLanes);
}

SPLATMILL_INLINE Float pull(const BlockState& at, int r) {
  Float m, v;
  at.load_moments(r, m, v);
  return abs(m * reciprocal_sqrt(max(v, 1e-37f)));
}

// Means that are NaN are left out: their Gaussians are never drawn.
Box measured(const State& state, int64_t cluster, int64_t count, bool moves) {
  constexpr float kInfinite = std::numeric_limits<float>::infinity();
  Float low[3], high[3], log_scale = splat(-kInfinite), mean_pull = splat(0.0f), scale_pull = splat(0.0f);
  for (int j = 0; j < 3; ++j) low[j] = splat(kInfinite), high[j] = splat(-kInfinite);
  const int64_t end = std::min(blocks_for(count), (cluster + 1) * kClusterBlocks);
  for (int64_t b = cluster * kClusterBlocks; b < end; ++b) {
    const float* p = state.params + b * kBlockFloats;
    const Mask used = mask_of(lanes_of(b, count));
    for (int j = 0; j < 3; ++j) {
      const Float x = row(p, kMean + j);
      low[j] = min(select(used, x, low[j]), low[j]);
      high[j] = max(select(used, x, high[j]), high[j]);
      log_scale = max(select(used, row(p, kLogScale + j), log_scale), log_scale);
      if (!moves) continue;
      const BlockState at(state, b);
      mean_pull = max(keep(used, pull(at, kMean + j)), mean_pull);
      scale_pull = max(keep(used, pull(at, kLogScale + j)), scale_pull);
    }
  }
  Box box;
  for (int j = 0; j < 3; ++j) box.low[j] = -largest(-low[j]), box.high[j] = largest(high[j]);
  box.log_scale = largest(log_scale);
  box.mean_pull = largest(mean_pull), box.scale_pull = largest(scale_pull);
  return box;
}

// A half-space of the world that holds what a camera shows: a . X + offset + reach * scale > 0 for a Gaussian of that scale.
struct Side {
  double a[3], offset = 0, reach = 0;
  double size[3], offset_size = 0;  // magnitudes of the terms, for their rounding
};

// The half-space weight_x * x + weight_y * y + weight_z * z + constant > 0 of camera space.
Side side(const Camera& cam, double weight_x, double weight_y, double weight_z, double constant, double reach) {
  const double weights[3] = {weight_x, weight_y, weight_z};
  Side s;
  s.reach = reach;
  for (int j = 0; j < 3; ++j) {
    s.a[j] = s.size[j] = 0;
    for (int i = 0; i < 3; ++i) {
      s.a[j] += weights[i] * cam.R[3 * i + j];
      s.size[j] += std::fabs(weights[i] * cam.R[3 * i + j]);
    }
  }
  s.offset = constant, s.offset_size = std::fabs(constant);
  for (int i = 0; i < 3; ++i) s.offset += weights[i] * cam.t[i], s.offset_size += std::fabs(weights[i] * cam.t[i]);
  return s;
}

// The longest row of the Jacobian times the rotation, times z: |W0 - u W2| with u within the camera's bounds, where it is convex.
double longest(const Camera& cam, int axis, double low, double high) {
  double most = 0;
  for (const double u : {low, high}) {
    double sum = 0;
    for (int j = 0; j < 3; ++j) sum += std::pow(cam.R[3 * axis + j] - u * cam.R[6 + j], 2);
    most = std::max(most, std::sqrt(sum));
  }
  return most;
}

// A Gaussian of largest scale s is drawn only where x2d + extent > 0 and x2d - extent < width, the same in y, and z > near. Times
// z, x2d is fx x + cx z, and the extent at most kReach (s |fx| |W0 - u W2| + sqrt(0.3) z).
std::array<Side, 5> sides_of(const Camera& cam) {
  const double blur = kReach * std::sqrt(kBlur);
  const double reach_x = kReach * std::fabs(cam.fx) * longest(cam, 0, cam.low_u, cam.high_u);
  const double reach_y = kReach * std::fabs(cam.fy) * longest(cam, 1, cam.low_v, cam.high_v);
  return {side(cam, cam.fx, 0, cam.cx + blur, 0, reach_x), side(cam, -cam.fx, 0, cam.width - cam.cx + blur, 0, reach_x),
          side(cam, 0, cam.fy, cam.cy + blur, 0, reach_y), side(cam, 0, -cam.fy, cam.height - cam.cy + blur, 0, reach_y),
          side(cam, 0, 0, 1, -cam.near, 0)};
}

// Whether no Gaussian of the box reaches the image. False for boxes that are not finite.
bool is_outside(const Box& box, const Drift::Sums& travel, const std::array<Side, 5>& sides) {
  const double margin = box.mean_pull * travel[0];
  const double scale = std::exp(box.log_scale + box.scale_pull * travel[1]);
  for (const Side& s : sides) {
    double most = s.offset + s.reach * scale, size = s.offset_size + s.reach * scale;
    for (int j = 0; j < 3; ++j) {
      const double low = box.low[j] - margin, high = box.high[j] + margin;
      most += std::max(s.a[j] * low, s.a[j] * high);
      size += s.size[j] * std::max(std::fabs(low), std::fabs(high));
    }
    if (most + kRounding * size < 0) return true;
  }
  return false;
}

}  // namespace

void Drift::add(const Sums& rates, int64_t step, double beta2) {
  const double s = static_cast<double>(step), ratio = kBeta1 / std::sqrt(beta2);
  const double correction = std::sqrt(1 - std::pow(beta2, s)) / (1 - std::pow(kBeta1, s));
  double decay = 1;
  const int64_t last = updates();
  for (int64_t from = last; from >= std::max<int64_t>(0, last + 1 - kMemory); --from) {
    decay *= ratio;
    for (int rate = 0; rate < kRates; ++rate) travel_[from][rate] += rates[rate] * correction * decay;
  }
  travel_.push_back(Sums{});
}

Clusters::Clusters(const State& state, int64_t count, int64_t moved, int threads)
    : count_(count),
      moving_((moved + kClusterBlocks - 1) / kClusterBlocks),
      boxes_((blocks_for(count) + kClusterBlocks - 1) / kClusterBlocks),
      current_(boxes_.size(), 0),
      near_(boxes_.size(), 0) {
#pragma omp parallel for schedule(static) num_threads(threads)
  for (int64_t c = 0; c < size(); ++c) boxes_[c] = measured(state, c, count_, c < moving_);
}

void Clusters::choose(const State& state, const Camera& camera, int threads) {
  const std::array<Side, 5> sides = sides_of(camera);
#pragma omp parallel for schedule(static) num_threads(threads)
  for (int64_t c = 0; c < size(); ++c) near_[c] = !is_outside(boxes_[c], drift_.travel(current_[c]), sides);
  chosen_.clear();
  for (int64_t c = 0; c < size(); ++c)
    if (near_[c]) chosen_.push_back(static_cast<int32_t>(c));
  const auto chosen = static_cast<int64_t>(chosen_.size());
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(dynamic, 1)
    for (int64_t i = 0; i < chosen; ++i)
      if (chosen_[i] < moving_) catch_up(state, chosen_[i]);
  }
}

void Clusters::settle(const State& state, int threads) {
#pragma omp parallel num_threads(threads)
  {
    const FlushDenormals flush;
#pragma omp for schedule(dynamic, 1)
    for (int64_t c = 0; c < moving(); ++c) catch_up(state, c);
  }
}

void Clusters::catch_up(const State& state, int64_t cluster) {
  const int64_t missed = drift_.updates() - current_[cluster];
  if (missed == 0) return;
  const Drift::Sums& travel = drift_.travel(current_[cluster]);
  const auto decay1 = static_cast<float>(std::pow(kBeta1, static_cast<double>(missed)));
  const auto decay2 = static_cast<float>(std::pow(beta2_, static_cast<double>(missed)));
  const int64_t end = std::min(blocks_for(count_), (cluster + 1) * kClusterBlocks);
  for (int64_t b = cluster * kClusterBlocks; b < end; ++b) {
    const BlockState at(state, b);
    for (int rate = 0; rate < kRates; ++rate) {
      const Float way = splat(static_cast<float>(travel[rate]));
      for (int r = kRateRows[rate]; r < std::min(rows_, kRateRows[rate + 1]); ++r) {
        Float x, m, v;
        at.load(r, x, m, v);
        const Float safe = max(v, 1e-37f), deviation = fma(safe, reciprocal_sqrt(safe), splat(kAdamEps));
        at.store(r, fnma(way * m, reciprocal(deviation), x), m * decay1, v * decay2);
      }
    }
  }
  current_[cluster] = drift_.updates();
  boxes_[cluster] = measured(state, cluster, count_, true);
}

void Clusters::advance(const State& state, const Drift::Sums& rates, int64_t step, double beta2, int rows, int threads) {
  if (beta2 != beta2_ || rows != rows_) settle(state, threads);
  drift_.add(rates, step, beta2);
  beta2_ = beta2, rows_ = rows;
}

void Clusters::moved(const State& state, int64_t cluster) {
  if (cluster >= moving_) return;
  current_[cluster] = drift_.updates();
  boxes_[cluster] = measured(state, cluster, count_, true);
}

Visited::Visited(int64_t count, const Clusters* clusters) : blocks_(blocks_for(count)) {
  if (!clusters) return;
  chosen_ = clusters->chosen().data();
  const auto chosen = static_cast<int64_t>(clusters->chosen().size());
  const bool with_last = chosen > 0 && clusters->chosen().back() == clusters->size() - 1;
  const int64_t missing = clusters->size() * kClusterBlocks - blocks_;  // of the last cluster
  blocks_ = chosen * kClusterBlocks - (with_last ? missing : 0);
}

void bind_clusters(nb::module_& m) {
  nb::class_<Clusters>(m, "Clusters", "Clusters of the Gaussians of a scene in blocks, with boxes.")
      .def(
          "__init__",
          [](Clusters* self, Blocks params, Blocks exp_avg, Blocks exp_avg_sq, int64_t count, int threads) {
            const auto moved = static_cast<int64_t>(exp_avg.shape(0));
            new (self) Clusters({params.data(), exp_avg.data(), exp_avg_sq.data()}, count, moved, threads);
          },
          "params"_a.noconvert(), "exp_avg"_a.noconvert(), "exp_avg_sq"_a.noconvert(), "count"_a, "threads"_a,
          "Of the Gaussians in blocks of which the first ones have moments, and move.")
      .def(
          "choose",
          [](Clusters& self, Blocks params, Blocks exp_avg, Blocks exp_avg_sq, const Camera& camera, int threads) {
            nb::gil_scoped_release release;
            self.choose({params.data(), exp_avg.data(), exp_avg_sq.data()}, camera, threads);
          },
          "params"_a.noconvert(), "exp_avg"_a.noconvert(), "exp_avg_sq"_a.noconvert(), "camera"_a, "threads"_a,
          "Chooses the clusters that the camera may show, for the next render, and brings them up to date.")
      .def(
          "settle",
          [](Clusters& self, Blocks params, Blocks exp_avg, Blocks exp_avg_sq, int threads) {
            nb::gil_scoped_release release;
            self.settle({params.data(), exp_avg.data(), exp_avg_sq.data()}, threads);
          },
          "params"_a.noconvert(), "exp_avg"_a.noconvert(), "exp_avg_sq"_a.noconvert(), "threads"_a,
          "Brings all clusters up to date.")
      .def_prop_ro("count", &Clusters::size, "The number of clusters.")
      .def_prop_ro("chosen", &Clusters::chosen, "The numbers of those that the last camera may show.");
}

}  // namespace splatmill
