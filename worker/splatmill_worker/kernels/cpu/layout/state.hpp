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
      : params_(reinterpret_cast<char*>(state.params + b * kParameterFloats)),
        exp_avg_(reinterpret_cast<char*>(state.exp_avg) + b * kRows * kLanes * FirstMoment::kBytes),
        exp_avg_sq_(reinterpret_cast<char*>(state.exp_avg_sq) + b * kRows * kLanes * SecondMoment::kBytes) {}
  SPLATMILL_INLINE char* param(int r) const {
    return params_ + kLanes * (r < kSh ? r * 4 : kSh * 4 + (r - kSh) * Harmonics::kBytes);
  }
  SPLATMILL_INLINE char* exp_avg(int r) const { return exp_avg_ + r * kLanes * FirstMoment::kBytes; }
  SPLATMILL_INLINE char* exp_avg_sq(int r) const { return exp_avg_sq_ + r * kLanes * SecondMoment::kBytes; }

  SPLATMILL_INLINE void load(int r, Float& x, Float& m, Float& v) const {
    x = r < kSh ? Float32::load(param(r)) : Harmonics::load(param(r));
    m = FirstMoment::load(exp_avg(r));
    v = SecondMoment::load(exp_avg_sq(r));
  }
  SPLATMILL_INLINE void store(int r, Float x, Float m, Float v, Noise& noise) const {
    if (r < kSh)
      Float32::store(param(r), x, noise);
    else
      Harmonics::store(param(r), x, noise);
    FirstMoment::store(exp_avg(r), m, noise);
    SecondMoment::store(exp_avg_sq(r), v, noise);
  }

 private:
  char *params_, *exp_avg_, *exp_avg_sq_;
};

}  // namespace splatmill
