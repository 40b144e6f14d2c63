// Projected Gaussians as the separate ops exchange them with Python, a tensor [N, ...] for each field, and records made of them.
#pragma once

#include <cmath>

#include "bindings/arguments.hpp"
#include "layout/frame.hpp"

namespace splatmill {

struct ProjectedRows {
  float *means2d, *conics, *opacities, *colors, *depths, *extents;  // unused ones are null
};

// The floats of one projected Gaussian, in the order of the fields; the first kDifferentiable have a gradient.
enum ProjectedPlace {
  kMeanX, kMeanY, kConicA, kConicB, kConicC, kOpacity, kRed, kGreen, kBlue, kDepth, kDifferentiable,
  kExtentX = kDifferentiable, kExtentY, kProjectedFloats
};

// The factor of a conic (A, B, C) given in float32 has lost the digits that the conic lost. For a needle whose A C - B^2 vanishes
// in rounding, the determinant is raised to the rounding error of its terms. The fused step never forms conics.
inline Record record_of(const ProjectedRows& p, int64_t i) {
  Record r{};
  const double A = p.conics[3 * i], B = p.conics[3 * i + 1], C = p.conics[3 * i + 2];
  const double det = std::max(A * C - B * B, 6e-8 * A * C), half = 0.5 * 1.4426950408889634;
  r.x = p.means2d[2 * i], r.y = p.means2d[2 * i + 1];
  const double ux = std::sqrt(half * A);
  r.ux = static_cast<float>(ux);
  r.uy = static_cast<float>(half * B / ux);
  r.vy = static_cast<float>(std::sqrt(half * det / A));
  r.opacity = p.opacities[i];
  r.level = static_cast<float>(std::log2(static_cast<double>(r.opacity)));
  r.cut = r.level - kLog2AlphaMin;
  for (int c = 0; c < 3; ++c) r.color[c] = p.colors ? p.colors[3 * i + c] : 0.0f;
  r.depth = p.depths[i];
  r.slope_x = static_cast<float>(-B / A);
  r.slope_y = static_cast<float>(-B / C);
  r.extent_x = p.extents[2 * i], r.extent_y = p.extents[2 * i + 1];
  return r;
}

inline bool culled(const ProjectedRows& p, int64_t i) { return !(p.extents[2 * i] > 0 && p.extents[2 * i + 1] > 0); }

}  // namespace splatmill
