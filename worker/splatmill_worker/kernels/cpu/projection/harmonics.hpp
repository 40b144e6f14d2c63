// Real spherical harmonics to degree 3 (Sloan 2008; order and signs of the splat file format), and their derivative.
#pragma once

#include "simd/simd.hpp"

namespace splatmill {

struct Direction {
  Float x, y, z;  // unit
};

namespace sh {
inline constexpr float k0 = 0.28209479177387814f;
inline constexpr float k1 = 0.4886025119029199f;
inline constexpr float k4 = 1.0925484305920792f;
inline constexpr float k6 = 0.31539156525252005f;
inline constexpr float k8 = 0.5462742152960396f;
inline constexpr float k9 = 0.5900435899266435f;
inline constexpr float k10 = 2.890611442640554f;
inline constexpr float k11 = 0.4570457994644658f;
inline constexpr float k12 = 0.3731763325901154f;
inline constexpr float k14 = 1.445305721320277f;
}  // namespace sh

// basis[(degree + 1)^2] at the direction.
SPLATMILL_INLINE void sh_basis(int degree, const Direction& d, Float* basis) {
  using namespace sh;
  basis[0] = splat(k0);
  if (degree < 1) return;
  basis[1] = d.y * -k1;
  basis[2] = d.z * k1;
  basis[3] = d.x * -k1;
  if (degree < 2) return;
  const Float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z, xy = d.x * d.y;
  basis[4] = xy * k4;
  basis[5] = d.y * d.z * -k4;
  basis[6] = (zz * 2.0f - xx - yy) * k6;
  basis[7] = d.x * d.z * -k4;
  basis[8] = (xx - yy) * k8;
  if (degree < 3) return;
  basis[9] = d.y * -k9 * (xx * 3.0f - yy);
  basis[10] = xy * d.z * k10;
  basis[11] = d.y * -k11 * (zz * 4.0f - xx - yy);
  basis[12] = d.z * k12 * (zz * 2.0f - (xx + yy) * 3.0f);
  basis[13] = d.x * -k11 * (zz * 4.0f - xx - yy);
  basis[14] = d.z * k14 * (xx - yy);
  basis[15] = d.x * -k9 * (xx - yy * 3.0f);
}

// Gradient to the direction, given the gradient e[k] to each basis value.
SPLATMILL_INLINE Direction sh_basis_backward(int degree, const Direction& d, const Float* e) {
  using namespace sh;
  Direction g{splat(0.0f), splat(0.0f), splat(0.0f)};
  if (degree < 1) return g;
  const Float x = d.x, y = d.y, z = d.z;
  g.x = e[3] * -k1;
  g.y = e[1] * -k1;
  g.z = e[2] * k1;
  if (degree < 2) return g;
  g.x += (y * e[4] - z * e[7]) * k4 - x * e[6] * (2 * k6) + x * e[8] * (2 * k8);
  g.y += (x * e[4] - z * e[5]) * k4 - y * e[6] * (2 * k6) - y * e[8] * (2 * k8);
  g.z += z * e[6] * (4 * k6) - (y * e[5] + x * e[7]) * k4;
  if (degree < 3) return g;
  const Float xx = x * x, yy = y * y, zz = z * z;
  g.x += x * y * e[9] * (-6 * k9) + y * z * e[10] * k10 + x * y * e[11] * (2 * k11) - x * z * e[12] * (6 * k12) -
         (zz * 4.0f - xx * 3.0f - yy) * e[13] * k11 + x * z * e[14] * (2 * k14) - (xx - yy) * e[15] * (3 * k9);
  g.y += (yy - xx) * e[9] * (3 * k9) + x * z * e[10] * k10 - (zz * 4.0f - xx - yy * 3.0f) * e[11] * k11 -
         y * z * e[12] * (6 * k12) + x * y * e[13] * (2 * k11) - y * z * e[14] * (2 * k14) + x * y * e[15] * (6 * k9);
  g.z += x * y * e[10] * k10 - y * z * e[11] * (8 * k11) + (zz * 2.0f - xx - yy) * e[12] * (3 * k12) -
         x * z * e[13] * (8 * k11) + (xx - yy) * e[14] * k14;
  return g;
}

}  // namespace splatmill
