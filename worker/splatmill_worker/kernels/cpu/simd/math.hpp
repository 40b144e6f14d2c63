// Elementary functions of sixteen floats, each with the error it was measured at (worker/bench/functions.md).
#pragma once

#include "simd/simd.hpp"

namespace splatmill {

inline constexpr float kLn2 = 0.6931471805599453f;
inline constexpr float kLog2E = 1.4426950408889634f;

// Nearest integer of |x| < 2^22: adding 1.5 * 2^23 leaves no bits for the fraction.
SPLATMILL_INLINE Float round_small(Float x) { return (x + 12582912.0f) - 12582912.0f; }

// e^x within 1.1 ulp on [-87, 88]; beyond, the value at the end of that range (finite, so that what is built on it overflows
// visibly). Cody-Waite reduction and the Cephes polynomial. NaN gives a finite value: test the argument where that matters.
SPLATMILL_INLINE Float exp(Float x) {
  x = max(min(x, 88.0f), -87.0f);
  const Float n = round_small(x * kLog2E);
  const Float f = fma(n, splat(2.12194440e-4f), fma(n, splat(-0.693359375f), x));
  Float p = splat(1.9875691500e-4f);
  p = fma(p, f, 1.3981999507e-3f);
  p = fma(p, f, 8.3334519073e-3f);
  p = fma(p, f, 4.1665795894e-2f);
  p = fma(p, f, 1.6666665459e-1f);
  p = fma(p, f, 5.0000001201e-1f);
  p = fma(p * f, f, f) + 1.0f;
  return p * as_float((to_int(n) + 127) << splat(23));
}

// log2 of a positive normal number within 2.3 ulp: Cephes logf, scaled.
SPLATMILL_INLINE Float log2(Float x) {
  const Int bits = as_int(x);
  Float exponent = to_float((bits >> splat(23)) - 126);
  Float m = as_float((bits & 0x007FFFFF) | 0x3F000000);  // in [0.5, 1)
  const Mask low = m < 0.70710678f;
  exponent = exponent - keep(low, splat(1.0f));
  m = (m + keep(low, m)) - 1.0f;
  Float p = splat(7.0376836292e-2f);
  p = fma(p, m, -1.1514610310e-1f);
  p = fma(p, m, 1.1676998740e-1f);
  p = fma(p, m, -1.2420140846e-1f);
  p = fma(p, m, 1.4249322787e-1f);
  p = fma(p, m, -1.6668057665e-1f);
  p = fma(p, m, 2.0000714765e-1f);
  p = fma(p, m, -2.4999993993e-1f);
  p = fma(p, m, 3.3333331174e-1f);
  const Float z = m * m;
  const Float log_m = fma(p * m, z, fnma(splat(0.5f), z, m));
  return fma(log_m, kLog2E, exponent);
}

// 2^x for |x| < 2^22 well inside the exponent's range, relative error below 2.8e-6: a minimax polynomial of degree 4 on [-1/2, 1/2]
// and the integer part added to the exponent. The one exponential of compositing, where x is log2 of an alpha at or above 1/255;
// for anything else (lanes that are masked afterwards) the value means nothing. Its adds and integer operations run beside the
// multiplications of the loop around it, which makes it cheaper there than a polynomial over the whole range.
SPLATMILL_INLINE Float exp2_of_alpha(Float x) {
  const Float shifted = x + 12582912.0f;  // the nearest integer sits in the low bits
  const Float f = x - (shifted - 12582912.0f);
  Float p = fma(splat(9.570102207e-03f), f, splat(5.591785908e-02f));
  p = fma(p, f, 2.402474433e-01f);
  p = fma(p, f, 6.931217909e-01f);
  p = fma(p, f, 9.999992847e-01f);
  return as_float(as_int(p) + (as_int(shifted) << 23));
}

}  // namespace splatmill
