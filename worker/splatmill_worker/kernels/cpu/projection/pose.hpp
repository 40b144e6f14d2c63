// The gradient to the camera: its sum over Gaussians, in an order that does not depend on the number of threads, and its
// conversion to that of a small motion.
#pragma once

#include "projection/geometry.hpp"
#include "simd/shuffles.hpp"

namespace splatmill {

// Sums for the upper three rows of the viewmat, row by row: entry (i, j) at 4 i + j.
inline constexpr int kPoseSums = 12;

// Adds the visible lanes of a block to `sums`.
SPLATMILL_INLINE void add_camera_gradient(const CameraGradient& g, Mask visible, double* sums) {
  Float lanes[kPoseSums];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) lanes[4 * i + j] = keep(visible, g.R[3 * i + j]);
    lanes[4 * i + 3] = keep(visible, g.t[i]);
  }
  alignas(64) float total[kLanes];
  store_lane_sums<kPoseSums>(total, lanes);
  for (int k = 0; k < kPoseSums; ++k) sums[k] += total[k];
}

// Writes the sum of partial[parts][kPoseSums], taken in order, to `sums`.
inline void add_parts(const double* partial, int64_t parts, double* sums) {
  for (int k = 0; k < kPoseSums; ++k) sums[k] = 0;
  for (int64_t part = 0; part < parts; ++part)
    for (int k = 0; k < kPoseSums; ++k) sums[k] += partial[part * kPoseSums + k];
}

// For viewmat' = exp(xi^) viewmat with xi = (rho, phi), a camera point p moves by rho + phi x p: the gradient at xi = 0, three of
// the translation and three of the rotation, from the gradient G to the viewmat V. With A = V G^T, dL/dphi = (A12 - A21, ...).
inline void motion_gradient(const Camera& cam, const double* G, float* twist) {
  const auto V = [&](int i, int k) { return static_cast<double>(k < 3 ? cam.R[3 * i + k] : cam.t[i]); };
  const auto A = [&](int i, int j) {
    double sum = 0;
    for (int k = 0; k < 4; ++k) sum += V(i, k) * G[4 * j + k];
    return sum;
  };
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    twist[i] = static_cast<float>(G[4 * i + 3]);
    twist[3 + i] = static_cast<float>(A(j, k) - A(k, j));
  }
}

}  // namespace splatmill
