// What training moves: the parameters of a scene and Adam's two moments, in blocks.
#pragma once

#include "layout/layout.hpp"

namespace splatmill {

struct State {
  float *params = nullptr, *exp_avg = nullptr, *exp_avg_sq = nullptr;
};

// Where the rows of a block lie in memory.
class BlockState {
 public:
  SPLATMILL_INLINE BlockState(const State& state, int64_t b)
      : params_(state.params + b * kBlockFloats),
        exp_avg_(state.exp_avg + b * kBlockFloats),
        exp_avg_sq_(state.exp_avg_sq + b * kBlockFloats) {}

  SPLATMILL_INLINE void load_moments(int r, Float& m, Float& v) const {
    m = row(exp_avg_, r);
    v = row(exp_avg_sq_, r);
  }
  SPLATMILL_INLINE void load(int r, Float& x, Float& m, Float& v) const {
    x = row(params_, r);
    load_moments(r, m, v);
  }
  SPLATMILL_INLINE void store(int r, Float x, Float m, Float v) const {
    splatmill::store(params_ + r * kLanes, x);
    splatmill::store(exp_avg_ + r * kLanes, m);
    splatmill::store(exp_avg_sq_ + r * kLanes, v);
  }

 private:
  float *params_, *exp_avg_, *exp_avg_sq_;
};

}  // namespace splatmill
