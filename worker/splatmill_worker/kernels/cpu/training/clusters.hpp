// Clusters of 256 Gaussians that are neighbours in memory, each with a box around them. A view projects and moves only the clusters
// whose box may reach its image. The others make up for the updates that they missed when a view comes near them again, or when
// the scene is read.
#pragma once

#include <algorithm>
#include <array>
#include <vector>

#include "layout/camera.hpp"
#include "layout/state.hpp"

namespace splatmill {

inline constexpr int64_t kClusterBlocks = 16;

// The parameters with a learning rate of their own, by their first rows: Rates.rows().
inline constexpr int kRates = 6;
inline constexpr int kRateRows[kRates + 1] = {kMean, kLogScale, kQuat, kLogit, kSh, kSh + 3, kRows};

// Where the Gaussians of a cluster are, and how far they may drift meanwhile: m / sqrt(v) of Adam's moments, times Drift::travel.
struct Box {
  float low[3], high[3];  // of the means
  float log_scale;        // the largest
  float mean_pull;        // the largest |m| / sqrt(v) of the means
  float scale_pull;       // of the log-scales
};

// What updates with zero gradients amount to, from each update to the last. Adam then moves a parameter by the learning rate
// times m / sqrt(v) times a sum that depends on the steps alone (reference/adam.py); here the rates are part of the sum, as they
// change from step to step.
class Drift {
 public:
  using Sums = std::array<double, kRates>;
  int64_t updates() const { return static_cast<int64_t>(travel_.size()) - 1; }
  // The way since update number `from`, for each learning rate, in units of m / sqrt(v) after that update.
  const Sums& travel(int64_t from) const { return travel_[from]; }
  void add(const Sums& rates, int64_t step, double beta2);

 private:
  std::vector<Sums> travel_{Sums{}};
};

class Clusters {
 public:
  // Only the blocks before number `moved`, which is that of all or a multiple of kClusterBlocks, have moments: the others stay
  // where they are.
  Clusters(const State& state, int64_t count, int64_t moved, int threads);

  // Chooses the clusters that `camera` may show, and brings them up to date.
  void choose(const State& state, const Camera& camera, int threads);
  // Brings all clusters up to date.
  void settle(const State& state, int threads);
  // Begins an update of the first `rows` parameters of each Gaussian. What other clusters than the chosen ones miss of it is made up
  // for with this beta2 and these rows, so that all are brought up to date before either changes.
  void advance(const State& state, const Drift::Sums& rates, int64_t step, double beta2, int rows, int threads);
  // Notes that a chosen cluster was moved by the update that has begun. May be called for several clusters at once.
  void moved(const State& state, int64_t cluster);

  int64_t count() const { return count_; }
  const std::vector<int32_t>& chosen() const { return chosen_; }
  int64_t size() const { return static_cast<int64_t>(boxes_.size()); }

 private:
  void catch_up(const State& state, int64_t cluster);
  int64_t moving() const { return std::min(size(), moving_); }

  int64_t count_;   // Gaussians
  int64_t moving_;  // clusters that move: the first ones
  std::vector<Box> boxes_;
  std::vector<int64_t> current_;  // the update after which each box was measured, and its cluster is as it was
  std::vector<int32_t> chosen_;   // ascending
  std::vector<uint8_t> near_;
  Drift drift_;
  double beta2_ = 0;
  int rows_ = 0;
};

// The blocks that a pass visits: all of a scene, or those of the chosen clusters.
class Visited {
 public:
  Visited(int64_t count, const Clusters* clusters);
  int64_t blocks() const { return blocks_; }
  SPLATMILL_INLINE int64_t block(int64_t i) const {
    return chosen_ ? chosen_[i / kClusterBlocks] * kClusterBlocks + i % kClusterBlocks : i;
  }

 private:
  const int32_t* chosen_ = nullptr;
  int64_t blocks_;
};

}  // namespace splatmill
