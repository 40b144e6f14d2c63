// Adam's update of sixteen values (Kingma & Ba 2015).
//
// State is float32 and does not underflow: eps = 1e-15 outweighs sqrt(v) from v < 1e-30 down, while float32 holds v to 1e-38; a
// gradient whose square vanishes moves its parameter by less than a thousandth of the rate. Nor does it overflow: a gradient
// whose square does is refused, so v stays below 1e36.
#pragma once

#include <cmath>

#include "simd/simd.hpp"

namespace splatmill {

// As in records.py. The factor on the second moments is the caller's choice.
inline constexpr double kBeta1 = 0.9;
inline constexpr float kAdamEps = 1e-15f;

// The two bias corrections of a step (counted from 1), 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t), and the weights of the
// second moment: `keep`, beta2, of the old one and `add`, 1 - beta2, of the new square.
struct AdamStep {
  float size = 0, root = 0, keep = 0, add = 0;
  AdamStep() = default;
  AdamStep(int64_t step, double beta2)
      : size(static_cast<float>(1.0 / (1.0 - std::pow(kBeta1, static_cast<double>(step))))),
        root(static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, static_cast<double>(step))))),
        keep(static_cast<float>(beta2)),
        add(static_cast<float>(1.0 - beta2)) {}
};

// Moves p and its moments m, v by the gradient g; rate is the group's learning rate times AdamStep::size. Lanes whose gradient is
// not finite, or too large to square, stay as they were; the lanes that moved are returned, so that a caller can count the rest.
SPLATMILL_INLINE Mask adam_update(Float& p, Float& m, Float& v, Float g, Float rate, const AdamStep& scale) {
  const Float squared = g * g;
  const Mask good = is_finite(squared);
  const Float m1 = fma(m, splat(static_cast<float>(kBeta1)), g * static_cast<float>(1.0 - kBeta1));
  const Float v1 = fma(v, splat(scale.keep), squared * scale.add);
  // sqrt(v) as v * rsqrt(v). The floor keeps rsqrt finite; its root, 3e-19, is far below eps.
  const Float safe = max(v1, 1e-37f);
  const Float deviation = fma(safe * reciprocal_sqrt(safe), splat(scale.root), kAdamEps);
  p = select(good, fnma(rate * m1, reciprocal(deviation), p), p);
  m = select(good, m1, m);
  v = select(good, v1, v);
  return good;
}

}  // namespace splatmill
